/* SPDX-License-Identifier: MIT */
/* The bridge on simulated sensors, with time and link in the hands of the test. */
#include <inttypes.h>
#include <stdio.h>
#include <string.h>

#include "bridge.h"
#include "hal.h"
#include "sim_sensor.h"

/* ---- a checked fact -------------------------------------------------------------------------- */

static const char *test_name;
static unsigned failures;

static void check(bool holds, const char *what, int line)
{
    if (!holds) {
        failures++;
        (void)printf("FAIL %s: line %d: %s\n", test_name, line, what);
    }
}

#define CHECK(what) check((what), #what, __LINE__)

/* ---- hardware -------------------------------------------------------------------------------- */

enum { LINK_SIZE = 65536, LOG_SIZE = 4096 };

enum event_kind { SELECT, TRANSFER };

struct event {
    enum event_kind kind;
    uint8_t value;
    uint64_t start_ns, end_ns;
};

static struct sim_sensor sensor[PROTOCOL_SENSORS_MAX];
static unsigned sensors;
static uint64_t now_ns, byte_ns;
static uint8_t to_bridge[LINK_SIZE], from_bridge[LINK_SIZE];
static size_t to_bridge_at, to_bridge_size, from_bridge_size;
static size_t link_room; /* bytes that the host's side still takes */
static struct event event[LOG_SIZE];
static size_t events;
static struct bridge bridge;

static void log_event(enum event_kind kind, uint8_t value, uint64_t start_ns)
{
    if (events < LOG_SIZE) {
        event[events].kind = kind;
        event[events].value = value;
        event[events].start_ns = start_ns;
        event[events++].end_ns = now_ns;
    }
}

uint64_t hal_ticks_us(void)
{
    return now_ns / 1000;
}

void hal_delay_us(uint32_t us)
{
    now_ns += UINT64_C(1000) * us;
}

void hal_select(uint8_t selected)
{
    unsigned i;

    log_event(SELECT, selected, now_ns);
    for (i = 0; i < sensors; i++) {
        sim_sensor_select(&sensor[i], ((unsigned)selected >> i & 1u) != 0, now_ns);
    }
}

uint8_t hal_spi_transfer(uint8_t byte)
{
    const uint64_t start_ns = now_ns;
    uint8_t miso = 0xFF;
    unsigned i;

    for (i = 0; i < sensors; i++) {
        if (sensor[i].selected) {
            miso = (uint8_t)(miso & sim_sensor_transfer(&sensor[i], byte, now_ns));
        }
    }
    now_ns += byte_ns;
    log_event(TRANSFER, byte, start_ns);
    return miso;
}

size_t hal_link_read(uint8_t *data, size_t size)
{
    const size_t left = to_bridge_size - to_bridge_at;
    const size_t taken = left < size ? left : size;

    memcpy(data, to_bridge + to_bridge_at, taken);
    to_bridge_at += taken;
    return taken;
}

size_t hal_link_write(const uint8_t *data, size_t size)
{
    size_t taken = size < link_room ? size : link_room;

    if (taken > LINK_SIZE - from_bridge_size) {
        taken = LINK_SIZE - from_bridge_size;
    }
    memcpy(from_bridge + from_bridge_size, data, taken);
    from_bridge_size += taken;
    link_room -= taken;
    return taken;
}

void hal_board_id(char board[PROTOCOL_TEXT])
{
    memcpy(board, "test", 4);
}

/* ---- the host's side ------------------------------------------------------------------------- */

/* Frames of the host with their zeros, computed with Python's zlib and cobs; PING has the nonce 7.
 */
static const uint8_t PING[] = {0x03, 0x81, 0x07, 0x01, 0x01, 0x05, 0x86, 0x56, 0x73, 0xD7, 0x00};
static const uint8_t START[] = {0x06, 0x82, 0x84, 0xE3, 0x09, 0xBE, 0x00};
static const uint8_t STOP[] = {0x06, 0x83, 0x12, 0xD3, 0x0E, 0xC9, 0x00};

static void send(const uint8_t *data, size_t size)
{
    memcpy(to_bridge + to_bridge_size, data, size);
    to_bridge_size += size;
}

/* Frames of a type among all that came from the bridge; `last` gets the content of the last one. */
static unsigned frames_of(uint8_t type, uint8_t *last, size_t *last_size)
{
    static uint8_t data[LINK_SIZE];
    size_t at, begin = 0, size;
    unsigned found = 0;

    for (at = 0; at < from_bridge_size; at++) {
        if (from_bridge[at] != 0) {
            continue;
        }
        if (at > begin) {
            CHECK(cobs_decode(from_bridge + begin, at - begin, data, &size));
            if (data[0] == type) {
                found++;
                if (last != NULL) {
                    memcpy(last, data, size);
                    *last_size = size;
                }
            }
        }
        begin = at + 1;
    }
    CHECK(begin == from_bridge_size || link_room == 0);
    return found;
}

static uint32_t u32(const uint8_t *data)
{
    return (uint32_t)data[0] | (uint32_t)data[1] << 8 | (uint32_t)data[2] << 16 |
           (uint32_t)data[3] << 24;
}

/* Poll until `us` have passed, moving time on to whatever is due. */
static void run_us(uint64_t us)
{
    const uint64_t end_ns = now_ns + 1000 * us;

    while (now_ns < end_ns) {
        uint64_t due_ns;

        bridge_poll(&bridge);
        due_ns = 1000 * bridge_due_us(&bridge);
        if (due_ns > end_ns) {
            due_ns = end_ns;
        }
        if (due_ns > now_ns) {
            now_ns = due_ns;
        }
    }
}

static struct bridge_config config_of(uint8_t number, uint32_t period_us)
{
    struct bridge_config config;

    memset(&config, 0, sizeof config);
    config.sensors = number;
    config.slots = biotac_commands(BIOTAC_ELECTRODES, config.command);
    config.period_us = period_us;
    return config;
}

static void set_up(uint8_t number, uint32_t period_us)
{
    const struct bridge_config config = config_of(number, period_us);
    unsigned i, electrode;

    sensors = number;
    now_ns = 0;
    byte_ns = 1818; /* 8 bits at 4.4 MHz */
    to_bridge_at = to_bridge_size = from_bridge_size = events = 0;
    link_room = SIZE_MAX;
    for (i = 0; i < PROTOCOL_SENSORS_MAX; i++) {
        sim_sensor_init(&sensor[i], i + 1);
        for (electrode = 0; electrode < SIM_ELECTRODES; electrode++) {
            sensor[i].count[electrode] = (uint16_t)(1000 * i + electrode);
        }
    }
    CHECK(bridge_init(&bridge, &config));
}

/* ---- tests ----------------------------------------------------------------------------------- */

static void each_slot_has_the_order_and_waits_of_figure_14(void)
{
    size_t i = 0, slot, read;

    set_up(3, 10000);
    send(START, sizeof START);
    bridge_poll(&bridge);
    events = 0;
    bridge_poll(&bridge);
    CHECK(events == 24 * (4 + 3 * 4));
    for (slot = 0; slot < 24 && events == 24 * (4 + 3 * 4); slot++) {
        CHECK(event[i].kind == SELECT && event[i].value == 7);
        CHECK(event[i + 1].kind == TRANSFER && event[i + 1].value == bridge.config.command[slot]);
        CHECK(event[i + 2].kind == TRANSFER && event[i + 2].value == 0x00);
        CHECK(event[i + 3].kind == SELECT && event[i + 3].value == 0);
        CHECK(event[i + 4].start_ns - event[i + 3].start_ns >= 50000);
        for (read = 0, i += 4; read < 3; read++, i += 4) {
            CHECK(event[i].kind == SELECT && event[i].value == 1u << read);
            CHECK(event[i + 1].kind == TRANSFER && event[i + 1].value == 0x01);
            CHECK(event[i + 2].kind == TRANSFER && event[i + 2].value == 0x00);
            CHECK(event[i + 3].kind == SELECT && event[i + 3].value == 0);
            CHECK(i + 4 == events || event[i + 4].start_ns - event[i + 3].end_ns >= 5000);
        }
    }
}

/* 24 slots * (4 words of 16 bits at 4.4 MHz + 50 us + 3 * 5 us) = 1909 us. */
static void a_sweep_takes_1_9_ms_at_4_4_mhz(void)
{
    uint8_t frame[1024];
    size_t size = 0;
    uint32_t took;

    set_up(3, 10000);
    send(START, sizeof START);
    run_us(1);
    CHECK(frames_of(PROTOCOL_SWEEP, frame, &size) == 1);
    CHECK(size == 1 + 167 + 4);
    took = u32(frame + 1 + 12) - u32(frame + 1 + 4);
    CHECK(took >= 1900 && took <= 1920);
}

static void words_carry_the_counts_of_each_sensor(void)
{
    uint8_t frame[1024], slot, i;
    size_t size = 0;

    set_up(5, 10000);
    send(START, sizeof START);
    run_us(1);
    CHECK(frames_of(PROTOCOL_SWEEP, frame, &size) == 1);
    for (slot = 0; slot < 24; slot++) {
        for (i = 0; i < 5; i++) {
            const uint8_t *word = frame + 1 + 23 + 2 * (5 * slot + i);

            CHECK((word[0] >> 1) * 32 + (word[1] >> 3) == 1000 * i + slot);
        }
    }
    CHECK(bridge.present == 0x1F);
}

static void a_hello_comes_after_reset_and_with_every_ping(void)
{
    uint8_t frame[1024];
    size_t size = 0;

    set_up(3, 10000);
    run_us(1);
    CHECK(from_bridge[0] == 0);
    CHECK(frames_of(PROTOCOL_HELLO, frame, &size) == 1 && u32(frame + 6) == 0);
    send(PING, sizeof PING);
    send(PING, sizeof PING);
    now_ns = 123456789000;
    bridge_poll(&bridge);
    CHECK(frames_of(PROTOCOL_HELLO, frame, &size) == 3 && u32(frame + 6) == 7);
    CHECK(u32(frame + 10) == 123456789);
}

static void a_sensor_is_present_if_its_serial_number_starts_with_bt(void)
{
    set_up(5, 10000);
    memcpy(sensor[0].serial, "BTTB0000000000", 15);
    memcpy(sensor[1].serial, "XTSP0000000000", 15);
    memcpy(sensor[2].serial, "BXSP0000000000", 15);
    sensor[3].unplugged = true;
    sensor[4].serial[6] = (char)0x80;
    send(STOP, sizeof STOP);
    bridge_poll(&bridge);
    CHECK(bridge.present == 0x01);
    CHECK(memcmp(bridge.serial[0], "BTTB0000000000\0", 16) == 0);
    CHECK(bridge.serial[1][0] == '\0' && bridge.serial[3][0] == '\0');
}

static void a_sensor_that_comes_back_is_found_within_a_second_of_sweeping(void)
{
    set_up(3, 10000);
    send(START, sizeof START);
    run_us(100000);
    CHECK(bridge.present == 7);
    sensor[1].unplugged = true;
    run_us(1100000);
    CHECK(bridge.present == 5 && bridge.serial[1][0] == '\0');
    sensor[1].unplugged = false;
    run_us(1100000);
    CHECK(bridge.present == 7 && memcmp(bridge.serial[1], "BTSP000000000002", 16) == 0);
}

static void a_sensor_that_samples_well_is_not_asked_for_properties(void)
{
    size_t i;

    set_up(3, 10000);
    send(START, sizeof START);
    run_us(900000);
    events = 0;
    run_us(101000); /* long enough for a STATUS */
    CHECK(events > 0 && events < LOG_SIZE);
    for (i = 0; i < events; i++) {
        CHECK(event[i].kind != TRANSFER || event[i].value != 0x61);
    }
}

static void start_counts_from_zero_and_is_ignored_while_sweeping(void)
{
    uint8_t frame[1024];
    size_t size = 0;

    set_up(3, 10000);
    send(START, sizeof START);
    run_us(45000); /* sweeps at 0, 10, 20, 30, 40 ms */
    send(START, sizeof START);
    run_us(10000);
    CHECK(frames_of(PROTOCOL_SWEEP, frame, &size) == 6 && u32(frame + 1) == 5);
    send(STOP, sizeof STOP);
    run_us(100000);
    CHECK(frames_of(PROTOCOL_SWEEP, frame, &size) == 6);
    send(START, sizeof START);
    run_us(5000);
    CHECK(frames_of(PROTOCOL_SWEEP, frame, &size) == 7 && u32(frame + 1) == 0);
    CHECK(bridge.sweeps == 7 && bridge.overruns == 0);
}

static void status_comes_once_a_second_started_or_not(void)
{
    set_up(3, 10000);
    run_us(3500000);
    CHECK(frames_of(PROTOCOL_STATUS, NULL, NULL) == 3);
    send(START, sizeof START);
    run_us(2000000);
    CHECK(frames_of(PROTOCOL_STATUS, NULL, NULL) == 5);
}

static void a_sweep_that_takes_longer_than_the_period_is_an_overrun(void)
{
    set_up(3, 1000); /* a sweep takes 1.9 ms */
    send(START, sizeof START);
    run_us(20000);
    CHECK(bridge.sweeps >= 9 && bridge.sweeps <= 11);
    CHECK(bridge.overruns == bridge.sweeps - 1);
}

static void a_late_bridge_does_not_catch_up_in_a_burst(void)
{
    uint32_t sweeps;

    set_up(3, 10000);
    send(START, sizeof START);
    run_us(25000);
    now_ns += 100000000; /* the bridge was held up for 100 ms */
    sweeps = bridge.sweeps;
    run_us(1);
    CHECK(bridge.sweeps == sweeps + 1 && bridge.overruns == 1);
    CHECK(bridge.sweep_due_us % 10000 < 2000); /* on the grid of periods since START */
    run_us(30000);
    CHECK(bridge.sweeps <= sweeps + 1 + 4 && bridge.overruns == 1);
}

static void a_link_that_stalls_loses_whole_frames_and_counts_them(void)
{
    uint8_t frame[1024];
    size_t size = 0;
    unsigned arrived, hellos = 0;

    set_up(3, 10000);
    send(START, sizeof START);
    link_room = 500; /* the link stalls in the middle of a frame */
    run_us(600000);
    CHECK(bridge.tx_dropped > 0 && from_bridge_size == 500);
    while (!bridge.hello_asked &&
           hellos < 20) { /* each takes room in the queue until one has none */
        send(PING, sizeof PING);
        bridge_poll(&bridge);
        hellos++;
    }
    CHECK(bridge.hello_asked);
    link_room = SIZE_MAX;
    run_us(300000);
    arrived = frames_of(PROTOCOL_SWEEP, frame, &size);
    CHECK(arrived + bridge.tx_dropped == bridge.sweeps);
    CHECK(u32(frame + 1) == bridge.sweeps - 1);
    CHECK(frames_of(PROTOCOL_HELLO, frame, &size) == 1 + hellos && u32(frame + 6) == 7);
}

static void bad_words_are_counted_for_their_sensor(void)
{
    set_up(3, 10000);
    sensor[0].forced = 1u;
    sensor[0].forced_word[0] = 0xA52D;
    sensor[2].unplugged = true;
    send(START, sizeof START);
    run_us(1);
    CHECK(bridge.spi_errors[0] == 1 && bridge.spi_errors[1] == 0 && bridge.spi_errors[2] == 24);
    CHECK(bridge.silent == 4);
}

static void a_sensor_read_too_early_answers_an_error_word(void)
{
    set_up(3, 10000);
    sensor[1].settle_ns = 60000;
    send(START, sizeof START);
    run_us(1);
    CHECK(bridge.word[2] == 0xA5 && bridge.word[3] == 0x2D);
    CHECK(bridge.spi_errors[1] == 24);
}

static uint16_t ask(uint8_t command, uint32_t wait_us)
{
    uint8_t high, low;

    hal_select(1);
    (void)hal_spi_transfer(command);
    (void)hal_spi_transfer(0);
    hal_select(0);
    hal_delay_us(wait_us);
    hal_select(1);
    high = hal_spi_transfer(1);
    low = hal_spi_transfer(0);
    hal_select(0);
    return (uint16_t)(high << 8 | low);
}

/* The words of manual tables 7, 8 and 11, and of the C library. */
static void the_simulated_sensor_answers_as_the_manual_says(void)
{
    set_up(1, 10000);
    sensor[0].count[0] = 2602;
    CHECK(ask(0xA2, 50) == 0xA251);
    CHECK(ask(0xA2, 49) == 0xA52D);
    CHECK(ask(0xA3, 50) == 0xA545); /* even parity */
    CHECK(ask(0x89, 50) == 0xA558); /* channel 4 */
    CHECK(ask(0x20, 50) == 0xA53F);
    sensor[0].dead = 1;
    CHECK(ask(0xA2, 50) == 0x0101);
    sensor[0].unplugged = true;
    CHECK(ask(0xA2, 50) == 0xFFFF);
}

static void a_configuration_that_must_not_run_is_refused(void)
{
    struct bridge_config config = config_of(3, 10000);

    CHECK(bridge_init(&bridge, &config));
    config.command[5] = 0xA1; /* V1.1 streaming */
    CHECK(!bridge_init(&bridge, &config));
    config.command[5] = 0xA3; /* even parity */
    CHECK(!bridge_init(&bridge, &config));
    config.command[5] = 0;
    CHECK(!bridge_init(&bridge, &config));
    config = config_of(0, 10000);
    CHECK(!bridge_init(&bridge, &config));
    config = config_of(6, 10000);
    CHECK(!bridge_init(&bridge, &config));
    config = config_of(3, 0);
    CHECK(!bridge_init(&bridge, &config));
    config = config_of(3, 10000);
    config.slots = 0;
    CHECK(!bridge_init(&bridge, &config));
    config.slots = 65;
    CHECK(!bridge_init(&bridge, &config));
}

#define TEST(name) {#name, name}

static const struct {
    const char *name;
    void (*run)(void);
} tests[] = {
    TEST(each_slot_has_the_order_and_waits_of_figure_14),
    TEST(a_sweep_takes_1_9_ms_at_4_4_mhz),
    TEST(words_carry_the_counts_of_each_sensor),
    TEST(a_hello_comes_after_reset_and_with_every_ping),
    TEST(a_sensor_is_present_if_its_serial_number_starts_with_bt),
    TEST(a_sensor_that_comes_back_is_found_within_a_second_of_sweeping),
    TEST(a_sensor_that_samples_well_is_not_asked_for_properties),
    TEST(start_counts_from_zero_and_is_ignored_while_sweeping),
    TEST(status_comes_once_a_second_started_or_not),
    TEST(a_sweep_that_takes_longer_than_the_period_is_an_overrun),
    TEST(a_late_bridge_does_not_catch_up_in_a_burst),
    TEST(a_link_that_stalls_loses_whole_frames_and_counts_them),
    TEST(bad_words_are_counted_for_their_sensor),
    TEST(a_sensor_read_too_early_answers_an_error_word),
    TEST(the_simulated_sensor_answers_as_the_manual_says),
    TEST(a_configuration_that_must_not_run_is_refused),
};

int main(void)
{
    size_t i;

    for (i = 0; i < sizeof tests / sizeof tests[0]; i++) {
        const unsigned before = failures;

        test_name = tests[i].name;
        tests[i].run();
        (void)printf("%s %s\n", failures == before ? "ok" : "FAIL", test_name);
    }
    return failures == 0 ? 0 : 1;
}
