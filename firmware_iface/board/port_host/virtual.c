#include "virtual.h"

#include <string.h>

#include "board.h"
#include "hal.h"

#define LINE_MAX 1024u
#define TICK_US 1000u

static struct {
    uint8_t record[512];
    size_t record_length;
    uint32_t now_us;
    uint32_t tick_in_us;
    uint32_t fed_us; /* the hardware watchdog */
    int32_t inputs[HAL_INPUT_CHANNELS];
    uint32_t interlocks;
    uint32_t pump, vent, resets;
    bool resetting;
    int heard[LINE_MAX];
    size_t heard_count, heard_taken;
    uint8_t said[LINE_MAX];
    size_t said_count;
} chip;

void hal_init(void)
{
    chip.pump = 0u;
    chip.vent = 0u;
    chip.fed_us = chip.now_us;
    chip.tick_in_us = TICK_US;
    chip.resetting = false;
    chip.heard_count = chip.heard_taken = 0u;
}

const uint8_t *hal_settings(size_t *length)
{
    *length = chip.record_length;
    return chip.record;
}

void hal_start(uint32_t baud, enum hal_parity parity)
{
    (void)baud, (void)parity; /* a line in memory has neither */
}

uint32_t hal_micros(void)
{
    return chip.now_us;
}

int32_t hal_input(enum hal_input_channel channel)
{
    return chip.inputs[channel];
}

uint32_t hal_interlocks(void)
{
    return chip.interlocks;
}

void hal_outputs(uint32_t pump, uint32_t vent)
{
    chip.pump = pump;
    chip.vent = vent;
}

void hal_watchdog_feed(void)
{
    chip.fed_us = chip.now_us;
}

void hal_reset(void)
{
    chip.resetting = true;
}

uint32_t hal_lock(void)
{
    return 0u; /* the tick runs between turns of the main loop only */
}

void hal_unlock(uint32_t before)
{
    (void)before;
}

int hal_uart_read(void)
{
    if (chip.heard_taken == chip.heard_count) {
        chip.heard_taken = chip.heard_count = 0u;
        return HAL_UART_EMPTY;
    }
    return chip.heard[chip.heard_taken++];
}

void hal_uart_write(const uint8_t *bytes, size_t count)
{
    if (chip.said_count + count <= LINE_MAX) {
        memcpy(&chip.said[chip.said_count], bytes, count);
        chip.said_count += count;
    }
}

static void restart(void)
{
    hal_init();
    board_start();
}

void virtual_power_on(const uint8_t *record, size_t length)
{
    memset(&chip, 0, sizeof chip);
    chip.record_length = length < sizeof chip.record ? length : sizeof chip.record;
    memcpy(chip.record, record, chip.record_length);
    for (int i = 0; i < HAL_INPUT_CHANNELS; i++) {
        chip.inputs[i] = HAL_NO_VALUE;
    }
    restart();
}

void virtual_pass(uint32_t time_us, bool interrupts, bool main_loop)
{
    while (time_us > 0u) {
        const uint32_t step_us = time_us < chip.tick_in_us ? time_us : chip.tick_in_us;
        time_us -= step_us;
        chip.now_us += step_us;
        chip.tick_in_us -= step_us;
        if (chip.tick_in_us == 0u) {
            chip.tick_in_us = TICK_US;
            if (interrupts) {
                board_tick();
            }
        }
        if (main_loop) {
            board_poll();
        }
        if (chip.resetting || chip.now_us - chip.fed_us >= HAL_WATCHDOG_MAX_MS * 1000u) {
            chip.resets++;
            restart();
        }
    }
}

void virtual_skip(uint32_t time_us)
{
    chip.now_us += time_us;
    chip.fed_us += time_us;
}

void virtual_set_input(int channel, int32_t raw)
{
    if (channel >= 0 && channel < HAL_INPUT_CHANNELS) {
        chip.inputs[channel] = raw;
    }
}

void virtual_set_interlocks(uint32_t closed)
{
    chip.interlocks = closed;
}

uint32_t virtual_pump(void)
{
    return chip.pump;
}

uint32_t virtual_vent(void)
{
    return chip.vent;
}

uint32_t virtual_resets(void)
{
    return chip.resets;
}

static void hear(int what)
{
    if (chip.heard_count < LINE_MAX) {
        chip.heard[chip.heard_count++] = what;
    }
}

void virtual_hear(const uint8_t *bytes, size_t count)
{
    for (size_t i = 0u; i < count; i++) {
        hear(bytes[i]);
    }
}

void virtual_hear_damage(void)
{
    hear(HAL_UART_ERROR);
}

size_t virtual_said(uint8_t *bytes, size_t room)
{
    const size_t count = chip.said_count < room ? chip.said_count : room;
    memcpy(bytes, chip.said, count);
    chip.said_count = 0u;
    return count;
}
