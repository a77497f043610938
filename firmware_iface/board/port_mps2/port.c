/* ARM's MPS2 board with the AN385 image, as QEMU has it (mps2-an385): Modbus on UART0, and on UART1 the simulated film
 * (bench_line.h). Registers: Cortex-M System Design Kit (DDI 0479), AN385 (DAI 0385). */
#include <stdbool.h>

#include "bench_line.h"
#include "board.h"
#include "cortex_m.h"
#include "hal.h"
#include "mps2.h"

#define CLOCK_HZ 25000000u

#define TIMER0_CTRL WORD(0x40000000u)
#define TIMER0_RELOAD WORD(0x40000008u)
#define TIMER0_INTCLEAR WORD(0x4000000Cu)
#define TIMER_RUNS_AND_INTERRUPTS 9u

#define FPGAIO_COUNTER WORD(0x40028018u) /* counts clocks of FPGAIO_PRESCALE + 1 */
#define FPGAIO_PRESCALE WORD(0x4002801Cu)

#define WATCHDOG_LOAD WORD(0x40008000u)
#define WATCHDOG_CTRL WORD(0x40008008u)
#define WATCHDOG_INTCLR WORD(0x4000800Cu)
#define WATCHDOG_LOCK WORD(0x40008C00u)
#define WATCHDOG_KEY 0x1ACCE551u
#define WATCHDOG_WARNS_AND_RESETS 3u
/* Longer than hal.h allows on hardware: a busy PC takes the processor away from the emulator for as long. */
#define WATCHDOG_MS 500u

#define NVIC_ISER WORD(0xE000E100u)
#define NVIC_PRIORITY_0 WORD(0xE000E400u)
#define UARTS_BELOW_TIMER 0x40404040u /* interrupts 0..3; the timer's, 8, keeps priority 0 */
#define INTERRUPTS_USED 0x10Fu


#define UART_TX_FULL 1u
#define UART_RX_FULL 2u
#define UART_RX_LOST 8u
#define UART_ALL_ON 0xFu /* transmitter, receiver, their interrupts */
#define FILM_BAUD 921600u

struct uart {
    uint32_t data, state, ctrl, interrupts, divider;
};

#define UART0 ((volatile struct uart *)0x40004000u)
#define UART1 ((volatile struct uart *)0x40005000u)

static struct ring sending, film_sending;

static struct {
    struct bench_line line;
    int32_t inputs[HAL_INPUT_CHANNELS];
    uint32_t interlocks;
    uint32_t heard_us;
    uint32_t said_us;
    uint32_t pump, vent;
    bool heard;
} film;

extern const uint8_t stored_settings[];
extern const uint32_t stored_settings_length;

static void send_on(volatile struct uart *uart, struct ring *ring)
{
    while (((uart->state & UART_TX_FULL) == 0u) && !ring_empty(ring)) {
        uart->data = ring_get(ring);
    }
}

static void write_all(volatile struct uart *uart, struct ring *ring, const uint8_t *bytes, size_t count)
{
    const uint32_t before = hal_lock();
    ring_put_all(ring, bytes, count);
    send_on(uart, ring);
    hal_unlock(before);
}

void hal_init(void)
{
    WATCHDOG_LOCK = WATCHDOG_KEY;
    WATCHDOG_LOAD = WATCHDOG_MS * (CLOCK_HZ / 1000u);
    WATCHDOG_CTRL = WATCHDOG_WARNS_AND_RESETS;
    WATCHDOG_LOCK = 0u;
    FPGAIO_PRESCALE = (CLOCK_HZ / 1000000u) - 1u;
    UART1->divider = CLOCK_HZ / FILM_BAUD;
    UART1->ctrl = UART_ALL_ON;
    port_outputs_safe();
}

const uint8_t *hal_settings(size_t *length)
{
    *length = stored_settings_length;
    return stored_settings;
}

void hal_start(uint32_t baud, enum hal_parity parity)
{
    (void)parity; /* this UART has none */
    UART0->divider = CLOCK_HZ / baud;
    UART0->ctrl = UART_ALL_ON;
    TIMER0_RELOAD = (CLOCK_HZ / 1000u) - 1u;
    TIMER0_CTRL = TIMER_RUNS_AND_INTERRUPTS;
    NVIC_PRIORITY_0 = UARTS_BELOW_TIMER;
    NVIC_ISER = INTERRUPTS_USED;
}

uint32_t hal_micros(void)
{
    return FPGAIO_COUNTER;
}

static bool film_fresh(void)
{
    film.heard = film.heard && ((hal_micros() - film.heard_us) <= BENCH_STALE_US);
    return film.heard;
}

int32_t hal_input(enum hal_input_channel channel)
{
    return film_fresh() ? film.inputs[channel] : HAL_NO_VALUE;
}

uint32_t hal_interlocks(void)
{
    return film_fresh() ? film.interlocks : 0u;
}

void hal_outputs(uint32_t pump, uint32_t vent)
{
    const uint32_t now_us = hal_micros();
    if ((pump != film.pump) || (vent != film.vent) || ((now_us - film.said_us) >= 5000u)) {
        uint8_t text[BENCH_SAID_MAX];
        film.pump = pump;
        film.vent = vent;
        film.said_us = now_us;
        write_all(UART1, &film_sending, text, bench_say(pump, vent, text));
    }
}

void hal_watchdog_feed(void)
{
    WATCHDOG_LOCK = WATCHDOG_KEY;
    WATCHDOG_INTCLR = 1u;
    WATCHDOG_LOCK = 0u;
}

void hal_uart_write(const uint8_t *bytes, size_t count)
{
    write_all(UART0, &sending, bytes, count);
}

void mps2_uart0(void)
{
    UART0->interrupts = 3u;
    while ((UART0->state & UART_RX_FULL) != 0u) {
        if ((UART0->state & UART_RX_LOST) != 0u) {
            UART0->state = UART_RX_LOST;
            uart_lost = true;
        }
        if (!ring_put(&uart_received, (uint8_t)UART0->data)) {
            uart_lost = true;
        }
    }
    send_on(UART0, &sending);
}

static void film_line(void)
{
    const uint32_t before = hal_lock();
    for (uint32_t i = 0u; i < (uint32_t)HAL_INPUT_CHANNELS; i++) {
        film.inputs[i] = (int32_t)film.line.numbers[i];
    }
    film.interlocks = (uint32_t)film.line.numbers[BENCH_INTERLOCKS];
    film.heard_us = hal_micros();
    film.heard = true;
    hal_unlock(before);
}

void mps2_uart1(void)
{
    UART1->interrupts = 3u;
    while ((UART1->state & UART_RX_FULL) != 0u) {
        if (bench_take(&film.line, (uint8_t)UART1->data)) {
            film_line();
        }
    }
    const uint32_t before = hal_lock();
    send_on(UART1, &film_sending);
    hal_unlock(before);
}

void mps2_timer0(void)
{
    TIMER0_INTCLEAR = 1u;
    board_tick();
}

void port_outputs_safe(void)
{
    static const uint8_t SAFE[] = "\nO 0 0\n";
    for (uint32_t i = 0u; i < (sizeof(SAFE) - 1u); i++) {
        for (uint32_t wait = 0u; (wait < 10000u) && ((UART1->state & UART_TX_FULL) != 0u); wait++) {
        }
        UART1->data = SAFE[i];
    }
}
