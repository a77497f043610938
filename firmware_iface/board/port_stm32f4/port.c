/* The hardware layer on an STM32F446 or STM32F405 with a crystal or clock of 8 MHz. docs/how-to/board-hardware.md has the pins.
 * Not run on silicon; see that page for what was run in QEMU. */
#include "board.h"
#include "hal.h"
#include "settings.h"
#include "stm32f4.h"

/* Pins. Port A: 0, 1, 4 analog; 2, 3 Modbus; 6 pump; 7 vent; 8 RS-485 driver; 10 laser. Port B: 0 analog; 5 enable;
 * 6, 8, 9, 10 interlock inputs 0..3, high while their circuit is closed. Port C: 0 analog. */
#define PUMP_VENT_PINS 0x00C0u
#define DRIVER_PIN 0x0100u
#define ENABLE_PIN 0x0020u
#define LOW(pins) ((pins) << 16)

/* LSI has 17..47 kHz (data sheet DS10693): 400 clocks of LSI / 4 are 34..94 ms, below HAL_WATCHDOG_MAX_MS. */
#define WATCHDOG_RELOAD 400u

/* 84 MHz / 4200 = 20 kHz, with 4200 steps */
#define PWM_STEPS 4200u

/* The 8 MHz: a clock, as the NUCLEO's ST-LINK gives (HSEBYP, HSEON), or a crystal (HSEON) */
#ifdef HSE_CRYSTAL
#define HSE 0x00010000u
#else
#define HSE 0x00050000u
#endif

#define LASER_BAUD 115200u

static struct ring sending;
static bool enable_high;

extern const uint8_t stored_settings[];

static void pins_safe(void)
{
    GPIOA->bsrr = LOW(PUMP_VENT_PINS | DRIVER_PIN);
    GPIOB->bsrr = LOW(ENABLE_PIN);
    /* outputs 6, 7, 8; the debugger's pins 13..15 as at reset */
    GPIOA->moder = 0xA8015000u;
    GPIOB->moder = 0x00000680u; /* output 5; pins 3, 4 as at reset */
}

/* 8 MHz from outside / 4 * 168 / 4 = 84 MHz, RM0390 6.3.2; two wait states, 3.4.1. Without that clock the watchdog resets
 * the board again and again, its outputs safe. */
static void start_clocks(void)
{
    FLASH_ACR = 0x00000702u; /* caches, prefetch, two wait states */
    RCC_CR |= HSE;
    while (CLOCKS_ARE_REAL && ((RCC_CR & 0x00020000u) == 0u)) {
    }
    RCC_PLLCFGR = 0x27400000u | (1u << 16) | (168u << 6) | 4u; /* R 2, Q 7, from HSE, P 4 */
    RCC_CR |= 0x01080000u;                                     /* PLLON; CSSON: a failed clock is an NMI */
    while (CLOCKS_ARE_REAL && ((RCC_CR & 0x02000000u) == 0u)) {
    }
    RCC_CFGR = 0x00001002u; /* APB1 / 2, from PLL */
    while (CLOCKS_ARE_REAL && ((RCC_CFGR & 0xCu) != 0x8u)) {
    }
}

static void start_outputs(void)
{
    TIM3->psc = 0u;
    TIM3->arr = PWM_STEPS - 1u;
    TIM3->ccr1 = 0u;
    TIM3->ccr2 = 0u;
    TIM3->ccmr1 = 0x6868u; /* PWM mode 1 with preload on both */
    TIM3->ccer = 0x11u;
    TIM3->egr = 1u;
    TIM3->cr1 = 0x81u;
    GPIOA->afrl = 0x22007700u;  /* 7, 6: TIM3; 3, 2: USART2 */
    GPIOA->afrh = 0x00000700u;  /* 10: USART1 */
    GPIOA->pupdr = 0x64100040u; /* pull-ups on both receivers: an open line is idle */
    GPIOB->pupdr = 0x002A2100u; /* pull-downs on 6, 8, 9, 10: a cut wire is open; 4 as at reset */
    GPIOA->moder = 0xA821A3AFu; /* 0, 1, 4 analog; 2, 3, 6, 7, 10 alternate; 8 output */
    GPIOB->moder = 0x00000683u; /* 0 analog; 5 output; 6, 8, 9, 10 input */
    GPIOC->moder = 0x00000003u;
}

void hal_init(void)
{
    RCC_AHB1ENR |= 0x00400007u; /* ports A, B, C, DMA2 */
    pins_safe();
    IWDG_KR = IWDG_START;
    IWDG_KR = IWDG_UNLOCK;
    IWDG_PR = 0u;
    IWDG_RLR = WATCHDOG_RELOAD;
    IWDG_KR = IWDG_FEED;
    RCC_APB1ENR |= 0x10020003u; /* TIM2, TIM3, USART2, PWR */
    RCC_APB2ENR |= 0x00000110u; /* USART1, ADC1 */
    start_clocks();
    PWR_CR |= 0xF0u; /* voltage detector on, 2.9 V */
    EXTI_RTSR |= 0x10000u;
    EXTI_IMR |= 0x10000u;
    TIM2->psc = (TIMER_HZ / 1000000u) - 1u;
    TIM2->arr = 0xFFFFFFFFu;
    TIM2->egr = 1u;
    TIM2->cr1 = 1u;
    start_outputs();
    adc_start();
}

const uint8_t *hal_settings(size_t *length)
{
    *length = SETTINGS_BYTES;
    return stored_settings;
}

/* The UARTs' handlers, a microsecond long, may interrupt the tick: a USART keeps only one byte. */
void hal_start(uint32_t baud, enum hal_parity parity)
{
    static const uint32_t PARITIES[] = {0u, USART_PARITY_EVEN, USART_PARITY_ODD};
    USART2->brr = (APB1_HZ + (baud / 2u)) / baud;
    USART2->cr1 = USART_ON | PARITIES[parity];
    USART1->brr = (APB2_HZ + (LASER_BAUD / 2u)) / LASER_BAUD;
    USART1->cr1 = USART_RECEIVES;
    SHPR3 = 0x10000000u; /* SysTick below the UARTs */
    SYSTICK_LOAD = (CORE_HZ / 1000u) - 1u;
    SYSTICK_VALUE = 0u;
    SYSTICK_CTRL = 7u;
    NVIC_ISER1 = 0x60u; /* 37 USART1, 38 USART2 */
    NVIC_ISER0 = 0x02u; /* 1 PVD */
}

uint32_t hal_micros(void)
{
    return TIM2->cnt;
}

int32_t hal_input(enum hal_input_channel channel)
{
    static const uint32_t PLACES[HAL_ANALOG_CHANNELS] = {4u, 0u, 1u, 2u, 3u}; /* PC0, PA0, PA1, PA4, PB0 */
    int32_t found;
#ifdef LASER_ANALOG
    found = (channel == HAL_DISPLACEMENT_QUALITY) ? 0 : adc_value(PLACES[channel]);
#else
    if (channel == HAL_DISPLACEMENT) {
        found = laser_displacement(hal_micros());
    } else if (channel == HAL_DISPLACEMENT_QUALITY) {
        found = laser_quality();
    } else {
        found = adc_value(PLACES[channel]);
    }
#endif
    return found;
}

uint32_t hal_interlocks(void)
{
    static const uint32_t PINS[] = {6u, 8u, 9u, 10u};
    const uint32_t levels = GPIOB->idr;
    uint32_t closed = 0u;
    for (uint32_t i = 0u; i < (sizeof(PINS) / sizeof(PINS[0])); i++) {
        closed |= ((levels >> PINS[i]) & 1u) << i;
    }
    return closed;
}

/* PWM, and a square wave of 500 Hz on the enable, which lives on by its edges alone. */
void hal_outputs(uint32_t pump, uint32_t vent)
{
    TIM3->ccr1 = (pump * PWM_STEPS) / HAL_FULL_SCALE;
    TIM3->ccr2 = (vent * PWM_STEPS) / HAL_FULL_SCALE;
    enable_high = !enable_high;
    GPIOB->bsrr = enable_high ? ENABLE_PIN : LOW(ENABLE_PIN);
}

void hal_watchdog_feed(void)
{
    IWDG_KR = IWDG_FEED;
}

void port_outputs_safe(void)
{
    TIM3->ccr1 = 0u;
    TIM3->ccr2 = 0u;
    pins_safe();
}

void stm32_tick(void)
{
    board_tick();
}

/* Sends what fits. When all is sent, the interrupt "transmission complete" turns the RS-485 driver off. */
static void send_on(void)
{
    while (((USART2->sr & USART_TXE) != 0u) && !ring_empty(&sending)) {
        USART2->dr = ring_get(&sending);
    }
    const uint32_t quiet = USART2->cr1 & ~(USART_TXEIE | USART_TCIE);
    USART2->cr1 = quiet | (ring_empty(&sending) ? USART_TCIE : USART_TXEIE);
}

void hal_uart_write(const uint8_t *bytes, size_t count)
{
    const uint32_t before = hal_lock();
    ring_put_all(&sending, bytes, count);
    if (!ring_empty(&sending)) {
        GPIOA->bsrr = DRIVER_PIN;
        send_on();
    }
    hal_unlock(before);
}

void stm32_usart2(void)
{
    const uint32_t status = USART2->sr; /* with the read of DR this clears the errors, RM0390 25.6.1 */
    if ((status & (USART_RXNE | USART_WRONG)) != 0u) {
        const uint8_t byte = (uint8_t)USART2->dr;
        if (((status & USART_WRONG) != 0u) || !ring_put(&uart_received, byte)) {
            uart_lost = true;
        }
    }
    if (!ring_empty(&sending)) {
        send_on();
    } else if ((status & USART_TC) != 0u) {
        USART2->cr1 &= ~(USART_TXEIE | USART_TCIE);
        GPIOA->bsrr = LOW(DRIVER_PIN);
    } else {
        /* the last byte is on its way */
    }
}

void stm32_usart1(void)
{
    const uint32_t status = USART1->sr;
    const uint8_t byte = (uint8_t)USART1->dr;
    if ((status & USART_WRONG) == 0u) {
        laser_take(byte, hal_micros());
    }
}
