/* SPDX-License-Identifier: MIT */
/* Settings of a build: sensors, sequence, period, pins and clock of SPI.
 * Each can be given to CMake as well: -DBRIDGE_SENSORS=5. */
#ifndef GRASPD_PICO_CONFIG_H
#define GRASPD_PICO_CONFIG_H

#ifndef BRIDGE_SENSORS
#define BRIDGE_SENSORS 3 /* 1..5 */
#endif

#ifndef BRIDGE_SEQUENCE
#define BRIDGE_SEQUENCE BIOTAC_ELECTRODES /* or BIOTAC_ALL, BIOTAC_INTERLEAVED: biotac.h */
#endif

#ifndef BRIDGE_PERIOD_US
#define BRIDGE_PERIOD_US 10000 /* from one sweep to the next */
#endif

#define BRIDGE_SPI_HZ 4400000 /* the chip takes the next lower clock that it can make */

/* GP numbers. Clock, MOSI and MISO must be pins of the same SPI: see the Pico's pinout. */
#define BRIDGE_SPI spi0
#define BRIDGE_PIN_CLOCK 18
#define BRIDGE_PIN_MOSI 19
#define BRIDGE_PIN_MISO 16
#define BRIDGE_PIN_SELECT 17, 20, 21, 22, 26 /* in the order of the fingers in the scene */

/* A loop that hangs this long resets the chip. It sleeps for half of that at most. */
#define BRIDGE_WATCHDOG_MS 1000

#endif
