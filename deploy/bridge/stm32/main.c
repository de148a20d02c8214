/* SPDX-License-Identifier: MIT */
/* The graspd bridge on an STM32F405 with a crystal of 8 MHz, as on an Olimex STM32-H405.
 *
 * NOT YET RUN ON HARDWARE: tests/emulated/test_stm32.py runs it in QEMU.
 *
 *   STM32   BioTac SP
 *   PA5     SCK      all sensors
 *   PA7     MOSI     all sensors
 *   PA6     MISO     all sensors (pulled up here)
 *   PB5..9  CS 1..5  in the order of the fingers in the scene
 *   PA9     to RXD of a serial adapter of 3.3 V, 921600 baud
 *   PA10    to TXD of it
 */
#include "bridge.h"
#include "hal.h"
#include "stm32.h"

static const uint8_t SENSORS = 3;
static const enum biotac_sequence SEQUENCE = BIOTAC_ELECTRODES;
static const uint32_t PERIOD_US = 10000; /* must hold a sweep and then its frame on the line */
enum { BAUD = 921600 };

extern const uint8_t device_id[]; /* stm32f405.ld */
void usart1_interrupt(void);

struct bridge bridge; /* not static: simulated sensors look at its sweeps */

/* ---- clocks ---------------------------------------------------------------------------------- */

enum { CLOCK_MHZ = 168, APB2_HZ = CLOCK_MHZ * 1000000 / 2 };
enum { TIMER_MASK = 0xFFFFFF };
enum { READY_POLLS = 20000 }; /* 10 ms or more at 16 MHz; a crystal needs some 2 ms */

static void wait_for(volatile uint32_t *status, uint32_t mask)
{
    uint32_t polls;

    for (polls = 0; polls < READY_POLLS && (*status & mask) != mask; polls++) {
    }
}

/* 168 MHz from the crystal. Where that does not start the chip stays at its 16 MHz: all waits are
 * longer, the line is ten times too slow, and the host says that nothing answers. */
static void clock_start(void)
{
    FLASH_ACR = 5 | BIT(8) | BIT(9) | BIT(10); /* wait states, prefetch, caches: RM0090 3.5.1 */
    RCC_CR |= BIT(16);                         /* HSEON */
    wait_for(&RCC_CR, BIT(17));                /* HSERDY */
    /* PLLM, PLLN, PLLP = 2, PLLSRC, PLLQ: 8 MHz / 4 * 168 / 2. */
    RCC_PLLCFGR = 4 | 168 << 6 | 0 << 16 | BIT(22) | UINT32_C(7) << 24;
    RCC_CFGR = 5 << 10 | UINT32_C(4) << 13; /* APB1 at a quarter, APB2 at half */
    RCC_CR |= BIT(24);                      /* PLLON */
    wait_for(&RCC_CR, BIT(25));             /* PLLRDY */
    RCC_CFGR |= 2;                          /* SW: the PLL */
    wait_for(&RCC_CFGR, 2 << 2);            /* SWS */
    SYST_RVR = TIMER_MASK;
    SYST_CVR = 0;
    SYST_CSR = BIT(2) | BIT(0); /* the core's clock, enabled */
}

/* ---- time ------------------------------------------------------------------------------------ */

/* Cycles since reset. To be asked for at least every 0.1 s: the timer has 24 bits, counts down. */
static uint64_t cycles(void)
{
    static uint32_t last;
    static uint64_t passed;
    const uint32_t now = SYST_CVR;

    passed += (last - now) & TIMER_MASK;
    last = now;
    return passed;
}

uint64_t hal_ticks_us(void)
{
    return cycles() / CLOCK_MHZ;
}

void hal_delay_us(uint32_t us)
{
    const uint64_t until = cycles() + (uint64_t)us * CLOCK_MHZ;

    while (cycles() < until) {
    }
}

/* ---- link ------------------------------------------------------------------------------------ */

enum { RXNE = 1 << 5, ORE = 1 << 3, TXE = 1 << 7 };               /* USART_SR, RM0090 30.6.1 */
enum { RE = 1 << 2, TE = 1 << 3, RXNEIE = 1 << 5, UE = 1 << 13 }; /* USART_CR1, 30.6.4 */
enum { RX_SIZE = 256 }; /* what the host says within a sweep: some 20 bytes */

static volatile uint8_t rx[RX_SIZE];
static volatile uint32_t rx_put, rx_taken;

static void link_start(void)
{
    RCC_AHB1ENR |= BIT(0);               /* GPIOA */
    RCC_APB2ENR |= BIT(4);               /* USART1 */
    GPIO_AFRH(GPIOA) |= 7 << 4 | 7 << 8; /* PA9, PA10: alternate function 7 */
    GPIO_MODER(GPIOA) |= BIT(2 * 9 + 1) | BIT(2 * 10 + 1);
    GPIO_PUPDR(GPIOA) |= BIT(2 * 10);
    USART1_BRR = (APB2_HZ + BAUD / 2) / BAUD; /* RM0090 30.3.4: 0.16 % too fast */
    USART1_CR1 = UE | TE | RE | RXNEIE;
    NVIC_ISER1 = BIT(37 - 32);
}

/* A byte every 11 us, also while the sensors are sampled. Reading the status and then the data ends
 * an overrun too. */
void usart1_interrupt(void)
{
    if (USART1_SR & (RXNE | ORE)) {
        const uint8_t byte = (uint8_t)USART1_DR;

        if (rx_put - rx_taken < RX_SIZE) {
            rx[rx_put % RX_SIZE] = byte;
            rx_put++;
        }
    }
}

size_t hal_link_read(uint8_t *data, size_t size)
{
    size_t taken = 0;

    while (taken < size && rx_taken != rx_put) {
        data[taken++] = rx[rx_taken % RX_SIZE];
        rx_taken++;
    }
    return taken;
}

size_t hal_link_write(const uint8_t *data, size_t size)
{
    size_t taken = 0;

    while (taken < size && (USART1_SR & TXE)) {
        USART1_DR = data[taken++];
    }
    return taken;
}

void hal_board_id(char board[PROTOCOL_TEXT])
{
    static const char digits[] = "0123456789ABCDEF";
    uint8_t i;

    for (i = 0; i < PROTOCOL_TEXT / 2; i++) { /* place on the wafer, wafer, begin of the lot */
        board[2 * i] = digits[device_id[i] >> 4];
        board[2 * i + 1] = digits[device_id[i] & 15];
    }
}

/* ---------------------------------------------------------------------------------------------- */

int main(void)
{
    static struct bridge_config config;

    clock_start();
    spi_start();
    link_start();
    config.sensors = SENSORS;
    config.slots = biotac_commands(SEQUENCE, config.command);
    config.period_us = PERIOD_US;
    if (!bridge_init(&bridge, &config)) {
        return 1;
    }
    for (;;) {
        bridge_poll(&bridge);
    }
}
