/* Registers of the STM32F446 (RM0390) that this port uses. The STM32F405 (RM0090) has the same at the same addresses. */
#ifndef MEMBRANE_STM32F4_H
#define MEMBRANE_STM32F4_H

#include <stdbool.h>

#include "cortex_m.h"

/* Clocks. QEMU has no clock tree: its processor runs at 168 MHz, its timers at 1 GHz, whatever is written. */
#ifdef QEMU_CLOCKS
#define CORE_HZ 168000000u
#define TIMER_HZ 1000000000u
#define CLOCKS_ARE_REAL false
#else
#define CORE_HZ 84000000u
#define TIMER_HZ 84000000u
#define CLOCKS_ARE_REAL true
#endif
#define APB1_HZ 42000000u
#define APB2_HZ 84000000u

/* Reset and clock control, RM0390 6.3 */
#define RCC_CR WORD(0x40023800u)
#define RCC_PLLCFGR WORD(0x40023804u)
#define RCC_CFGR WORD(0x40023808u)
#define RCC_AHB1ENR WORD(0x40023830u)
#define RCC_APB1ENR WORD(0x40023840u)
#define RCC_APB2ENR WORD(0x40023844u)
#define FLASH_ACR WORD(0x40023C00u) /* 3.8.1 */

/* Power control and its voltage detector, 5.4.1; interrupt line 16, 10.3 */
#define PWR_CR WORD(0x40007000u)
#define EXTI_IMR WORD(0x40013C00u)
#define EXTI_RTSR WORD(0x40013C08u)

/* Independent watchdog, 20.4 */
#define IWDG_KR WORD(0x40003000u)
#define IWDG_PR WORD(0x40003004u)
#define IWDG_RLR WORD(0x40003008u)
#define IWDG_START 0xCCCCu
#define IWDG_UNLOCK 0x5555u
#define IWDG_FEED 0xAAAAu

/* General purpose I/O, 7.4 */
struct gpio {
    uint32_t moder, otyper, ospeedr, pupdr, idr, odr, bsrr, lckr, afrl, afrh;
};
#define GPIOA ((volatile struct gpio *)0x40020000u)
#define GPIOB ((volatile struct gpio *)0x40020400u)
#define GPIOC ((volatile struct gpio *)0x40020800u)

/* Timers, 17.4 */
struct timer {
    uint32_t cr1, cr2, smcr, dier, sr, egr, ccmr1, ccmr2, ccer, cnt, psc, arr, rcr, ccr1, ccr2, ccr3, ccr4;
};
#define TIM2 ((volatile struct timer *)0x40000000u)
#define TIM3 ((volatile struct timer *)0x40000400u)

/* Serial ports, 25.6 */
struct usart {
    uint32_t sr, dr, brr, cr1, cr2, cr3;
};
#define USART1 ((volatile struct usart *)0x40011000u) /* on APB2 */
#define USART2 ((volatile struct usart *)0x40004400u) /* on APB1 */
#define USART_WRONG 0x0Fu /* parity, framing, noise, overrun */
#define USART_RXNE 0x20u
#define USART_TC 0x40u
#define USART_TXE 0x80u
#define USART_ON 0x202Cu /* enabled, receive interrupt, transmitter, receiver */
#define USART_RECEIVES 0x2024u
#define USART_TXEIE 0x80u
#define USART_TCIE 0x40u
#define USART_PARITY_EVEN 0x1400u /* 9 bits, the last one parity */
#define USART_PARITY_ODD 0x1600u

/* Cortex-M4, PM0214 4.3 to 4.5 */
#define SYSTICK_CTRL WORD(0xE000E010u)
#define SYSTICK_LOAD WORD(0xE000E014u)
#define SYSTICK_VALUE WORD(0xE000E018u)
#define NVIC_ISER0 WORD(0xE000E100u)
#define NVIC_ISER1 WORD(0xE000E104u)
#define SHPR3 WORD(0xE000ED20u)

/* What the files of this port need of each other. */
void stm32_usart1(void);
void stm32_usart2(void);
void stm32_tick(void);

void adc_start(void);
int32_t adc_value(uint32_t place); /* the mean of 64 conversions, 0..65520; HAL_NO_VALUE when not renewed */

void laser_take(uint8_t byte, uint32_t now_us);
int32_t laser_displacement(uint32_t now_us); /* 1/16 digit of the sensor, or HAL_NO_VALUE */
int32_t laser_quality(void);

#endif
