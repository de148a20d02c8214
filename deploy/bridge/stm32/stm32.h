/* SPDX-License-Identifier: MIT */
/* As much of an STM32F405 as this port uses, by the names and sections of RM0090 (ST's reference
 * manual of the STM32F405) and of the ARMv7-M architecture reference manual. */
#ifndef GRASPD_STM32_H
#define GRASPD_STM32_H

#include <stdint.h>

#define REGISTER(address) (*(volatile uint32_t *)(address))
#define BIT(number) (UINT32_C(1) << (number))

/* Flash interface, RM0090 section 3.9 */
#define FLASH_ACR REGISTER(0x40023C00)

/* Reset and clock control, RM0090 section 7.3 */
#define RCC_CR REGISTER(0x40023800)
#define RCC_PLLCFGR REGISTER(0x40023804)
#define RCC_CFGR REGISTER(0x40023808)
#define RCC_AHB1ENR REGISTER(0x40023830)
#define RCC_APB2ENR REGISTER(0x40023844)

/* General-purpose I/O, RM0090 section 8.4 */
enum { GPIOA = 0x40020000, GPIOB = 0x40020400 };
#define GPIO_MODER(port) REGISTER((port) + 0x00)
#define GPIO_OSPEEDR(port) REGISTER((port) + 0x08)
#define GPIO_PUPDR(port) REGISTER((port) + 0x0C)
#define GPIO_BSRR(port) REGISTER((port) + 0x18)
#define GPIO_AFRL(port) REGISTER((port) + 0x20)
#define GPIO_AFRH(port) REGISTER((port) + 0x24)

/* SPI1, RM0090 section 28.5 */
#define SPI1_CR1 REGISTER(0x40013000)
#define SPI1_SR REGISTER(0x40013008)
#define SPI1_DR REGISTER(0x4001300C)

/* USART1, RM0090 section 30.6 */
#define USART1_SR REGISTER(0x40011000)
#define USART1_DR REGISTER(0x40011004)
#define USART1_BRR REGISTER(0x40011008)
#define USART1_CR1 REGISTER(0x4001100C)

/* The core's timer and interrupt controller, ARMv7-M sections B3.3 and B3.4 */
#define SYST_CSR REGISTER(0xE000E010)
#define SYST_RVR REGISTER(0xE000E014)
#define SYST_CVR REGISTER(0xE000E018)
#define NVIC_ISER1 REGISTER(0xE000E104)

/* Set SPI1 and its pins up; no sensor is selected. */
void spi_start(void);

#endif
