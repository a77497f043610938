/* The hardware layer: what a port of the board provides to the core.
 *
 * A port calls three functions of board.h: board_start() once, board_tick() from a timer interrupt every millisecond,
 * board_poll() from the main loop, again and again. main.c does so for a port without an operating system.
 *
 * Order at reset: hal_init() (outputs safe before anything else, hardware watchdog running), board_start(), hal_start().
 *
 * Safe state: pump 0, vent 0, which the output stages must also take by themselves while the processor is in reset, has
 * no supply, or drives no pin (pull-downs). Handlers of faults (hard fault, stack overflow, unexpected interrupt) drive
 * the safe state directly and then reset the processor; they call nothing of the core.
 *
 * Interrupts: only hal_micros(), hal_input(), hal_interlocks(), hal_outputs(), hal_watchdog_feed() and hal_reset() are
 * called from board_tick(). None of them may wait for anything. */
#ifndef MEMBRANE_HAL_H
#define MEMBRANE_HAL_H

#include <stddef.h>
#include <stdint.h>

#define HAL_NO_VALUE INT32_MIN  /* of an input: the sensor is broken, absent or late */
#define HAL_FULL_SCALE 50000u   /* counts of an output at 100 % */
#define HAL_WATCHDOG_MAX_MS 100u /* the hardware watchdog resets the processor at most this long after the last feed */

enum hal_input_channel {
    HAL_DISPLACEMENT,
    HAL_GAUGE_PRESSURE,
    HAL_AMBIENT_PRESSURE,
    HAL_AIR_TEMPERATURE,
    HAL_GAS_TEMPERATURE,
    HAL_ANALOG_CHANNELS,                            /* the channels above are scaled by the board's settings */
    HAL_DISPLACEMENT_QUALITY = HAL_ANALOG_CHANNELS, /* 0: good; otherwise the laser's error code, 1..65535 */
    HAL_INPUT_CHANNELS
};

enum hal_parity { HAL_PARITY_NONE, HAL_PARITY_EVEN, HAL_PARITY_ODD };

/* Outputs to their safe state, clocks, pins, hardware watchdog on. Called first of all. */
void hal_init(void);

/* The record of settings, see settings.h: where it is stored and its length. Need not be valid: the core checks it. */
const uint8_t *hal_settings(size_t *length);

/* Starts the UART and then the timer interrupt that calls board_tick() every millisecond. */
void hal_start(uint32_t baud, enum hal_parity parity);

/* A free-running counter of microseconds that wraps at 2^32, independent of the timer interrupt. */
uint32_t hal_micros(void);

/* The newest raw value of a channel, not older than 10 ms, or HAL_NO_VALUE: converter counts, or the number that a
 * digital sensor sent. Conversions run in the background; this function only fetches. A value that has not been renewed
 * for 100 ms is HAL_NO_VALUE, never the last one. */
int32_t hal_input(enum hal_input_channel channel);

/* Interlock inputs 0..15: bit i is set while the circuit of input i is closed. An input is normally closed: a cut wire, a
 * lost supply, an input that the port does not have and one that was not read for 10 ms are open, and their bit is 0. */
uint32_t hal_interlocks(void);

/* Drives pump and vent, 0..HAL_FULL_SCALE. Called every millisecond. The pump's stage should need these calls as well:
 * an enable by charge pump or monostable that drops out when they cease for 20 ms. */
void hal_outputs(uint32_t pump, uint32_t vent);

/* Feeds the hardware watchdog. Called every millisecond while the board is in order, and from nowhere else. */
void hal_watchdog_feed(void);

/* Resets the processor, outputs safe at once; does not return on hardware. */
void hal_reset(void);

/* From the main loop: waits for the next interrupt (WFI), at most a millisecond. May return at once. */
void hal_wait(void);

/* Keeps board_tick() from running until hal_unlock(); returns what hal_unlock() needs. Held for some microseconds. */
uint32_t hal_lock(void);
void hal_unlock(uint32_t before);

/* The next received byte; HAL_UART_EMPTY; HAL_UART_ERROR once for each byte lost or damaged (overrun, parity, framing).
 * An interrupt fills a buffer of 256 bytes or more. */
#define HAL_UART_EMPTY (-1)
#define HAL_UART_ERROR (-2)
int hal_uart_read(void);

/* Sends bytes (at most 256) in the background and drives the RS-485 transmitter. Never waits: what does not fit into the
 * port's buffer is lost. */
void hal_uart_write(const uint8_t *bytes, size_t count);

#endif
