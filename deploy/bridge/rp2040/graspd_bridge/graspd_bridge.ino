/* SPDX-License-Identifier: MIT */
/* The graspd bridge on a Raspberry Pi Pico (RP2040), Arduino core of Earle Philhower.
 *
 * NOT YET RUN ON HARDWARE, only on an emulated RP2040, and there on a stand-in for the Arduino core.
 *
 *   Pico    BioTac SP
 *   GP18    SCK      all sensors
 *   GP19    MOSI     all sensors
 *   GP16    MISO     all sensors (pulled up here, so that an absent sensor reads 0xFF)
 *   GP17    CS 1     first finger of the scene
 *   GP20    CS 2     second
 *   GP21    CS 3     third
 *   GP22    CS 4     fourth, if there is one
 *   GP26    CS 5     fifth
 *   3V3     supply   3.3 V: the Pico's pins do not bear 5 V
 *   GND     ground
 *
 * Build and flash it from the top folder of a checkout:
 *
 *   arduino-cli compile --fqbn rp2040:rp2040:rpipico --library deploy/bridge deploy/bridge/rp2040/graspd_bridge
 *   arduino-cli upload --fqbn rp2040:rp2040:rpipico --port /dev/ttyACM0 deploy/bridge/rp2040/graspd_bridge
 */
#include <SPI.h>
#include <bridge.h>
#include <hal.h>
#include <hardware/gpio.h>
#include <hardware/timer.h>
#include <pico/unique_id.h>

#ifndef BRIDGE_SENSORS
#define BRIDGE_SENSORS 3
#endif
#ifndef BRIDGE_SEQUENCE
#define BRIDGE_SEQUENCE BIOTAC_ELECTRODES
#endif

static const uint8_t SENSORS = BRIDGE_SENSORS;
static const enum biotac_sequence SEQUENCE = BRIDGE_SEQUENCE;
static const uint32_t PERIOD_US = 10000;
static const uint32_t SPI_HZ = 4400000; /* the chip takes the next lower that it can make */

static const uint8_t PIN_CLOCK = 18, PIN_MOSI_ALL = 19, PIN_MISO_ALL = 16;
static const uint8_t PIN_SELECT[PROTOCOL_SENSORS_MAX] = {17, 20, 21, 22, 26};

static struct bridge bridge;
static uint64_t reset_us;
static bool running;

extern "C" uint64_t hal_ticks_us(void)
{
    return time_us_64() - reset_us;
}

/* busy_wait_us_32 counts edges of the microsecond: n of them may take no more than n - 1
 * microseconds. */
extern "C" void hal_delay_us(uint32_t us)
{
    busy_wait_us_32(us + 1);
}

extern "C" void hal_select(uint8_t sensors)
{
    uint32_t mask = 0, released = 0;

    for (uint8_t i = 0; i < SENSORS; i++) {
        const uint32_t pin = UINT32_C(1) << PIN_SELECT[i];

        mask |= pin;
        released |= (sensors >> i & 1) ? 0 : pin;
    }
    gpio_put_masked(mask, released); /* all at once: the sensors sample at the same time */
}

extern "C" uint8_t hal_spi_transfer(uint8_t byte)
{
    return SPI.transfer(byte);
}

extern "C" size_t hal_link_read(uint8_t *data, size_t size)
{
    size_t taken = 0;

    while (taken < size && Serial.available() > 0) {
        data[taken++] = (uint8_t)Serial.read();
    }
    return taken;
}

extern "C" size_t hal_link_write(const uint8_t *data, size_t size)
{
    const int room = Serial.availableForWrite();

    if (room <= 0) {
        return 0;
    }
    return Serial.write(data, size < (size_t)room ? size : (size_t)room);
}

extern "C" void hal_board_id(char board[PROTOCOL_TEXT])
{
    static const char digits[] = "0123456789ABCDEF";
    pico_unique_board_id_t id;

    pico_get_unique_board_id(&id);
    for (uint8_t i = 0; i < PROTOCOL_TEXT / 2; i++) {
        board[2 * i] = digits[id.id[i] >> 4];
        board[2 * i + 1] = digits[id.id[i] & 15];
    }
}

void setup()
{
    struct bridge_config config = {};

    reset_us = time_us_64();
    for (uint8_t i = 0; i < SENSORS; i++) {
        digitalWrite(PIN_SELECT[i], HIGH);
        pinMode(PIN_SELECT[i], OUTPUT);
        digitalWrite(PIN_SELECT[i], HIGH);
    }
    SPI.setSCK(PIN_CLOCK);
    SPI.setTX(PIN_MOSI_ALL);
    SPI.setRX(PIN_MISO_ALL);
    SPI.begin(false);
    gpio_pull_up(PIN_MISO_ALL);
    SPI.beginTransaction(SPISettings(SPI_HZ, MSBFIRST, SPI_MODE0)); /* nobody else is on the bus */
    Serial.begin(115200);                                           /* USB: the rate means nothing */

    config.sensors = SENSORS;
    config.slots = biotac_commands(SEQUENCE, config.command);
    config.period_us = PERIOD_US;
    running = bridge_init(&bridge, &config);
}

void loop()
{
    if (running) {
        bridge_poll(&bridge);
    }
}
