/* SPDX-License-Identifier: MIT */
/* Consistent overhead byte stuffing: bytes without zeros, so that a zero can end a frame.
 * Source: Cheshire and Baker, "Consistent Overhead Byte Stuffing", IEEE/ACM Trans. Networking 7(2),
 * 1999. */
#ifndef GRASPD_COBS_H
#define GRASPD_COBS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Most bytes that `size` bytes can become. */
#define COBS_ENCODED_MAX(size) ((size) + (size) / 254u + 1u)

struct cobs_encoder {
    uint8_t *out;
    size_t at;      /* bytes written */
    size_t code_at; /* place for the code of the current block */
    uint8_t code;   /* 1 + bytes in the current block */
};

/* Begin to encode into `out`, which must hold COBS_ENCODED_MAX of all that will be put. */
void cobs_begin(struct cobs_encoder *encoder, uint8_t *out);

/* Encode one more byte. */
void cobs_put(struct cobs_encoder *encoder, uint8_t byte);

/* Finish; gives the encoded size, without an ending zero. */
size_t cobs_end(struct cobs_encoder *encoder);

/* Decode `size` bytes into `out`, which must hold as many and may be `data` itself.
 * False if `data` holds a zero or a block is cut off; then `out` is meaningless. */
bool cobs_decode(const uint8_t *data, size_t size, uint8_t *out, size_t *decoded);

#ifdef __cplusplus
}
#endif

#endif
