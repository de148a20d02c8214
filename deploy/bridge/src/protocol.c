/* SPDX-License-Identifier: MIT */
#include "protocol.h"

#include "crc32.h"

enum { CRC_SIZE = 4, NONCE_SIZE = 4 };

/* ---- encoding -------------------------------------------------------------------------------- */

struct writer {
    struct cobs_encoder cobs;
    uint32_t crc;
};

static void put_u8(struct writer *writer, uint8_t value)
{
    writer->crc = crc32_byte(writer->crc, value);
    cobs_put(&writer->cobs, value);
}

static void put_u32(struct writer *writer, uint32_t value)
{
    unsigned shift;

    for (shift = 0; shift < 32; shift += 8) {
        put_u8(writer, (uint8_t)(value >> shift));
    }
}

static void put_u64(struct writer *writer, uint64_t value)
{
    put_u32(writer, (uint32_t)value);
    put_u32(writer, (uint32_t)(value >> 32));
}

static void put_bytes(struct writer *writer, const uint8_t *data, size_t size)
{
    size_t i;

    for (i = 0; i < size; i++) {
        put_u8(writer, data[i]);
    }
}

static void put_text(struct writer *writer, const char *text)
{
    size_t i;

    for (i = 0; i < PROTOCOL_TEXT; i++) {
        put_u8(writer, (uint8_t)text[i]);
    }
}

/* Initial value of a checksum: the schema's digest, but 0 for HELLO and PING, by which two versions
 * tell each other apart. */
static uint32_t crc_start(uint8_t type)
{
    return type == PROTOCOL_HELLO || type == PROTOCOL_PING ? 0 : PROTOCOL_DIGEST;
}

static void begin(struct writer *writer, uint8_t *out, enum protocol_type type)
{
    cobs_begin(&writer->cobs, out);
    writer->crc = crc_start((uint8_t)type);
    put_u8(writer, (uint8_t)type);
}

static size_t end(struct writer *writer)
{
    size_t size;

    put_u32(writer, writer->crc);
    size = cobs_end(&writer->cobs);
    writer->cobs.out[size] = 0;
    return size + 1;
}

size_t protocol_encode_hello(const struct protocol_hello *hello, uint8_t *out)
{
    struct writer writer;
    uint8_t sensor;

    begin(&writer, out, PROTOCOL_HELLO);
    put_u8(&writer, PROTOCOL_VERSION);
    put_u32(&writer, PROTOCOL_DIGEST);
    put_u32(&writer, hello->nonce);
    put_u64(&writer, hello->tick);
    put_u32(&writer, hello->tick_hz);
    put_u8(&writer, (uint8_t)(hello->firmware & 0xFFu));
    put_u8(&writer, (uint8_t)(hello->firmware >> 8));
    put_text(&writer, hello->board);
    put_u32(&writer, hello->period_ticks);
    put_u8(&writer, hello->sensors);
    put_u8(&writer, hello->slots);
    for (sensor = 0; sensor < hello->sensors; sensor++) {
        put_text(&writer, hello->serial[sensor]);
    }
    put_bytes(&writer, hello->command, hello->slots);
    return end(&writer);
}

size_t protocol_encode_sweep(const struct protocol_sweep *sweep, uint8_t *out)
{
    struct writer writer;

    begin(&writer, out, PROTOCOL_SWEEP);
    put_u32(&writer, sweep->seq);
    put_u64(&writer, sweep->tick_start);
    put_u64(&writer, sweep->tick_end);
    put_u8(&writer, sweep->present);
    put_u8(&writer, sweep->sensors);
    put_u8(&writer, sweep->slots);
    put_bytes(&writer, sweep->word, (size_t)2 * sweep->slots * sweep->sensors);
    return end(&writer);
}

size_t protocol_encode_status(const struct protocol_status *status, uint8_t *out)
{
    struct writer writer;
    uint8_t sensor;

    begin(&writer, out, PROTOCOL_STATUS);
    put_u64(&writer, status->tick);
    put_u32(&writer, status->sweeps);
    put_u32(&writer, status->overruns);
    put_u32(&writer, status->tx_dropped);
    put_u32(&writer, status->rx_errors);
    put_u8(&writer, status->sensors);
    for (sensor = 0; sensor < status->sensors; sensor++) {
        put_u32(&writer, status->spi_errors[sensor]);
    }
    return end(&writer);
}

/* ---- receiving ------------------------------------------------------------------------------- */

static uint32_t get_u32(const uint8_t *data)
{
    return (uint32_t)data[0] | (uint32_t)data[1] << 8 | (uint32_t)data[2] << 16 |
           (uint32_t)data[3] << 24;
}

/* Size of the host's frame of this type without its checksum, 0 if there is no such frame. */
static size_t host_frame_size(uint8_t type)
{
    switch (type) {
    case PROTOCOL_PING:
        return 1 + NONCE_SIZE;
    case PROTOCOL_START:
    case PROTOCOL_STOP:
        return 1;
    default:
        return 0;
    }
}

static bool decode(uint8_t *data, size_t size, struct protocol_host_frame *frame)
{
    size_t i, content;
    uint32_t crc;

    if (!cobs_decode(data, size, data, &size) || size <= CRC_SIZE) {
        return false;
    }
    content = size - CRC_SIZE;
    if (content != host_frame_size(data[0])) {
        return false;
    }
    crc = crc_start(data[0]);
    for (i = 0; i < content; i++) {
        crc = crc32_byte(crc, data[i]);
    }
    if (crc != get_u32(data + content)) {
        return false;
    }
    frame->type = (enum protocol_type)data[0];
    frame->nonce = frame->type == PROTOCOL_PING ? get_u32(data + 1) : 0;
    return true;
}

bool protocol_receive(struct protocol_receiver *receiver, uint8_t byte,
                      struct protocol_host_frame *frame)
{
    bool too_long = receiver->too_long;
    size_t size = receiver->size;

    if (byte != 0) {
        if (size < sizeof receiver->buffer) {
            receiver->buffer[receiver->size++] = byte;
        } else {
            receiver->too_long = true;
        }
        return false;
    }
    receiver->size = 0;
    receiver->too_long = false;
    if (size == 0) {
        return false;
    }
    if (too_long || !decode(receiver->buffer, size, frame)) {
        receiver->errors++;
        return false;
    }
    return true;
}
