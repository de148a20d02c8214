/* SPDX-License-Identifier: MIT */
/* Frames of the graspd bridge protocol, version 1: see PROTOCOL.md, which is the definition. */
#ifndef GRASPD_PROTOCOL_H
#define GRASPD_PROTOCOL_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "biotac.h"
#include "cobs.h"

#ifdef __cplusplus
extern "C" {
#endif

#define PROTOCOL_DIGEST 0x0D99E4D6u /* CRC-32 of the schema in PROTOCOL.md */

enum {
    PROTOCOL_VERSION = 1,
    PROTOCOL_SENSORS_MAX = 5,
    PROTOCOL_TEXT = 16, /* bytes of a board id and of a serial number, NUL-padded */
    /* The longest frame is a SWEEP of 64 slots and 5 sensors: type, 23 bytes, 640 of words,
       checksum. */
    PROTOCOL_SWEEP_MAX = 1 + 23 + 2 * BIOTAC_SLOTS_MAX * PROTOCOL_SENSORS_MAX + 4,
    PROTOCOL_HOST_FRAME_MAX = 32 /* the host's longest frame, PING, has 10 encoded bytes */
};

/* Room for any frame of the bridge with its ending zero. */
#define PROTOCOL_FRAME_MAX (COBS_ENCODED_MAX(PROTOCOL_SWEEP_MAX) + 1u)

enum protocol_type {
    PROTOCOL_HELLO = 0x01,
    PROTOCOL_SWEEP = 0x02,
    PROTOCOL_STATUS = 0x03,
    PROTOCOL_PING = 0x81,
    PROTOCOL_START = 0x82,
    PROTOCOL_STOP = 0x83
};

struct protocol_hello {
    uint32_t nonce;
    uint64_t tick;
    uint32_t tick_hz;
    uint16_t firmware; /* major * 256 + minor */
    char board[PROTOCOL_TEXT];
    uint32_t period_ticks;
    uint8_t sensors, slots;
    const char (*serial)[PROTOCOL_TEXT]; /* one per sensor */
    const uint8_t *command;              /* one per slot */
};

struct protocol_sweep {
    uint32_t seq;
    uint64_t tick_start, tick_end;
    uint8_t present, sensors, slots;
    const uint8_t *word; /* [slots][sensors][2], high byte first */
};

struct protocol_status {
    uint64_t tick;
    uint32_t sweeps, overruns, tx_dropped, rx_errors;
    uint8_t sensors;
    const uint32_t *spi_errors; /* one per sensor */
};

/* Write one frame with its ending zero into `out`, which must hold PROTOCOL_FRAME_MAX; gives its
 * size. */
size_t protocol_encode_hello(const struct protocol_hello *hello, uint8_t *out);
size_t protocol_encode_sweep(const struct protocol_sweep *sweep, uint8_t *out);
size_t protocol_encode_status(const struct protocol_status *status, uint8_t *out);

struct protocol_host_frame {
    enum protocol_type type;
    uint32_t nonce; /* of a PING */
};

/* State of receiving the host's frames. All zeros to begin with. */
struct protocol_receiver {
    uint8_t buffer[PROTOCOL_HOST_FRAME_MAX];
    size_t size;
    bool too_long;
    uint32_t errors; /* frames that were damaged, too long or unknown */
};

/* Take one byte; true if it ended a sound frame, which is then in `frame`. */
bool protocol_receive(struct protocol_receiver *receiver, uint8_t byte,
                      struct protocol_host_frame *frame);

#ifdef __cplusplus
}
#endif

#endif
