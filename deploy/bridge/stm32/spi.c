/* SPDX-License-Identifier: MIT */
/* The sensors' side of the STM32F405 port: SPI1, and a chip select per sensor. */
#include "hal.h"
#include "stm32.h"

enum { SELECT_FIRST = 5 };                /* PB5..PB9, sensors 1 to 5 */
enum { RXNE = 1 << 0, BSY = 1 << 7 }; /* SPI_SR, RM0090 section 28.5.3 */
enum { MSTR = 1 << 2, SPE = 1 << 6, SSI = 1 << 8, SSM = 1 << 9 }; /* SPI_CR1, 28.5.1 */
enum { BR_32 = 4 << 3 }; /* 84 MHz / 32 = 2.625 MHz; / 16 is above the 4.4 MHz that are asked for */

void spi_start(void)
{
    uint32_t pin;

    RCC_AHB1ENR |= BIT(0) | BIT(1); /* GPIOA, GPIOB */
    RCC_APB2ENR |= BIT(12);         /* SPI1 */
    hal_select(0);
    for (pin = SELECT_FIRST; pin < SELECT_FIRST + PROTOCOL_SENSORS_MAX; pin++) {
        GPIO_MODER(GPIOB) |= BIT(2 * pin); /* output */
    }
    for (pin = 5; pin <= 7; pin++) { /* PA5 SCK, PA6 MISO, PA7 MOSI: alternate function 5 */
        GPIO_AFRL(GPIOA) |= UINT32_C(5) << (4 * pin);
        GPIO_MODER(GPIOA) |= BIT(2 * pin + 1);
        GPIO_OSPEEDR(GPIOA) |= BIT(2 * pin);
    }
    GPIO_PUPDR(GPIOA) |= BIT(2 * 6); /* an absent sensor reads 0xFF */
    SPI1_CR1 = MSTR | BR_32 | SSM | SSI;
    SPI1_CR1 |= SPE;
}

void hal_select(uint8_t sensors)
{
    const uint32_t all = BIT(PROTOCOL_SENSORS_MAX) - 1, low = sensors & all;

    /* All at once: the sensors sample at the same time. */
    GPIO_BSRR(GPIOB) = (all & ~low) << SELECT_FIRST | low << (SELECT_FIRST + 16);
}

uint8_t hal_spi_transfer(uint8_t byte)
{
    SPI1_DR = byte;
    while (!(SPI1_SR & RXNE) || (SPI1_SR & BSY)) { /* the clock is low before a chip select moves */
    }
    return (uint8_t)SPI1_DR;
}
