/* The hardware layer in memory: a board whose time, inputs, outputs and line a test or a program moves. */
#ifndef MEMBRANE_VIRTUAL_H
#define MEMBRANE_VIRTUAL_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* Supply on, with a record of settings (copied). */
void virtual_power_on(const uint8_t *record, size_t length);

/* Lets time pass: timer interrupts every millisecond and, between them, turns of the main loop. Either can be dead.
 * The hardware watchdog runs all the time. */
void virtual_pass(uint32_t time_us, bool interrupts, bool main_loop);

/* Lets time pass in which nothing runs, not even the hardware watchdog. */
void virtual_skip(uint32_t time_us);

void virtual_set_input(int channel, int32_t raw);
void virtual_set_interlocks(uint32_t closed); /* all open at power-on */
uint32_t virtual_pump(void);
uint32_t virtual_vent(void);
uint32_t virtual_resets(void); /* since power-on */

/* The line: bytes to the board, a byte lost on the way, and what it said since the last call. */
void virtual_hear(const uint8_t *bytes, size_t count);
void virtual_hear_damage(void);
size_t virtual_said(uint8_t *bytes, size_t room);

#endif
