/* SPDX-License-Identifier: MIT */
#include "hal_pico.h"

#include <string.h>

#include "config.h"
#include "hal.h"
#include "hardware/gpio.h"
#include "hardware/spi.h"
#include "hardware/timer.h"
#include "pico/unique_id.h"
#include "tusb.h"

static const uint8_t pin_select[] = {BRIDGE_PIN_SELECT};

_Static_assert(sizeof pin_select >= BRIDGE_SENSORS, "a chip select for each sensor");

/* Chip selects of the sensors whose bits are set. */
static uint32_t select_pins(uint8_t sensors)
{
    uint32_t pins = 0;
    uint8_t i;

    for (i = 0; i < BRIDGE_SENSORS; i++) {
        if (sensors >> i & 1u) {
            pins |= UINT32_C(1) << pin_select[i];
        }
    }
    return pins;
}

void hal_pico_init(void)
{
    const uint32_t all = select_pins(UINT8_MAX);

    gpio_init_mask(all);
    gpio_set_mask(all); /* high before they drive: no sensor is selected for a moment */
    gpio_set_dir_out_masked(all);
    (void)spi_init(BRIDGE_SPI, BRIDGE_SPI_HZ); /* 8 bits, mode 0, most significant bit first */
    gpio_set_function(BRIDGE_PIN_CLOCK, GPIO_FUNC_SPI);
    gpio_set_function(BRIDGE_PIN_MOSI, GPIO_FUNC_SPI);
    gpio_set_function(BRIDGE_PIN_MISO, GPIO_FUNC_SPI);
    gpio_pull_up(BRIDGE_PIN_MISO);
    (void)tusb_init();
}

uint64_t hal_ticks_us(void)
{
    return time_us_64(); /* the timer begins at 0 at every reset */
}

/* busy_wait_us_32 counts edges of the microsecond, so that n of them may take no more than n - 1
 * microseconds. */
void hal_delay_us(uint32_t us)
{
    busy_wait_us_32(us + 1);
}

void hal_select(uint8_t sensors)
{
    /* All at once: the sensors sample at the same time. */
    gpio_put_masked(select_pins(UINT8_MAX), ~select_pins(sensors));
}

uint8_t hal_spi_transfer(uint8_t byte)
{
    uint8_t answer;

    (void)spi_write_read_blocking(BRIDGE_SPI, &byte, &answer, 1);
    while (spi_is_busy(BRIDGE_SPI)) {
        /* The byte is in before the clock's last half period is over. */
    }
    return answer;
}

/* ---- link: USB CDC --------------------------------------------------------------------------- */

/* Bytes that USB takes. Whether the host has the port open (DTR) does not count: what it has not
 * read yet waits, as it does on every serial line. */
static uint32_t link_room(void)
{
    return tud_ready() ? tud_cdc_write_available() : 0;
}

size_t hal_link_read(uint8_t *data, size_t size)
{
    tud_task();
    return tud_cdc_read(data, (uint32_t)size);
}

size_t hal_link_write(const uint8_t *data, size_t size)
{
    const uint32_t room = link_room();
    uint32_t taken;

    if (room == 0) {
        return 0;
    }
    /* Never more than there is room for: while the port is closed TinyUSB would overwrite. */
    taken = tud_cdc_write(data, size < room ? (uint32_t)size : room);
    (void)tud_cdc_write_flush();
    return taken;
}

void hal_board_id(char board[PROTOCOL_TEXT])
{
    char id[2 * PICO_UNIQUE_BOARD_ID_SIZE_BYTES + 1];

    pico_get_unique_board_id_string(id, sizeof id); /* USB's serial number is the same */
    memcpy(board, id, PROTOCOL_TEXT);
}

bool hal_pico_link_idle(bool writing)
{
    return !tud_task_event_ready() && tud_cdc_available() == 0 && !(writing && link_room() > 0);
}
