/* SPDX-License-Identifier: MIT */
/* Lets another program compare this implementation with its own, byte by byte.
 *
 * Without an argument: a request per line of standard input, an answer per line of standard output;
 * bytes are hex, "-" for none. With the argument `receive`: standard input is what a host sends;
 * the frames found in it are printed, then the number of errors. */
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "biotac.h"
#include "cobs.h"
#include "crc32.h"
#include "protocol.h"

enum { LINE_SIZE = 8192, BYTES_MAX = 4000 };

static char line[LINE_SIZE];

static void malformed(void)
{
    (void)fprintf(stderr, "malformed request\n");
    exit(2);
}

static const char *word(void)
{
    const char *text = strtok(NULL, " \n");

    if (text == NULL) {
        malformed();
    }
    return text;
}

static uint64_t number(void)
{
    return strtoull(word(), NULL, 10);
}

static size_t bytes(uint8_t *out)
{
    const char *text = word();
    size_t size = 0;

    for (; *text != '-' && text[0] != '\0' && text[1] != '\0'; text += 2) {
        const char pair[] = {text[0], text[1], '\0'};

        if (size == BYTES_MAX) {
            malformed();
        }
        out[size++] = (uint8_t)strtoul(pair, NULL, 16);
    }
    return size;
}

static void print_bytes(const uint8_t *data, size_t size)
{
    size_t i;

    for (i = 0; i < size; i++) {
        (void)printf("%02x", data[i]);
    }
    (void)printf(size == 0 ? "-\n" : "\n");
}

static void answer_crc(void)
{
    static uint8_t data[BYTES_MAX];
    uint32_t crc = (uint32_t)number();
    const size_t size = bytes(data);
    size_t i;

    for (i = 0; i < size; i++) {
        crc = crc32_byte(crc, data[i]);
    }
    (void)printf("%" PRIu32 "\n", crc);
}

static void answer_encode(void)
{
    static uint8_t data[BYTES_MAX], out[COBS_ENCODED_MAX(BYTES_MAX)];
    const size_t size = bytes(data);
    struct cobs_encoder encoder;
    size_t i;

    cobs_begin(&encoder, out);
    for (i = 0; i < size; i++) {
        cobs_put(&encoder, data[i]);
    }
    print_bytes(out, cobs_end(&encoder));
}

static void answer_decode(void)
{
    static uint8_t data[BYTES_MAX];
    size_t size = bytes(data);

    if (cobs_decode(data, size, data, &size)) {
        print_bytes(data, size);
    } else {
        (void)printf("bad\n");
    }
}

static void answer_hello(void)
{
    static uint8_t board[BYTES_MAX], serials[BYTES_MAX], command[BYTES_MAX];
    static char serial[PROTOCOL_SENSORS_MAX][PROTOCOL_TEXT];
    static uint8_t out[PROTOCOL_FRAME_MAX];
    struct protocol_hello hello;

    memset(board, 0, sizeof board);
    hello.nonce = (uint32_t)number();
    hello.tick = number();
    hello.tick_hz = (uint32_t)number();
    hello.firmware = (uint16_t)number();
    (void)bytes(board);
    memcpy(hello.board, board, PROTOCOL_TEXT);
    hello.period_ticks = (uint32_t)number();
    hello.sensors = (uint8_t)number();
    hello.slots = (uint8_t)number();
    if (bytes(serials) != (size_t)hello.sensors * PROTOCOL_TEXT || bytes(command) != hello.slots ||
        hello.sensors > PROTOCOL_SENSORS_MAX || hello.slots > BIOTAC_SLOTS_MAX) {
        malformed();
    }
    memcpy(serial, serials, (size_t)hello.sensors * PROTOCOL_TEXT);
    hello.serial = (const char (*)[PROTOCOL_TEXT])serial;
    hello.command = command;
    print_bytes(out, protocol_encode_hello(&hello, out));
}

static void answer_sweep(void)
{
    static uint8_t words[BYTES_MAX], out[PROTOCOL_FRAME_MAX];
    struct protocol_sweep sweep;

    sweep.seq = (uint32_t)number();
    sweep.tick_start = number();
    sweep.tick_end = number();
    sweep.present = (uint8_t)number();
    sweep.sensors = (uint8_t)number();
    sweep.slots = (uint8_t)number();
    if (bytes(words) != (size_t)2 * sweep.sensors * sweep.slots ||
        sweep.sensors > PROTOCOL_SENSORS_MAX || sweep.slots > BIOTAC_SLOTS_MAX) {
        malformed();
    }
    sweep.word = words;
    print_bytes(out, protocol_encode_sweep(&sweep, out));
}

static void answer_status(void)
{
    static uint8_t out[PROTOCOL_FRAME_MAX];
    uint32_t errors[PROTOCOL_SENSORS_MAX];
    struct protocol_status status;
    unsigned i;

    status.tick = number();
    status.sweeps = (uint32_t)number();
    status.overruns = (uint32_t)number();
    status.tx_dropped = (uint32_t)number();
    status.rx_errors = (uint32_t)number();
    status.sensors = (uint8_t)number();
    for (i = 0; i < status.sensors && i < PROTOCOL_SENSORS_MAX; i++) {
        errors[i] = (uint32_t)number();
    }
    status.spi_errors = errors;
    print_bytes(out, protocol_encode_status(&status, out));
}

/* All 256 channels' command bytes, then which of all 65536 words are sound, as text of 0 and 1. */
static void answer_tables(void)
{
    unsigned i;

    for (i = 0; i < 256; i++) {
        (void)printf("%02x", biotac_sample_command((uint8_t)i));
    }
    (void)printf(" ");
    for (i = 0; i < 65536; i++) {
        (void)printf("%d", biotac_word_is_sound((uint8_t)(i >> 8), (uint8_t)(i & 0xFFu)));
    }
    (void)printf("\n");
}

static void answer_sequence(void)
{
    uint8_t command[BIOTAC_SLOTS_MAX];

    print_bytes(command, biotac_commands((enum biotac_sequence)number(), command));
}

static const struct {
    const char *name;
    void (*answer)(void);
} requests[] = {
    {"crc", answer_crc},       {"encode", answer_encode},     {"decode", answer_decode},
    {"hello", answer_hello},   {"sweep", answer_sweep},       {"status", answer_status},
    {"tables", answer_tables}, {"sequence", answer_sequence},
};

static void answer_line(void)
{
    const char *name = strtok(line, " \n");
    size_t i;

    for (i = 0; name != NULL && i < sizeof requests / sizeof requests[0]; i++) {
        if (strcmp(name, requests[i].name) == 0) {
            requests[i].answer();
            return;
        }
    }
    malformed();
}

static void receive_all(void)
{
    static struct protocol_receiver receiver;
    struct protocol_host_frame frame;
    int byte;

    while ((byte = getchar()) != EOF) {
        if (protocol_receive(&receiver, (uint8_t)byte, &frame)) {
            (void)printf("%02x %" PRIu32 "\n", (unsigned)frame.type, frame.nonce);
        }
    }
    (void)printf("errors %" PRIu32 "\n", receiver.errors);
}

int main(int count, char **argument)
{
    if (count > 1 && strcmp(argument[1], "receive") == 0) {
        receive_all();
        return 0;
    }
    while (fgets(line, sizeof line, stdin) != NULL) {
        answer_line();
    }
    return 0;
}
