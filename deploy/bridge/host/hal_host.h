/* SPDX-License-Identifier: MIT */
/* The bridge's hardware on a PC: simulated sensors on SPI, a pseudo-terminal as the link. */
#ifndef GRASPD_HAL_HOST_H
#define GRASPD_HAL_HOST_H

#include <stdbool.h>
#include <stdint.h>

#include "protocol.h"
#include "sim_sensor.h"

struct host_port {
    struct sim_sensor sensor[PROTOCOL_SENSORS_MAX];
    unsigned sensors;
    uint32_t spi_hz;
    char board[PROTOCOL_TEXT];
    char path[128]; /* of the pseudo-terminal, for the host to open */
    int master, slave;
    uint64_t start_ns; /* real time of reset */
    uint64_t sim_ns;   /* simulated time since reset, at times ahead of the real one */
};

/* The one port; hal.h's functions work on it. */
extern struct host_port host_port;

/* Open the pseudo-terminal and begin to count time. False with errno set. */
bool host_port_open(void);

/* Sleep until `due_us`, until the host sends, or until the host can take more if `writing`. */
void host_port_wait(uint64_t due_us, bool writing);

void host_port_close(void);

#endif
