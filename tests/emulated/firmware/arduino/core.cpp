/* SPDX-License-Identifier: MIT */
/* The sketch, unchanged, on the pico-sdk: each call does what the Arduino core of Earle Philhower
 * does with the SDK, in the same order. Not shown: that core serves USB from an interrupt as well,
 * so that its sweeps may be interrupted. */
#include "Arduino.h"
#include SKETCH

#include "hardware/spi.h"
#include "tusb.h"

SerialUSB Serial;
SPIClass SPI;

void pinMode(uint8_t pin, int mode)
{
    gpio_init(pin);
    gpio_set_dir(pin, mode == OUTPUT);
}

void digitalWrite(uint8_t pin, int value)
{
    gpio_put(pin, value != LOW);
}

void SerialUSB::begin(unsigned long) {}

int SerialUSB::available()
{
    tud_task();
    return (int)tud_cdc_available();
}

int SerialUSB::read()
{
    tud_task();
    return tud_cdc_available() > 0 ? (int)tud_cdc_read_char() : -1;
}

int SerialUSB::availableForWrite()
{
    tud_task();
    return (int)tud_cdc_write_available();
}

/* The core waits up to a second for room; the sketch never hands over more than there is. */
size_t SerialUSB::write(const uint8_t *data, size_t size)
{
    size_t written = 0;

    if (tud_cdc_connected()) {
        written = tud_cdc_write(data, (uint32_t)size);
        tud_task();
        tud_cdc_write_flush();
    }
    tud_task();
    return written;
}

bool SPIClass::setRX(uint8_t pin)
{
    rx = pin;
    return true;
}

bool SPIClass::setTX(uint8_t pin)
{
    tx = pin;
    return true;
}

bool SPIClass::setSCK(uint8_t pin)
{
    sck = pin;
    return true;
}

void SPIClass::begin(bool)
{
    gpio_set_function(rx, GPIO_FUNC_SPI);
    gpio_set_function(sck, GPIO_FUNC_SPI);
    gpio_set_function(tx, GPIO_FUNC_SPI);
}

void SPIClass::beginTransaction(SPISettings settings)
{
    spi_init(spi0, settings.hz);
    spi_set_format(spi0, 8, SPI_CPOL_0, SPI_CPHA_0, SPI_MSB_FIRST);
}

uint8_t SPIClass::transfer(uint8_t data)
{
    uint8_t answer;

    hw_write_masked(&spi_get_hw(spi0)->cr0, (8 - 1) << SPI_SSPCR0_DSS_LSB, SPI_SSPCR0_DSS_BITS);
    spi_write_read_blocking(spi0, &data, &answer, 1);
    return answer;
}

int main()
{
    tusb_init(); /* the core starts USB before setup() */
    setup();
    for (;;) {
        loop();
    }
}
