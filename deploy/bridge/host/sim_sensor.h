/* SPDX-License-Identifier: MIT */
/* One simulated BioTac SP, byte by byte, in simulated time. Written from BioTac SP Product Manual
 * V2, section 8, without the bridge's own biotac.c, so that an error in one shows against the
 * other. */
#ifndef GRASPD_SIM_SENSOR_H
#define GRASPD_SIM_SENSOR_H

#include <stdbool.h>
#include <stdint.h>

enum { SIM_ELECTRODES = 24, SIM_TEXT = 16, SIM_SETTLE_NS = 50000 };

enum sim_answer { SIM_NOTHING, SIM_WORD, SIM_PROPERTY };

struct sim_sensor {
    /* Settings of the sensor; may be changed at any time between two transactions. */
    uint16_t count[SIM_ELECTRODES]; /* 0..4095 */
    char serial[SIM_TEXT];          /* NUL-padded */
    bool unplugged;                 /* MISO is pulled up: every byte is 0xFF */
    uint32_t dead;                  /* bit e: electrode e reads 0 */
    uint32_t forced;                /* bit e: electrode e answers forced_word[e] */
    uint16_t forced_word[SIM_ELECTRODES];
    uint64_t settle_ns; /* least time between a command and its answer, figure 14 */

    /* State of the protocol. */
    bool selected;
    bool awake;     /* a property was read before */
    bool streaming; /* command 0xA1 was sent: the sensor stays silent */
    uint8_t command[2];
    unsigned at; /* byte of the transaction */
    enum sim_answer answer;
    uint8_t text[SIM_TEXT + 1];
    uint16_t word;
    uint64_t ready_ns;
};

/* A sensor at rest with a serial number made of `number`. */
void sim_sensor_init(struct sim_sensor *sensor, unsigned number);

/* Chip select, active low: `selected` is true when it is pulled low. */
void sim_sensor_select(struct sim_sensor *sensor, bool selected, uint64_t now_ns);

/* Take one byte while selected, give the one on MISO; `now_ns`: when the first bit is clocked. */
uint8_t sim_sensor_transfer(struct sim_sensor *sensor, uint8_t mosi, uint64_t now_ns);

#endif
