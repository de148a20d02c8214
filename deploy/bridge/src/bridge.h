/* SPDX-License-Identifier: MIT */
/* The bridge: samples up to five BioTac SPs and sends each sweep to the host. See PROTOCOL.md. */
#ifndef GRASPD_BRIDGE_H
#define GRASPD_BRIDGE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "biotac.h"
#include "protocol.h"

#ifdef __cplusplus
extern "C" {
#endif

enum {
    BRIDGE_FIRMWARE = 0x0002, /* 0.2; 0.1 waited too little at 200 MHz */
    BRIDGE_TICK_HZ = 1000000,
    BRIDGE_STATUS_US = 1000000, /* STATUS once a second */
    BRIDGE_PERIOD_MIN_US = 200, /* a sweep over one slot takes 80 us at 4.4 MHz */
    BRIDGE_LATE_PART = 10,      /* a sweep later than a tenth of a period is an overrun */
    BRIDGE_TX_SIZE = 2048,      /* eleven sweeps of 24 slots and 3 sensors: 0.1 s at 100 Hz */
    BRIDGE_RX_CHUNK = 64        /* most bytes taken between two sweeps, one packet of USB */
};

struct bridge_config {
    uint8_t sensors;                   /* 1..5 */
    uint8_t slots;                     /* 1..64 */
    uint8_t command[BIOTAC_SLOTS_MAX]; /* first command byte of each slot */
    uint32_t period_us;                /* from one sweep to the next */
};

/* The state of the one bridge; a port only provides the room for it. */
struct bridge {
    struct bridge_config config;
    struct protocol_receiver receiver;
    char serial[PROTOCOL_SENSORS_MAX][PROTOCOL_TEXT];
    uint8_t present; /* bit i: sensor i had a serial number when it was last looked for */
    uint8_t silent;  /* bit i: sensor i gave no sound word in the last sweep */
    bool started;
    bool hello_asked;
    uint32_t hello_nonce;
    uint64_t hello_tick;
    uint64_t sweep_due_us;
    uint64_t status_due_us;
    uint32_t seq;
    uint32_t sweeps, overruns, tx_dropped;
    uint32_t spi_errors[PROTOCOL_SENSORS_MAX];
    uint8_t word[2 * BIOTAC_SLOTS_MAX * PROTOCOL_SENSORS_MAX];
    uint8_t frame[PROTOCOL_FRAME_MAX];
    uint8_t tx[BRIDGE_TX_SIZE]; /* a ring of whole frames */
    size_t tx_first, tx_used;
};

/* Look for the sensors and prepare the first HELLO. False if the configuration must not run: a
 * number is out of range, or a command samples nothing, such as 0xA1 (manual table 7). */
bool bridge_init(struct bridge *bridge, const struct bridge_config *config);

/* Do what is due: at most one sweep, some bytes from the host, a STATUS, bytes to the host. Call
 * without end. */
void bridge_poll(struct bridge *bridge);

/* Time (hal_ticks_us) at which bridge_poll has something to do even if no byte moves. */
uint64_t bridge_due_us(const struct bridge *bridge);

#ifdef __cplusplus
}
#endif

#endif
