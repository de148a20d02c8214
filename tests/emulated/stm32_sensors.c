/* SPDX-License-Identifier: MIT */
/* In place of the STM32F405 port's spi.c: simulated sensors inside of the firmware, which feel what
 * those of the PC port feel. */
#include "bridge.h"
#include "hal.h"
#include "sim_sensor.h"
#include "stm32.h"

enum { SENSORS = 3 };

extern struct bridge bridge;

static struct sim_sensor sensor[SENSORS];

static uint64_t now_ns(void)
{
    return hal_ticks_us() * 1000u;
}

void spi_start(void)
{
    unsigned i;

    for (i = 0; i < SENSORS; i++) {
        sim_sensor_init(&sensor[i], i + 1);
    }
}

void hal_select(uint8_t sensors)
{
    unsigned i, e;

    for (i = 0; i < SENSORS; i++) {
        for (e = 0; e < SIM_ELECTRODES; e++) { /* as host/counts.c */
            const uint32_t count = 1000u + 7u * bridge.seq + 811u * i + 131u * e;

            sensor[i].count[e] = (uint16_t)(count % 4096u);
        }
        sim_sensor_select(&sensor[i], ((unsigned)sensors >> i & 1u) != 0, now_ns());
    }
}

uint8_t hal_spi_transfer(uint8_t byte)
{
    uint8_t miso = 0xFF;
    unsigned i;

    for (i = 0; i < SENSORS; i++) {
        if (sensor[i].selected) {
            miso = (uint8_t)(miso & sim_sensor_transfer(&sensor[i], byte, now_ns()));
        }
    }
    return miso;
}
