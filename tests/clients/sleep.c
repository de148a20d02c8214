/* For LD_PRELOAD: while the file that the variable SLEPT names exists, CLOCK_BOOTTIME is an hour
 * ahead, as if the computer had slept. */
#define _GNU_SOURCE
#include <stdlib.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

int clock_gettime(clockid_t clock, struct timespec *now) {
    const int failed = (int)syscall(SYS_clock_gettime, clock, now);
    const char *slept = getenv("SLEPT");
    if (clock == CLOCK_BOOTTIME && slept != NULL && access(slept, F_OK) == 0) now->tv_sec += 3600;
    return failed;
}
