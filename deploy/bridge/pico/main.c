/* SPDX-License-Identifier: MIT */
/* The graspd bridge on a Raspberry Pi Pico (RP2040), with the pico-sdk. */
#include "bridge.h"
#include "config.h"
#include "hal.h"
#include "hal_pico.h"
#include "hardware/gpio.h"
#include "hardware/watchdog.h"
#include "pico/time.h"

_Static_assert(BRIDGE_SENSORS >= 1 && BRIDGE_SENSORS <= PROTOCOL_SENSORS_MAX, "1 to 5 sensors");
_Static_assert(BRIDGE_PERIOD_US >= BRIDGE_PERIOD_MIN_US, "the period is too short");
_Static_assert(BRIDGE_SPI_HZ >= 500000 && BRIDGE_SPI_HZ <= 10000000, "manual section 8.2");

enum { ALL_SENSORS = (1 << BRIDGE_SENSORS) - 1, SLOW_US = 500000, FAST_US = 100000 };

/* Sets the light: blinks fast while a sensor is missing; otherwise on while sweeping, and blinks
 * slowly while not. Returns the time of the next change. */
static uint64_t show(const struct bridge *bridge)
{
    const bool missing = bridge->present != ALL_SENSORS;
    const uint64_t now_us = hal_ticks_us();
    const uint64_t turn = now_us / (missing ? FAST_US : SLOW_US);

#ifdef PICO_DEFAULT_LED_PIN
    gpio_put(PICO_DEFAULT_LED_PIN, (bridge->started && !missing) || turn % 2 == 0);
#endif
    return (turn + 1) * (missing ? FAST_US : SLOW_US);
}

/* Sleep until the loop has something to do: at `due_us`, or at an interrupt of USB before. */
static void rest(const struct bridge *bridge, uint64_t due_us)
{
    const uint64_t bridge_due = bridge_due_us(bridge);

    if (hal_pico_link_idle(bridge->tx_used > 0)) {
        (void)best_effort_wfe_or_timeout(
            from_us_since_boot(bridge_due < due_us ? bridge_due : due_us));
    }
}

int main(void)
{
    static struct bridge bridge;
    struct bridge_config config = {.sensors = BRIDGE_SENSORS, .period_us = BRIDGE_PERIOD_US};

#ifdef PICO_DEFAULT_LED_PIN
    gpio_init(PICO_DEFAULT_LED_PIN);
    gpio_set_dir(PICO_DEFAULT_LED_PIN, true);
#endif
    watchdog_enable(BRIDGE_WATCHDOG_MS, true);
    hal_pico_init();
    config.slots = biotac_commands(BRIDGE_SEQUENCE, config.command);
    if (!bridge_init(&bridge, &config)) {
        return 1; /* until the watchdog resets; the assertions above leave no such configuration */
    }
    for (;;) {
        bridge_poll(&bridge);
        watchdog_update();
        rest(&bridge, show(&bridge));
    }
}
