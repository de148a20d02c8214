/* SPDX-License-Identifier: MIT */
/* The bridge as a process: the firmware's own code on simulated sensors and a pseudo-terminal. */
#include <errno.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "bridge.h"
#include "counts.h"
#include "hal.h"
#include "hal_host.h"

enum { EXIT_FAILED = 1, EXIT_USAGE = 2, OUTAGES_MAX = 8 };

static const char usage[] =
    "usage: graspd-bridge [OPTION VALUE]...\n"
    "The bridge on a pseudo-terminal, whose path is printed. Stops on SIGINT or SIGTERM.\n"
    "  --sensors N          1 to 5 (3)\n"
    "  --sequence NAME      electrodes (unless told), all, interleaved, or channels: 0,17,18\n"
    "  --period-us N        from one sweep to the next (10000)\n"
    "  --spi-hz N           simulated clock, 500000 to 10000000 (4400000)\n"
    "  --counts FILE        a line per sweep since START: sensors * 24 numbers 0..4095, sensor by\n"
    "                       sensor; played again at its end; - is standard input, which ends the\n"
    "                       program when it ends; without it, in sweep k electrode e of sensor s\n"
    "                       reads (1000 + 7 k + 811 s + 131 e) mod 4096, all from 0\n"
    "  --unplug S[:A[:B]]   sensor S (from 0) is not there, from sweep A of the run up to sweep B\n"
    "  --dead S:E           electrode E (1..24) of sensor S reads 0\n"
    "  --answer S:E:WORD    electrode E of sensor S answers this word (hex), such as A52D\n"
    "  --serial S:TEXT      serial number of sensor S\n"
    "  --settle-us S:N      sensor S needs this long before it can be read (50)\n"
    "  --board TEXT         board id (host)\n"
    "  --link PATH          keep a symbolic link to the pseudo-terminal\n";

struct outage {
    unsigned sensor;
    unsigned long from, until; /* sweeps of the run */
};

struct options {
    struct bridge_config config;
    const char *counts, *link;
    struct outage outage[OUTAGES_MAX];
    unsigned outages;
};

static const char *link_path; /* to be removed at the end */
static unsigned sensors_named; /* by options: the largest number, plus one */

static void remove_link(void)
{
    if (link_path != NULL) {
        (void)unlink(link_path);
    }
}

/* Handle a signal: end the program here, as it may be waiting for its counts. */
static void stop(int signal_number)
{
    (void)signal_number;
    remove_link();
    _exit(0);
}

static void fail(int code, const char *format, ...)
{
    va_list arguments;

    va_start(arguments, format);
    (void)fprintf(stderr, "graspd-bridge: ");
    (void)vfprintf(stderr, format, arguments);
    (void)fprintf(stderr, "\n");
    va_end(arguments);
    exit(code);
}

/* ---- options --------------------------------------------------------------------------------- */

/* Parse the number at *text, and move *text behind it and one separator (: or ,). A wrong one, or
 * other text behind it, ends the program. */
static unsigned long number(const char *option, const char **text, int base, unsigned long least,
                            unsigned long most)
{
    char *after;
    unsigned long value;

    errno = 0;
    value = strtoul(*text, &after, base);
    if (after == *text || **text == '-' || errno != 0 || value < least || value > most ||
        strchr(":,", *after) == NULL) {
        fail(EXIT_USAGE, "%s: %s is not a number in %lu..%lu", option, *text, least, most);
    }
    *text = *after == ':' || *after == ',' ? after + 1 : after;
    return value;
}

/* Parse the number at `text`, which nothing follows. */
static unsigned long last_number(const char *option, const char *text, int base,
                                 unsigned long least, unsigned long most)
{
    const char *rest = strpbrk(text, ":,");

    if (rest != NULL) {
        fail(EXIT_USAGE, "%s: %s is too much", option, rest);
    }
    return number(option, &text, base, least, most);
}

/* Copy a text to a field of `size` bytes, which NULs fill. One that is too long ends the program. */
static void take_text(const char *option, const char *text, char *field, size_t size)
{
    if (strlen(text) > size) {
        fail(EXIT_USAGE, "%s: %s is longer than %lu characters", option, text, (unsigned long)size);
    }
    memset(field, 0, size);
    memcpy(field, text, strlen(text));
}

/* Parse the sensor's number at *text, as `number` does. */
static struct sim_sensor *sensor_of(const char *option, const char **text)
{
    unsigned sensor = (unsigned)number(option, text, 10, 0, PROTOCOL_SENSORS_MAX - 1);

    sensors_named = sensor >= sensors_named ? sensor + 1 : sensors_named;
    return &host_port.sensor[sensor];
}

static void take_sequence(struct bridge_config *config, const char *text)
{
    if (strcmp(text, "electrodes") == 0) {
        config->slots = biotac_commands(BIOTAC_ELECTRODES, config->command);
    } else if (strcmp(text, "all") == 0) {
        config->slots = biotac_commands(BIOTAC_ALL, config->command);
    } else if (strcmp(text, "interleaved") == 0) {
        config->slots = biotac_commands(BIOTAC_INTERLEAVED, config->command);
    } else {
        for (config->slots = 0; *text != '\0'; config->slots++) {
            if (config->slots == BIOTAC_SLOTS_MAX) {
                fail(EXIT_USAGE, "--sequence: more than %d slots", BIOTAC_SLOTS_MAX);
            }
            config->command[config->slots] =
                biotac_sample_command((uint8_t)number("--sequence", &text, 10, 0, BIOTAC_E24));
        }
    }
}

static void take_outage(struct options *options, const char *text)
{
    struct outage *outage = &options->outage[options->outages++];

    if (options->outages == OUTAGES_MAX) {
        fail(EXIT_USAGE, "--unplug: more than %d", OUTAGES_MAX - 1);
    }
    outage->sensor = (unsigned)(sensor_of("--unplug", &text) - host_port.sensor);
    outage->from = *text != '\0' ? number("--unplug", &text, 10, 0, UINT32_MAX) : 0;
    outage->until = *text != '\0' ? last_number("--unplug", text, 10, 0, UINT32_MAX) : UINT32_MAX;
}

/* Take an option about one sensor; false if `option` is another. */
static bool take_sensor_option(const char *option, const char *value)
{
    struct sim_sensor *sensor;
    unsigned long electrode;

    if (strcmp(option, "--dead") != 0 && strcmp(option, "--answer") != 0 &&
        strcmp(option, "--serial") != 0 && strcmp(option, "--settle-us") != 0) {
        return false;
    }
    sensor = sensor_of(option, &value);
    if (strcmp(option, "--serial") == 0) {
        take_text(option, value, sensor->serial, sizeof sensor->serial);
        return true;
    }
    if (strcmp(option, "--settle-us") == 0) {
        sensor->settle_ns = 1000u * (uint64_t)last_number(option, value, 10, 0, 1000000);
        return true;
    }
    if (strcmp(option, "--dead") == 0) {
        sensor->dead |= UINT32_C(1) << (last_number(option, value, 10, 1, SIM_ELECTRODES) - 1);
    } else {
        electrode = number(option, &value, 10, 1, SIM_ELECTRODES) - 1;
        sensor->forced |= UINT32_C(1) << electrode;
        sensor->forced_word[electrode] = (uint16_t)last_number(option, value, 16, 0, 0xFFFF);
    }
    return true;
}

static void take_option(struct options *options, const char *option, const char *value)
{
    if (strcmp(option, "--sensors") == 0) {
        options->config.sensors = (uint8_t)last_number(option, value, 10, 1, PROTOCOL_SENSORS_MAX);
    } else if (strcmp(option, "--sequence") == 0) {
        take_sequence(&options->config, value);
    } else if (strcmp(option, "--period-us") == 0) {
        options->config.period_us =
            (uint32_t)last_number(option, value, 10, BRIDGE_PERIOD_MIN_US, 10000000);
    } else if (strcmp(option, "--spi-hz") == 0) {
        host_port.spi_hz = (uint32_t)last_number(option, value, 10, 500000, 10000000);
    } else if (strcmp(option, "--counts") == 0) {
        options->counts = value;
    } else if (strcmp(option, "--unplug") == 0) {
        take_outage(options, value);
    } else if (strcmp(option, "--board") == 0) {
        take_text(option, value, host_port.board, sizeof host_port.board);
    } else if (strcmp(option, "--link") == 0) {
        options->link = value;
    } else if (!take_sensor_option(option, value)) {
        fail(EXIT_USAGE, "no such option: %s\n%s", option, usage);
    }
}

static void take_options(struct options *options, int count, char **argument)
{
    unsigned i;

    memset(options, 0, sizeof *options);
    options->config.sensors = 3;
    options->config.period_us = 10000;
    take_sequence(&options->config, "electrodes");
    host_port.spi_hz = 4400000;
    memcpy(host_port.board, "host", 5);
    for (i = 0; i < PROTOCOL_SENSORS_MAX; i++) {
        sim_sensor_init(&host_port.sensor[i], i + 1);
    }
    for (i = 1; i < (unsigned)count; i += 2) {
        if (strcmp(argument[i], "--help") == 0) {
            (void)fputs(usage, stdout);
            exit(0);
        }
        if (i + 1 == (unsigned)count) {
            fail(EXIT_USAGE, "%s needs a value\n%s", argument[i], usage);
        }
        take_option(options, argument[i], argument[i + 1]);
    }
    host_port.sensors = options->config.sensors;
    if (sensors_named > host_port.sensors) {
        fail(EXIT_USAGE, "there is no sensor %u: --sensors %u", sensors_named - 1, host_port.sensors);
    }
}

/* ---- counts of the sensors ------------------------------------------------------------------- */

static void apply_outages(const struct options *options, uint32_t sweeps)
{
    unsigned i;

    for (i = 0; i < host_port.sensors; i++) {
        host_port.sensor[i].unplugged = false;
    }
    for (i = 0; i < options->outages; i++) {
        if (sweeps >= options->outage[i].from && sweeps < options->outage[i].until) {
            host_port.sensor[options->outage[i].sensor].unplugged = true;
        }
    }
}

/* Give the sensors the counts of a row. Return false when the counts have ended. */
static bool apply_counts(struct counts *counts, uint32_t row)
{
    unsigned i;

    switch (counts_take(counts, row)) {
    case COUNTS_END:
        return false;
    case COUNTS_BAD:
        fail(EXIT_FAILED, "counts, line %lu: not %u numbers 0..%d", counts->line,
             counts->sensors * SIM_ELECTRODES, COUNTS_MAX);
        break;
    case COUNTS_OK:
        break;
    }
    for (i = 0; i < counts->sensors; i++) {
        memcpy(host_port.sensor[i].count, counts->value[i], sizeof counts->value[i]);
    }
    return true;
}

/* ---- the process ----------------------------------------------------------------------------- */

static void catch_signals(void)
{
    struct sigaction action;

    memset(&action, 0, sizeof action);
    action.sa_handler = stop;
    (void)sigaction(SIGINT, &action, NULL);
    (void)sigaction(SIGTERM, &action, NULL);
}

static void make_link(const char *path)
{
    char fresh[1024];
    struct stat about;

    if (lstat(path, &about) == 0 && !S_ISLNK(about.st_mode)) {
        fail(EXIT_FAILED, "%s is in the way: it is not a link", path);
    }
    if (snprintf(fresh, sizeof fresh, "%s.new", path) >= (int)sizeof fresh) {
        fail(EXIT_FAILED, "%s is too long", path);
    }
    if (lstat(fresh, &about) == 0 && S_ISLNK(about.st_mode)) {
        (void)unlink(fresh);
    }
    if (symlink(host_port.path, fresh) != 0 || rename(fresh, path) != 0) {
        fail(EXIT_FAILED, "%s: %s", path, strerror(errno));
    }
    link_path = path;
    (void)atexit(remove_link);
}

/* Run until the counts end. */
static void run(struct bridge *bridge, const struct options *options, struct counts *counts)
{
    for (;;) {
        apply_outages(options, bridge->sweeps);
        if (bridge->started && !apply_counts(counts, bridge->seq)) {
            return;
        }
        bridge_poll(bridge);
        host_port_wait(bridge_due_us(bridge), bridge->tx_used > 0);
    }
}

int main(int count, char **argument)
{
    static struct bridge bridge;
    static struct options options;
    static struct counts counts;

    take_options(&options, count, argument);
    catch_signals();
    if (!counts_open(&counts, options.counts, options.config.sensors)) {
        fail(EXIT_FAILED, "%s: %s", options.counts, strerror(errno));
    }
    if (!host_port_open()) {
        fail(EXIT_FAILED, "no pseudo-terminal: %s", strerror(errno));
    }
    apply_outages(&options, 0);
    if (!bridge_init(&bridge, &options.config)) {
        fail(EXIT_USAGE, "a bridge with this sequence does not run");
    }
    if (options.link != NULL) {
        make_link(options.link);
    }
    (void)printf("%s\n", host_port.path);
    (void)fflush(stdout);
    run(&bridge, &options, &counts);
    host_port_close();
    counts_close(&counts);
    return 0;
}
