/* SPDX-License-Identifier: MIT */
#include "sim_sensor.h"

#include <stdio.h>
#include <string.h>

/* Error words, sent in place of data (manual tables 8 and 11; the last three from the C library).
 */
enum {
    ERROR_SAMPLING_DELAY = 0xA52D,
    ERROR_CHANNEL = 0xA558,
    ERROR_PARITY = 0xA545,
    ERROR_COMMAND = 0xA53F,
    ERROR_DELAY = 0xA52E
};

static bool odd(unsigned value)
{
    unsigned ones = 0;

    for (; value != 0; value >>= 1) {
        ones += value & 1u;
    }
    return ones % 2 == 1;
}

/* The response word of a count: `D11..D5 P  D4..D0 0 0 P` (manual figure 15). */
static uint16_t response_word(uint16_t count)
{
    unsigned high = (unsigned)(count / 32u) * 2u, low = (unsigned)(count % 32u) * 8u;

    high += odd(high) ? 0u : 1u;
    low += odd(low) ? 0u : 1u;
    return (uint16_t)(high * 256u + low);
}

static uint16_t electrode_word(const struct sim_sensor *sensor, unsigned electrode)
{
    if (sensor->forced >> electrode & 1u) {
        return sensor->forced_word[electrode];
    }
    return response_word(sensor->dead >> electrode & 1u ? 0 : sensor->count[electrode]);
}

/* The word that answers a sampling command; table 7 has channels 0..3, 15 (Hall) and 17..40. */
static uint16_t sampled_word(const struct sim_sensor *sensor, uint8_t command)
{
    const unsigned channel = command / 2u % 64u;

    if (!odd(command)) {
        return ERROR_PARITY;
    }
    if (channel >= 17 && channel <= 40) {
        return electrode_word(sensor, channel - 17);
    }
    switch (channel) {
    case 0: /* PAC at rest */
        return response_word(2048);
    case 1: /* PDC */
        return response_word(2100);
    case 2: /* TAC */
        return response_word(1990);
    case 3: /* TDC */
        return response_word(2500);
    case 15:
        return response_word(2047);
    default:
        return ERROR_CHANNEL;
    }
}

/* Prepare the answer to a property command (manual table 10). The first after power-up is empty:
 * the C library of SynTouch reads one in vain before it trusts the answer. */
static void take_property(struct sim_sensor *sensor)
{
    const char *text = "";

    memset(sensor->text, 0, sizeof sensor->text);
    sensor->answer = SIM_PROPERTY;
    if (sensor->awake) {
        switch (sensor->command[1]) {
        case 0x10: /* flex version */
            text = "2A";
            break;
        case 0x13: /* firmware version */
            text = "0200";
            break;
        case 0x15:
            text = sensor->serial;
            break;
        default:
            sensor->answer = SIM_WORD;
            sensor->word = ERROR_COMMAND;
            return;
        }
    }
    sensor->awake = true;
    memcpy(sensor->text, text, strnlen(text, SIM_TEXT));
}

static void take_command(struct sim_sensor *sensor, uint64_t now_ns)
{
    sensor->ready_ns = now_ns + sensor->settle_ns;
    if (sensor->command[0] == 0xA1) {
        sensor->streaming = true;
    } else if (sensor->command[0] & 0x80u) {
        sensor->answer = SIM_WORD;
        sensor->word = sampled_word(sensor, sensor->command[0]);
    } else if (sensor->command[0] == 0x61) {
        take_property(sensor);
    } else {
        sensor->answer = SIM_WORD;
        sensor->word = ERROR_COMMAND;
    }
}

void sim_sensor_init(struct sim_sensor *sensor, unsigned number)
{
    char text[SIM_TEXT + 1];

    memset(sensor, 0, sizeof *sensor);
    (void)snprintf(text, sizeof text, "BTSP%012u", number % 1000000u);
    memcpy(sensor->serial, text, sizeof sensor->serial);
    sensor->settle_ns = SIM_SETTLE_NS;
}

void sim_sensor_select(struct sim_sensor *sensor, bool selected, uint64_t now_ns)
{
    if (sensor->selected && !selected && sensor->answer == SIM_NOTHING && sensor->at >= 2) {
        take_command(sensor, now_ns);
    } else if (sensor->selected && !selected && sensor->at > 0) {
        sensor->answer = SIM_NOTHING; /* it was read, or the command was cut off */
    }
    sensor->selected = selected;
    sensor->at = 0;
}

static uint8_t answer_byte(struct sim_sensor *sensor, unsigned at, uint64_t now_ns)
{
    if (at == 0 && now_ns < sensor->ready_ns) {
        sensor->word = sensor->answer == SIM_WORD ? ERROR_SAMPLING_DELAY : ERROR_DELAY;
        sensor->answer = SIM_WORD;
    }
    if (sensor->answer == SIM_PROPERTY) {
        return at < sizeof sensor->text ? sensor->text[at] : 0;
    }
    return at > 1 ? 0 : (uint8_t)(at == 0 ? sensor->word >> 8 : sensor->word & 0xFFu);
}

uint8_t sim_sensor_transfer(struct sim_sensor *sensor, uint8_t mosi, uint64_t now_ns)
{
    const unsigned at = sensor->at++;

    if (sensor->unplugged) {
        sensor->answer = SIM_NOTHING;
        sensor->awake = false;
        sensor->at = 0;
        return 0xFF;
    }
    if (sensor->streaming) {
        return 0;
    }
    if (at == 0 && (mosi & 0x80u || mosi == 0x61)) {
        sensor->answer = SIM_NOTHING; /* a new command; what was not read is lost */
    }
    if (sensor->answer != SIM_NOTHING) {
        return answer_byte(sensor, at, now_ns);
    }
    if (at < sizeof sensor->command) {
        sensor->command[at] = mosi;
    }
    return 0;
}
