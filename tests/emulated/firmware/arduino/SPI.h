/* SPDX-License-Identifier: MIT */
#pragma once
#include <stdint.h>

enum { LSBFIRST, MSBFIRST };
enum { SPI_MODE0 };

struct SPISettings {
    SPISettings(uint32_t hz, int order, int mode) : hz(hz), order(order), mode(mode) {}
    uint32_t hz;
    int order, mode;
};

struct SPIClass {
    bool setRX(uint8_t pin);
    bool setTX(uint8_t pin);
    bool setSCK(uint8_t pin);
    void begin(bool hardware_select);
    void beginTransaction(SPISettings settings);
    uint8_t transfer(uint8_t data);

    uint8_t rx, tx, sck;
};

extern SPIClass SPI;
