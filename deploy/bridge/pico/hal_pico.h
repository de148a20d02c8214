/* SPDX-License-Identifier: MIT */
/* The bridge's hardware on a Raspberry Pi Pico: what main.c needs beside hal.h. */
#ifndef GRASPD_HAL_PICO_H
#define GRASPD_HAL_PICO_H

#include <stdbool.h>

/* Set up pins, SPI and USB. Before any function of hal.h. */
void hal_pico_init(void);

/* True if the link will have nothing to do before the next interrupt; `writing` if bytes wait for
 * it. */
bool hal_pico_link_idle(bool writing);

#endif
