/* SPDX-License-Identifier: MIT */
#include "biotac.h"

#define SAMPLE 0x80u
#define WORD_ZERO_BITS 0x06u

bool biotac_odd_parity(uint8_t byte)
{
    byte = (uint8_t)(byte ^ (byte >> 4));
    byte = (uint8_t)(byte ^ (byte >> 2));
    byte = (uint8_t)(byte ^ (byte >> 1));
    return (byte & 1u) != 0;
}

uint8_t biotac_sample_command(uint8_t channel)
{
    uint8_t byte;

    if (channel > BIOTAC_E24 || (channel > BIOTAC_TDC && channel < BIOTAC_E1)) {
        return 0;
    }
    byte = (uint8_t)(SAMPLE | (unsigned)channel << 1);
    return biotac_odd_parity(byte) ? byte : (uint8_t)(byte | 1u);
}

bool biotac_is_sample_command(uint8_t byte)
{
    return byte != 0 && byte == biotac_sample_command((uint8_t)((byte & 0x7Eu) >> 1));
}

bool biotac_word_is_sound(uint8_t high, uint8_t low)
{
    return biotac_odd_parity(high) && biotac_odd_parity(low) && (low & WORD_ZERO_BITS) == 0;
}

uint8_t biotac_commands(enum biotac_sequence sequence, uint8_t *command)
{
    static const uint8_t first[] = {BIOTAC_PAC, BIOTAC_PDC, BIOTAC_TAC, BIOTAC_TDC};
    static const uint8_t last[] = {BIOTAC_PDC, BIOTAC_TAC, BIOTAC_TDC};
    const uint8_t pac = biotac_sample_command(BIOTAC_PAC);
    uint8_t channel, i, slots = 0;

    for (i = 0; sequence == BIOTAC_ALL && i < sizeof first; i++) {
        command[slots++] = biotac_sample_command(first[i]);
    }
    for (channel = BIOTAC_E1; channel <= BIOTAC_E24; channel++) {
        command[slots++] = biotac_sample_command(channel);
        if (sequence == BIOTAC_INTERLEAVED) {
            command[slots++] = pac;
        }
    }
    for (i = 0; sequence == BIOTAC_INTERLEAVED && i < sizeof last; i++) {
        command[slots++] = biotac_sample_command(last[i]);
        command[slots++] = pac;
    }
    return slots;
}
