/* SPDX-License-Identifier: MIT */
/* The hardware under the bridge. A port implements these seven functions, and nothing else. */
#ifndef GRASPD_HAL_H
#define GRASPD_HAL_H

#include <stddef.h>
#include <stdint.h>

#include "protocol.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Microseconds since reset, by a crystal. Never goes back, never wraps. */
uint64_t hal_ticks_us(void);

/* Wait at least this long; a little longer does no harm. */
void hal_delay_us(uint32_t us);

/* Pull low the chip selects of the sensors whose bits are set, let go of all others: all at once,
 * so that the sensors sample together. */
void hal_select(uint8_t sensors);

/* Send one byte, give the byte that came back. SPI mode 0, most significant bit first, 0.5 to 10
 * MHz (manual section 8.2). A pull-up on MISO makes an absent sensor read 0xFF. */
uint8_t hal_spi_transfer(uint8_t byte);

/* Bytes from the host, at most `size`, possibly none. Does not wait. */
size_t hal_link_read(uint8_t *data, size_t size);

/* Send bytes to the host; returns how many were taken, possibly none. Does not wait. */
size_t hal_link_write(const uint8_t *data, size_t size);

/* Unique id of this board: ASCII, NUL-padded. */
void hal_board_id(char board[PROTOCOL_TEXT]);

#ifdef __cplusplus
}
#endif

#endif
