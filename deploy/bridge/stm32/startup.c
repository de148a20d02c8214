/* SPDX-License-Identifier: MIT */
/* From reset to main: the vector table and the C run-time's memory. RM0090 is ST's reference manual
 * of the STM32F405. */
#include <stddef.h>
#include <stdint.h>

enum { EXCEPTIONS = 16, INTERRUPTS = 82, USART1_INTERRUPT = 37 }; /* RM0090 table 62 */

/* stm32f405.ld */
extern uint32_t data_from[], data_begin[], data_end[], bss_begin[], bss_end[], stack_top[];

int main(void);
void reset(void);
void usart1_interrupt(void);

/* A fault ends in silence: the host says that no sweep comes. */
static void stay(void)
{
    for (;;) {
    }
}

void reset(void)
{
    uint32_t *to;
    const uint32_t *from = data_from;

    for (to = data_begin; to < data_end;) {
        *to++ = *from++;
    }
    for (to = bss_begin; to < bss_end;) {
        *to++ = 0;
    }
    (void)main();
    stay();
}

struct vectors {
    uint32_t *stack;
    void (*handler[EXCEPTIONS - 1 + INTERRUPTS])(void);
};

/* Initial stack pointer, reset, the core's faults; of the interrupts only USART1 is enabled. */
const struct vectors vectors __attribute__((section(".vectors"), used)) = {
    stack_top,
    {reset, stay, stay, stay, stay, stay, [EXCEPTIONS - 1 + USART1_INTERRUPT] = usart1_interrupt},
};
