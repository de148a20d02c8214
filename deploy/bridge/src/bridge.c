/* SPDX-License-Identifier: MIT */
#include "bridge.h"

#include <string.h>

#include "hal.h"

enum {
    FILLER_HIGH = 0x01,
    FILLER_LOW = 0x00
}; /* sent while an answer is read, manual section 8.3 */

static uint8_t bit(uint8_t sensor)
{
    return (uint8_t)(1u << sensor);
}

static uint8_t all_sensors(const struct bridge *bridge)
{
    return (uint8_t)((1u << bridge->config.sensors) - 1u);
}

/* ---- towards the host ------------------------------------------------------------------------ */

static bool fits(const struct bridge *bridge, size_t size)
{
    return size <= sizeof bridge->tx - bridge->tx_used;
}

/* Queue a frame for the host; one that has no room is dropped whole, and counted. */
static void queue(struct bridge *bridge, const uint8_t *data, size_t size)
{
    size_t i;

    if (!fits(bridge, size)) {
        bridge->tx_dropped++;
        return;
    }
    for (i = 0; i < size; i++) {
        bridge->tx[(bridge->tx_first + bridge->tx_used + i) % sizeof bridge->tx] = data[i];
    }
    bridge->tx_used += size;
}

static void flush(struct bridge *bridge)
{
    while (bridge->tx_used > 0) {
        const size_t to_end = sizeof bridge->tx - bridge->tx_first;
        const size_t size = bridge->tx_used < to_end ? bridge->tx_used : to_end;
        const size_t taken = hal_link_write(bridge->tx + bridge->tx_first, size);

        bridge->tx_first = (bridge->tx_first + taken) % sizeof bridge->tx;
        bridge->tx_used -= taken;
        if (taken < size) {
            return;
        }
    }
}

/* Queue the HELLO that was asked for; without room try again later, since a host that comes back to
 * a full queue needs it. */
static void send_hello(struct bridge *bridge)
{
    struct protocol_hello hello;
    size_t size;

    hello.nonce = bridge->hello_nonce;
    hello.tick = bridge->hello_tick;
    hello.tick_hz = BRIDGE_TICK_HZ;
    hello.firmware = BRIDGE_FIRMWARE;
    memset(hello.board, 0, sizeof hello.board);
    hal_board_id(hello.board);
    hello.period_ticks = bridge->config.period_us;
    hello.sensors = bridge->config.sensors;
    hello.slots = bridge->config.slots;
    hello.serial = (const char (*)[PROTOCOL_TEXT])bridge->serial;
    hello.command = bridge->config.command;
    size = protocol_encode_hello(&hello, bridge->frame);
    if (fits(bridge, size)) {
        queue(bridge, bridge->frame, size);
        bridge->hello_asked = false;
    }
}

static void ask_hello(struct bridge *bridge, uint32_t nonce)
{
    if (bridge->hello_asked) {
        bridge->tx_dropped++; /* the answer to an earlier PING never found room */
    }
    bridge->hello_asked = true;
    bridge->hello_nonce = nonce;
    bridge->hello_tick = hal_ticks_us();
    send_hello(bridge);
}

static void send_status(struct bridge *bridge)
{
    struct protocol_status status;

    status.tick = hal_ticks_us();
    status.sweeps = bridge->sweeps;
    status.overruns = bridge->overruns;
    status.tx_dropped = bridge->tx_dropped;
    status.rx_errors = bridge->receiver.errors;
    status.sensors = bridge->config.sensors;
    status.spi_errors = bridge->spi_errors;
    queue(bridge, bridge->frame, protocol_encode_status(&status, bridge->frame));
}

/* ---- sensors --------------------------------------------------------------------------------- */

/* Read a property (manual figure 13, table 10): its first PROTOCOL_TEXT bytes, NUL-padded. The
 * answer ends with 0x00 or 0xFF, as an absent sensor's does at once. */
static void read_property(uint8_t sensor, uint8_t property, uint8_t text[PROTOCOL_TEXT])
{
    uint8_t i, byte;

    memset(text, 0, PROTOCOL_TEXT);
    hal_select(bit(sensor));
    (void)hal_spi_transfer(BIOTAC_READ);
    (void)hal_spi_transfer(property);
    hal_select(0);
    hal_delay_us(BIOTAC_SETTLE_US);
    hal_select(bit(sensor));
    for (i = 0; i < BIOTAC_PROPERTY_MAX; i++) {
        byte = hal_spi_transfer(FILLER_LOW);
        if (byte == 0x00 || byte == 0xFF) {
            break;
        }
        if (i < PROTOCOL_TEXT) {
            text[i] = byte;
        }
    }
    hal_select(0);
    hal_delay_us(BIOTAC_GAP_US);
}

static bool is_serial_number(const uint8_t text[PROTOCOL_TEXT])
{
    uint8_t i;

    for (i = 0; i < PROTOCOL_TEXT && text[i] != 0; i++) {
        if (text[i] < 0x20 || text[i] > 0x7E) {
            return false;
        }
    }
    return text[0] == 'B' && text[1] == 'T';
}

/* Note whether a sensor is present: its serial number starts with "BT". The firmware version is
 * read twice first: the C library of SynTouch does, to wake the sensor. */
static void look_for(struct bridge *bridge, uint8_t sensor)
{
    uint8_t text[PROTOCOL_TEXT];

    read_property(sensor, BIOTAC_FIRMWARE, text);
    read_property(sensor, BIOTAC_FIRMWARE, text);
    read_property(sensor, BIOTAC_SERIAL_NUMBER, text);
    if (is_serial_number(text)) {
        bridge->present = (uint8_t)(bridge->present | bit(sensor));
    } else {
        bridge->present = (uint8_t)(bridge->present & ~bit(sensor));
        memset(text, 0, sizeof text);
    }
    memcpy(bridge->serial[sensor], text, sizeof text);
}

static void search(struct bridge *bridge, uint8_t sensors)
{
    uint8_t sensor;

    for (sensor = 0; sensor < bridge->config.sensors; sensor++) {
        if (sensors & bit(sensor)) {
            look_for(bridge, sensor);
        }
    }
}

/* One slot: all sensors sample at the same time, then each is read (manual section 8, figure 14).
 * Gives the sensors whose word is sound. */
static uint8_t sample(struct bridge *bridge, uint8_t command, uint8_t *word)
{
    uint8_t sensor, sound = 0;

    hal_select(all_sensors(bridge));
    (void)hal_spi_transfer(command);
    (void)hal_spi_transfer(0x00);
    hal_select(0);
    hal_delay_us(BIOTAC_SETTLE_US);
    for (sensor = 0; sensor < bridge->config.sensors; sensor++, word += 2) {
        hal_select(bit(sensor));
        word[0] = hal_spi_transfer(FILLER_HIGH);
        word[1] = hal_spi_transfer(FILLER_LOW);
        hal_select(0);
        hal_delay_us(BIOTAC_GAP_US);
        if (biotac_word_is_sound(word[0], word[1])) {
            sound = (uint8_t)(sound | bit(sensor));
        } else {
            bridge->spi_errors[sensor]++;
        }
    }
    return sound;
}

/* Set when the next sweep is due; count an overrun if the one that begins is late. Sweeps keep
 * their grid: after a late one the next is due at the next whole period, never in a burst. */
static void schedule_next(struct bridge *bridge, uint64_t now_us)
{
    const uint32_t period_us = bridge->config.period_us;

    if (now_us - bridge->sweep_due_us > period_us / BRIDGE_LATE_PART) {
        bridge->overruns++;
    }
    bridge->sweep_due_us += (now_us - bridge->sweep_due_us) / period_us * period_us + period_us;
}

static void make_sweep(struct bridge *bridge)
{
    struct protocol_sweep sweep;
    uint8_t slot, sound = 0;

    sweep.tick_start = hal_ticks_us();
    schedule_next(bridge, sweep.tick_start);
    for (slot = 0; slot < bridge->config.slots; slot++) {
        uint8_t *const word = bridge->word + (size_t)2 * slot * bridge->config.sensors;

        sound = (uint8_t)(sound | sample(bridge, bridge->config.command[slot], word));
    }
    sweep.tick_end = hal_ticks_us();
    bridge->silent = (uint8_t)(all_sensors(bridge) & ~sound);
    bridge->sweeps++;
    sweep.seq = bridge->seq++;
    sweep.present = bridge->present;
    sweep.sensors = bridge->config.sensors;
    sweep.slots = bridge->config.slots;
    sweep.word = bridge->word;
    queue(bridge, bridge->frame, protocol_encode_sweep(&sweep, bridge->frame));
}

/* ---- the loop -------------------------------------------------------------------------------- */

static void handle(struct bridge *bridge, const struct protocol_host_frame *frame)
{
    if (frame->type == PROTOCOL_PING) {
        ask_hello(bridge, frame->nonce);
    } else if (frame->type == PROTOCOL_STOP) {
        bridge->started = false;
        search(bridge, all_sensors(bridge));
    } else if (frame->type == PROTOCOL_START && !bridge->started) {
        bridge->started = true;
        bridge->seq = 0;
        bridge->silent = 0;
        bridge->sweep_due_us = hal_ticks_us();
    }
}

static void listen(struct bridge *bridge)
{
    uint8_t data[BRIDGE_RX_CHUNK];
    const size_t size = hal_link_read(data, sizeof data);
    struct protocol_host_frame frame;
    size_t i;

    for (i = 0; i < size; i++) {
        if (protocol_receive(&bridge->receiver, data[i], &frame)) {
            handle(bridge, &frame);
        }
    }
}

/* Once a second: send a STATUS and look for sensors. While sweeping, only for those that seem to be
 * gone: a sensor that samples well is left alone. */
static void report(struct bridge *bridge, uint64_t now_us)
{
    send_status(bridge);
    bridge->status_due_us += BRIDGE_STATUS_US;
    if (bridge->status_due_us <= now_us) {
        bridge->status_due_us = now_us + BRIDGE_STATUS_US;
    }
    search(bridge,
           bridge->started ? (uint8_t)(bridge->silent | ~bridge->present) : all_sensors(bridge));
}

static bool may_run(const struct bridge_config *config)
{
    uint8_t slot;

    if (config->sensors < 1 || config->sensors > PROTOCOL_SENSORS_MAX || config->slots < 1 ||
        config->slots > BIOTAC_SLOTS_MAX || config->period_us < BRIDGE_PERIOD_MIN_US) {
        return false;
    }
    for (slot = 0; slot < config->slots; slot++) {
        if (!biotac_is_sample_command(config->command[slot])) {
            return false;
        }
    }
    return true;
}

bool bridge_init(struct bridge *bridge, const struct bridge_config *config)
{
    static const uint8_t end_of_frame = 0;

    if (!may_run(config)) {
        return false;
    }
    memset(bridge, 0, sizeof *bridge);
    bridge->config = *config;
    bridge->status_due_us = hal_ticks_us() + BRIDGE_STATUS_US;
    hal_select(0);
    search(bridge, all_sensors(bridge));
    queue(bridge, &end_of_frame, sizeof end_of_frame);
    ask_hello(bridge, 0);
    return true;
}

void bridge_poll(struct bridge *bridge)
{
    const uint64_t now_us = hal_ticks_us();

    if (bridge->started && now_us >= bridge->sweep_due_us) {
        make_sweep(bridge);
        flush(bridge);
    }
    listen(bridge);
    if (now_us >= bridge->status_due_us) {
        report(bridge, now_us);
    }
    if (bridge->hello_asked) {
        send_hello(bridge);
    }
    flush(bridge);
}

uint64_t bridge_due_us(const struct bridge *bridge)
{
    return bridge->started && bridge->sweep_due_us < bridge->status_due_us ? bridge->sweep_due_us
                                                                           : bridge->status_due_us;
}
