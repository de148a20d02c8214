/* SPDX-License-Identifier: MIT */
#include "counts.h"

#include <stdlib.h>
#include <string.h>

enum { LINE_SIZE = 2048 }; /* 5 * 24 numbers of four digits and a separator are 600 */

bool counts_open(struct counts *counts, const char *path, unsigned sensors)
{
    memset(counts, 0, sizeof *counts);
    counts->sensors = sensors;
    if (path == NULL) {
        return true;
    }
    counts->file = strcmp(path, "-") == 0 ? stdin : fopen(path, "r");
    counts->rewindable = counts->file != NULL && counts->file != stdin &&
                         fseek(counts->file, 0, SEEK_SET) == 0;
    return counts->file != NULL;
}

/* Every electrode of every sensor moves, differently, and reaches both ends of the range. */
static void take_pattern(struct counts *counts)
{
    unsigned sensor, electrode;

    for (sensor = 0; sensor < counts->sensors; sensor++) {
        for (electrode = 0; electrode < SIM_ELECTRODES; electrode++) {
            counts->value[sensor][electrode] =
                (uint16_t)((1000u + 7u * counts->row + 811u * sensor + 131u * electrode) %
                           (COUNTS_MAX + 1u));
        }
    }
}

static bool parse(struct counts *counts, const char *line)
{
    unsigned i;

    for (i = 0; i < counts->sensors * SIM_ELECTRODES; i++) {
        char *after;
        unsigned long value;

        line += strspn(line, " \t,");
        if (*line < '0' || *line > '9') {
            return false;
        }
        value = strtoul(line, &after, 10);
        if (value > COUNTS_MAX) {
            return false;
        }
        counts->value[i / SIM_ELECTRODES][i % SIM_ELECTRODES] = (uint16_t)value;
        line = after;
    }
    return line[strspn(line, " \t\r\n")] == '\0';
}

static enum counts_result take_line(struct counts *counts)
{
    static char line[LINE_SIZE];
    bool again = false;

    for (;;) {
        if (fgets(line, sizeof line, counts->file) != NULL) {
            counts->line++;
            if (line[0] != '#') {
                return parse(counts, line) ? COUNTS_OK : COUNTS_BAD;
            }
        } else if (!counts->rewindable || again) {
            return COUNTS_END;
        } else {
            rewind(counts->file);
            counts->line = 0;
            again = true;
        }
    }
}

enum counts_result counts_take(struct counts *counts, uint32_t row)
{
    if (counts->begun && row == counts->row) {
        return COUNTS_OK;
    }
    if (row == 0 && counts->rewindable) {
        rewind(counts->file);
        counts->line = 0;
    }
    counts->begun = true;
    counts->row = row;
    if (counts->file == NULL) {
        take_pattern(counts);
        return COUNTS_OK;
    }
    return take_line(counts);
}

void counts_close(struct counts *counts)
{
    if (counts->file != NULL && counts->file != stdin) {
        (void)fclose(counts->file);
    }
    counts->file = NULL;
}
