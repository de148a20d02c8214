/* SPDX-License-Identifier: MIT */
#include "hal_host.h"

#include <errno.h>
#include <fcntl.h>
#include <stdlib.h>
#include <string.h>
#include <sys/select.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include "hal.h"

#define NS_PER_S UINT64_C(1000000000)
#define NS_PER_US UINT64_C(1000)

struct host_port host_port = {.master = -1, .slave = -1};

/* ---- time ------------------------------------------------------------------------------------
 * Waits and SPI bytes move simulated time on and take no real time, so that no sensor is read
 * too early, however the operating system schedules this process. Before the link is touched, real
 * time has to catch up: no byte reaches the host before the time that stands in it. */

static uint64_t monotonic_ns(void)
{
    struct timespec now;

    (void)clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * NS_PER_S + (uint64_t)now.tv_nsec;
}

static struct timespec timespec_of(uint64_t ns)
{
    struct timespec time;

    time.tv_sec = (time_t)(ns / NS_PER_S);
    time.tv_nsec = (long)(ns % NS_PER_S);
    return time;
}

static uint64_t real_ns(void)
{
    return monotonic_ns() - host_port.start_ns;
}

static uint64_t sim_ns(void)
{
    const uint64_t real = real_ns();

    if (host_port.sim_ns < real) {
        host_port.sim_ns = real;
    }
    return host_port.sim_ns;
}

static void let_real_time_catch_up(void)
{
    const struct timespec until = timespec_of(host_port.start_ns + host_port.sim_ns);

    while (real_ns() < host_port.sim_ns &&
           clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, NULL) == EINTR) {
    }
}

uint64_t hal_ticks_us(void)
{
    return sim_ns() / NS_PER_US;
}

void hal_delay_us(uint32_t us)
{
    host_port.sim_ns = sim_ns() + us * NS_PER_US;
}

/* ---- SPI ------------------------------------------------------------------------------------- */

void hal_select(uint8_t sensors)
{
    const uint64_t now_ns = sim_ns();
    unsigned i;

    for (i = 0; i < host_port.sensors; i++) {
        sim_sensor_select(&host_port.sensor[i], ((unsigned)sensors >> i & 1u) != 0, now_ns);
    }
}

uint8_t hal_spi_transfer(uint8_t byte)
{
    const uint64_t now_ns = sim_ns();
    uint8_t miso = 0xFF; /* the pull-up; a sensor that drives a zero wins */
    unsigned i;

    for (i = 0; i < host_port.sensors; i++) {
        if (host_port.sensor[i].selected) {
            miso = (uint8_t)(miso & sim_sensor_transfer(&host_port.sensor[i], byte, now_ns));
        }
    }
    host_port.sim_ns = now_ns + 8 * NS_PER_S / host_port.spi_hz;
    return miso;
}

/* ---- link ------------------------------------------------------------------------------------ */

size_t hal_link_read(uint8_t *data, size_t size)
{
    ssize_t taken;

    let_real_time_catch_up();
    taken = read(host_port.master, data, size);
    return taken > 0 ? (size_t)taken : 0;
}

size_t hal_link_write(const uint8_t *data, size_t size)
{
    ssize_t taken;

    let_real_time_catch_up();
    taken = write(host_port.master, data, size);
    return taken > 0 ? (size_t)taken : 0;
}

void hal_board_id(char board[PROTOCOL_TEXT])
{
    memcpy(board, host_port.board, PROTOCOL_TEXT);
}

/* ---- the port -------------------------------------------------------------------------------- */

/* The slave side stays open here and raw: what the host has not read yet is kept when it closes, as
 * a USB device would keep it, and nothing is echoed before the host has set its own terminal up. */
static bool make_raw(int slave)
{
    struct termios settings;

    if (tcgetattr(slave, &settings) != 0) {
        return false;
    }
    settings.c_iflag = 0;
    settings.c_oflag = 0;
    settings.c_lflag = 0;
    settings.c_cflag = CS8 | CREAD | CLOCAL;
    settings.c_cc[VMIN] = 1;
    settings.c_cc[VTIME] = 0;
    return tcsetattr(slave, TCSANOW, &settings) == 0;
}

bool host_port_open(void)
{
    const char *path;

    host_port.master = posix_openpt(O_RDWR | O_NOCTTY);
    if (host_port.master < 0 || grantpt(host_port.master) != 0 || unlockpt(host_port.master) != 0) {
        return false;
    }
    path = ptsname(host_port.master);
    if (path == NULL || strlen(path) >= sizeof host_port.path) {
        return false;
    }
    memcpy(host_port.path, path, strlen(path) + 1);
    host_port.slave = open(host_port.path, O_RDWR | O_NOCTTY);
    if (host_port.slave < 0 || !make_raw(host_port.slave) ||
        fcntl(host_port.master, F_SETFL, O_NONBLOCK) != 0) {
        return false;
    }
    host_port.start_ns = monotonic_ns();
    return true;
}

void host_port_wait(uint64_t due_us, bool writing)
{
    const uint64_t now_ns = real_ns(), due_ns = due_us * NS_PER_US;
    const struct timespec left = timespec_of(due_ns > now_ns ? due_ns - now_ns : 0);
    fd_set readable, writable;

    FD_ZERO(&readable);
    FD_ZERO(&writable);
    FD_SET(host_port.master, &readable);
    if (writing) {
        FD_SET(host_port.master, &writable);
    }
    (void)pselect(host_port.master + 1, &readable, &writable, NULL, &left, NULL);
}

void host_port_close(void)
{
    if (host_port.slave >= 0) {
        (void)close(host_port.slave);
    }
    if (host_port.master >= 0) {
        (void)close(host_port.master);
    }
    host_port.slave = host_port.master = -1;
}
