/* The board between two requests: claim, watchdog, latched faults, outputs. docs/reference/firmware.md says what it must do. */
#ifndef MEMBRANE_BOARD_STATE_H
#define MEMBRANE_BOARD_STATE_H

#include <stdbool.h>
#include <stdint.h>

#include "membrane_board.h"

#define BOARD_FIRMWARE_VERSION 0x00010100u /* 1.1.0 */
#define BOARD_WORDS (MEMBRANE_STOP_ADDRESS + 1u) /* addresses 0..BOARD_WORDS-1, some of them unused */
#define BOARD_SAMPLE_US 5000u    /* between two samples of the sensors */
#define BOARD_STALLED_TICKS 20u  /* a main loop that has not turned for so long is frozen */

/* The answer to a write: 0, or the code of a Modbus exception. */
enum board_answer { BOARD_DONE = 0, BOARD_ADDRESS = 2, BOARD_VALUE = 3, BOARD_FAILED = 4, BOARD_BUSY = 6 };

struct settings;

/* Power-up: loads the settings; outputs off, watchdog off, no claim, no faults. */
void board_start(void);

/* The settings in force. */
const struct settings *board_settings(void);

/* From the timer interrupt, every millisecond: verifies the memory, samples the sensors, lets the pressure limit and the
 * watchdog act, drives the outputs, feeds the hardware watchdog. A lost gauge and an open interlock act here as well. */
void board_tick(void);

/* From the main loop, at least every 20 ms: answers what arrived on the UART. */
void board_poll(void);

/* Tells the tick that the main loop turns. board_poll() does so; a main loop with a long turn may do so in between. */
void board_turned(void);

/* Copies words of one instant. BOARD_ADDRESS if one of them does not exist. */
enum board_answer board_read(uint32_t address, uint32_t count, uint16_t *words);

/* Writes one whole block or nothing. */
enum board_answer board_write(uint32_t address, uint32_t count, const uint16_t *words);

#endif
