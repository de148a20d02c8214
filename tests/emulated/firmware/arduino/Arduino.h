/* SPDX-License-Identifier: MIT */
/* As much of the API of the RP2040's Arduino core as the sketch uses; core.cpp implements it. */
#pragma once
#include <stddef.h>
#include <stdint.h>

enum { LOW, HIGH };
enum { INPUT, OUTPUT };

void pinMode(uint8_t pin, int mode);
void digitalWrite(uint8_t pin, int value);

struct SerialUSB {
    void begin(unsigned long baud);
    int available();
    int read();
    int availableForWrite();
    size_t write(const uint8_t *data, size_t size);
};

extern SerialUSB Serial;
