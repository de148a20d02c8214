/* SPDX-License-Identifier: MIT */
/* deploy/bridge/host's simulated sensors and their counts, unchanged, for node by Node-API. */
#include <node_api.h>
#include <string.h>

#include "counts.h"
#include "sim_sensor.h"

enum { SENSORS = COUNTS_SENSORS_MAX, ARGUMENTS_MAX = 4 };

static struct sim_sensor sensor[SENSORS];
static struct counts counts;

/* Put the call's numbers into `value`, 0 for missing ones; the first may be a sensor's, from 0. */
static void take_numbers(napi_env env, napi_callback_info info, double value[ARGUMENTS_MAX])
{
    napi_value argument[ARGUMENTS_MAX];
    size_t size = ARGUMENTS_MAX, i;

    (void)napi_get_cb_info(env, info, &size, argument, NULL, NULL);
    for (i = 0; i < ARGUMENTS_MAX; i++) {
        value[i] = 0;
        if (i < size) {
            (void)napi_get_value_double(env, argument[i], &value[i]);
        }
    }
}

static struct sim_sensor *named(double number)
{
    return &sensor[number >= 0 && number < SENSORS ? (unsigned)number : 0];
}

/* Give the first argument as a text; empty if it is none. */
static void take_text(napi_env env, napi_callback_info info, char *text, size_t size)
{
    napi_value argument[1];
    size_t arguments = 1, length;

    text[0] = '\0';
    (void)napi_get_cb_info(env, info, &arguments, argument, NULL, NULL);
    if (arguments == 1) {
        (void)napi_get_value_string_utf8(env, argument[0], text, size, &length);
    }
}

/* init(file of counts, or "" for the pattern): sensors at rest. */
static napi_value init(napi_env env, napi_callback_info info)
{
    static char path[4096];
    unsigned i;

    take_text(env, info, path, sizeof path);
    for (i = 0; i < SENSORS; i++) {
        sim_sensor_init(&sensor[i], i + 1);
    }
    if (!counts_open(&counts, path[0] == '\0' ? NULL : path, SENSORS)) {
        (void)napi_throw_error(env, NULL, "no such file of counts");
    }
    return NULL;
}

/* row(k): give the sensors the counts of the k-th sweep since START, from 0. */
static napi_value row(napi_env env, napi_callback_info info)
{
    double value[ARGUMENTS_MAX];
    unsigned i;

    take_numbers(env, info, value);
    if (counts_take(&counts, (uint32_t)value[0]) != COUNTS_OK) {
        (void)napi_throw_error(env, NULL, "the file of counts has no such row of five sensors");
    }
    for (i = 0; i < SENSORS; i++) {
        memcpy(sensor[i].count, counts.value[i], sizeof counts.value[i]);
    }
    return NULL;
}

/* select(sensor, selected, now_ns) */
static napi_value pick(napi_env env, napi_callback_info info)
{
    double value[ARGUMENTS_MAX];

    take_numbers(env, info, value);
    sim_sensor_select(named(value[0]), value[1] != 0, (uint64_t)value[2]);
    return NULL;
}

/* transfer(byte, now_ns): what MISO carries; a sensor that drives a zero wins over the pull-up. */
static napi_value transfer(napi_env env, napi_callback_info info)
{
    double value[ARGUMENTS_MAX];
    uint8_t miso = 0xFF;
    napi_value answer;
    unsigned i;

    take_numbers(env, info, value);
    for (i = 0; i < SENSORS; i++) {
        if (sensor[i].selected) {
            miso &= sim_sensor_transfer(&sensor[i], (uint8_t)value[0], (uint64_t)value[1]);
        }
    }
    (void)napi_create_uint32(env, miso, &answer);
    return answer;
}

/* unplug(sensor, unplugged) */
static napi_value unplug(napi_env env, napi_callback_info info)
{
    double value[ARGUMENTS_MAX];

    take_numbers(env, info, value);
    named(value[0])->unplugged = value[1] != 0;
    return NULL;
}

/* settle(sensor, ns): how long it needs between a command and its answer. */
static napi_value settle(napi_env env, napi_callback_info info)
{
    double value[ARGUMENTS_MAX];

    take_numbers(env, info, value);
    named(value[0])->settle_ns = (uint64_t)value[1];
    return NULL;
}

/* dead(sensor, mask): the electrodes, bit by bit from 0, that read 0. */
static napi_value dead(napi_env env, napi_callback_info info)
{
    double value[ARGUMENTS_MAX];

    take_numbers(env, info, value);
    named(value[0])->dead = (uint32_t)value[1];
    return NULL;
}

/* force(sensor, electrode from 0, word): it answers this word; one below 0 ends that. */
static napi_value force(napi_env env, napi_callback_info info)
{
    double value[ARGUMENTS_MAX];
    struct sim_sensor *one;
    unsigned electrode;

    take_numbers(env, info, value);
    one = named(value[0]);
    electrode = (unsigned)value[1] % SIM_ELECTRODES;
    one->forced &= ~(UINT32_C(1) << electrode);
    if (value[2] >= 0) {
        one->forced |= UINT32_C(1) << electrode;
        one->forced_word[electrode] = (uint16_t)value[2];
    }
    return NULL;
}

NAPI_MODULE_INIT()
{
    static const struct {
        const char *name;
        napi_callback call;
    } function[] = {{"init", init},         {"row", row},       {"select", pick}, {"dead", dead},
                    {"transfer", transfer}, {"unplug", unplug}, {"force", force}, {"settle", settle}};
    unsigned i;

    for (i = 0; i < sizeof function / sizeof *function; i++) {
        napi_value made;

        (void)napi_create_function(env, function[i].name, NAPI_AUTO_LENGTH, function[i].call, NULL,
                                   &made);
        (void)napi_set_named_property(env, exports, function[i].name, made);
    }
    return exports;
}
