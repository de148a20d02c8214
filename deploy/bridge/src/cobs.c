/* SPDX-License-Identifier: MIT */
#include "cobs.h"

#define BLOCK_FULL 0xFFu /* 254 bytes without a zero; no zero is meant to follow */

static void close_block(struct cobs_encoder *encoder)
{
    encoder->out[encoder->code_at] = encoder->code;
    encoder->code_at = encoder->at++;
    encoder->code = 1;
}

void cobs_begin(struct cobs_encoder *encoder, uint8_t *out)
{
    encoder->out = out;
    encoder->at = 1;
    encoder->code_at = 0;
    encoder->code = 1;
}

void cobs_put(struct cobs_encoder *encoder, uint8_t byte)
{
    if (encoder->code == BLOCK_FULL) {
        close_block(encoder);
    }
    if (byte == 0) {
        close_block(encoder);
    } else {
        encoder->out[encoder->at++] = byte;
        encoder->code++;
    }
}

size_t cobs_end(struct cobs_encoder *encoder)
{
    encoder->out[encoder->code_at] = encoder->code;
    return encoder->at;
}

bool cobs_decode(const uint8_t *data, size_t size, uint8_t *out, size_t *decoded)
{
    size_t at = 0, written = 0;

    while (at < size) {
        const uint8_t code = data[at++];
        uint8_t left;

        if (code == 0 || (size_t)(code - 1u) > size - at) {
            return false;
        }
        for (left = (uint8_t)(code - 1u); left > 0; left--) {
            if (data[at] == 0) {
                return false;
            }
            out[written++] = data[at++];
        }
        if (code != BLOCK_FULL && at < size) {
            out[written++] = 0;
        }
    }
    *decoded = written;
    return true;
}
