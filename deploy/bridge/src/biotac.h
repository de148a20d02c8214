/* SPDX-License-Identifier: MIT */
/* BioTac SP on SPI: command bytes and response words.
 * Source: BioTac SP Product Manual V2 (October 2015), section 8. */
#ifndef GRASPD_BIOTAC_H
#define GRASPD_BIOTAC_H

#include <stdbool.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

enum {
    BIOTAC_PAC = 0, /* channels, manual table 7 */
    BIOTAC_PDC = 1,
    BIOTAC_TAC = 2,
    BIOTAC_TDC = 3,
    BIOTAC_E1 = 17,
    BIOTAC_E24 = 40,
    BIOTAC_SETTLE_US = 50,       /* least wait between a command and its answer, figure 14 */
    BIOTAC_GAP_US = 5,           /* wait after each sensor's answer, figure 14 */
    BIOTAC_READ = 0x61,          /* reads a property, figure 13; its answer carries no parity */
    BIOTAC_FIRMWARE = 0x13,      /* property: firmware version, table 10 */
    BIOTAC_SERIAL_NUMBER = 0x15, /* property: serial number, table 10 */
    BIOTAC_PROPERTY_MAX = 100,   /* longest property, C library */
    BIOTAC_SLOTS_MAX = 64
};

/* Sequences of manual table 12. */
enum biotac_sequence {
    BIOTAC_ELECTRODES, /* E1..E24: 24 slots */
    BIOTAC_ALL,        /* PAC PDC TAC TDC E1..E24: 28 slots */
    BIOTAC_INTERLEAVED /* every other sample is PAC: 54 slots */
};

/* True if the byte has an odd number of ones. */
bool biotac_odd_parity(uint8_t byte);

/* First command byte that samples a channel: `1 CCCCCC P`, odd parity (manual figure 13).
 * 0 for channels other than PAC, PDC, TAC, TDC and E1..E24, above all for 16: its byte 0xA1 starts
 * the streaming loop of the old protocol V1.1, which a sensor leaves only after five seconds of
 * idle clock. */
uint8_t biotac_sample_command(uint8_t channel);

/* True if the byte is one that biotac_sample_command gives. */
bool biotac_is_sample_command(uint8_t byte);

/* True if two response bytes have the form `D11..D5 P  D4..D0 0 0 P`, odd parity each (figure 15).
 * No error word (table 8) and no undriven line (00 00, FF FF) has it. */
bool biotac_word_is_sound(uint8_t high, uint8_t low);

/* Write a sequence's command bytes, up to BIOTAC_SLOTS_MAX of them; gives their number. */
uint8_t biotac_commands(enum biotac_sequence sequence, uint8_t *command);

#ifdef __cplusplus
}
#endif

#endif
