/* SPDX-License-Identifier: MIT */
/* Source of the simulated sensors' counts: a pattern, or rows of numbers. */
#ifndef GRASPD_COUNTS_H
#define GRASPD_COUNTS_H

#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>

#include "sim_sensor.h"

enum { COUNTS_MAX = 4095, COUNTS_SENSORS_MAX = 5 };

struct counts {
    FILE *file;      /* NULL: the pattern */
    bool rewindable; /* a file is played again from its first row; a stream ends */
    unsigned sensors;
    bool begun;
    uint32_t row;       /* current row */
    unsigned long line; /* line of the file, for messages */
    uint16_t value[COUNTS_SENSORS_MAX][SIM_ELECTRODES];
};

enum counts_result { COUNTS_OK, COUNTS_END, COUNTS_BAD };

/* The pattern (`path` NULL), standard input ("-"), or a file. False if it cannot be opened. */
bool counts_open(struct counts *counts, const char *path, unsigned sensors);

/* Make `row` the current row: the pattern's, else the next line; row 0 begins a file again. A line
 * has sensors * 24 numbers 0..4095, sensor by sensor, apart by spaces or commas; lines that begin
 * with # are skipped. A file begins again at its end, a stream then gives COUNTS_END; a bad line
 * gives COUNTS_BAD. The present row once more changes nothing. */
enum counts_result counts_take(struct counts *counts, uint32_t row);

void counts_close(struct counts *counts);

#endif
