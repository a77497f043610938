/* The wire of simulated boards to a simulated film, in lines of text.
 *
 * To the board: "I <displacement> <gauge> <ambient> <air> <gas> <quality> <interlocks>\n", raw values of the channels of
 * hal.h, -2147483648 for "no value", and the closed interlock inputs as bits. From the board: "O <pump> <vent>\n", counts of HAL_FULL_SCALE, at every change and every
 * 5 ms. */
#ifndef MEMBRANE_BENCH_LINE_H
#define MEMBRANE_BENCH_LINE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "hal.h"

#define BENCH_STALE_US 500000u /* without a line for so long no channel has a value; a busy PC may pause the film */
#define BENCH_SAID_MAX 24u
#define BENCH_INTERLOCKS ((uint32_t)HAL_INPUT_CHANNELS) /* place of this number, the last one */
#define BENCH_NUMBERS (BENCH_INTERLOCKS + 1u)

struct bench_line {
    int64_t numbers[BENCH_NUMBERS];
    uint32_t count; /* of numbers begun; above BENCH_NUMBERS: not a line of this kind */
    bool negative;
    bool begun; /* within a number */
    bool right; /* nothing unknown in this line */
};

/* Takes a byte; true when it completes a valid line, whose numbers are then valid. */
bool bench_take(struct bench_line *line, uint8_t byte);

/* Writes an output line (not terminated by 0); returns its length. */
size_t bench_say(uint32_t pump, uint32_t vent, uint8_t *text);

#endif
