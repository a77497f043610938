/* Fuzzing of the whole firmware on its virtual hardware, over RTU and TCP, by libFuzzer.
 *
 * An input is a list of steps: a byte that says what happens, then what that needs. Frames that claim, command and clear
 * are at hand whole, so that mutations of them get deep. After every input the pump must be off once the watchdog's
 * period in force has passed without a word. It must be off in every step while a fitted interlock is open, and once the
 * gauge has been without a value for its time-out. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "bench_line.h"
#include "board.h"
#include "settings.h"
#include "tcp.h"
#include "virtual.h"

#define STEPS_MAX 64u

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static const char *const WHOLE[] = {
    "\x01\x10\x00\x30\x00\x06\x0c\x00\x64\x00\x01\x00\x00\x00\x07\x12\x34\x56\x78",     /* claims, 0.1 s */
    "\x01\x10\x00\x38\x00\x05\x0a\x61\xa8\x30\xd4\x00\x05\x12\x34\x56\x78",             /* commands pump and vent */
    "\x01\x10\x00\x40\x00\x03\x06\xff\xff\x12\x34\x56\x78",                             /* clears */
    "\x01\x06\x00\x48\x00\x01",                                                         /* stops */
    "\x01\x03\x00\x10\x00\x1a",                                                         /* reads the sensors */
    "\x01\x17\x00\x10\x00\x1a\x00\x38\x00\x05\x0a\x61\xa8\x00\x00\x00\x06\x12\x34\x56\x78", /* commands and reads */
    "\x01\x08\x00\x00\x12\x34",                                                         /* query data */
};
static const uint8_t LENGTHS[] = {19, 17, 13, 6, 6, 21, 6};

static uint8_t record[SETTINGS_BYTES];
static unsigned long frames; /* asked in all */

__attribute__((destructor)) static void count_frames(void)
{
    fprintf(stderr, "%lu frames\n", frames);
}

#define GAUGE_TIMEOUT_MS 200u
#define INTERLOCKS_FITTED 5u
#define SAMPLED_US (2u * BOARD_SAMPLE_US) /* until the board has noticed what an input shows */
/* gauge_fitted, gauge_timeout_ms, gauge_frozen_ms, interlocks_fitted */
static const uint32_t PROTECTION[] = {1u, GAUGE_TIMEOUT_MS, 1000u, INTERLOCKS_FITTED};
static uint32_t interlocks; /* closed circuits */
static bool gauge_absent;
static uint32_t gauge_seen_us;

static void put_word(uint32_t index, uint32_t value)
{
    for (uint32_t i = 0u; i < 4u; i++) {
        record[4u * index + i] = (uint8_t)(value >> (24u - 8u * i));
    }
}

static void make_record(void)
{
    const uint32_t head[] = {SETTINGS_MAGIC, SETTINGS_BYTES, 1u, 115200u, 0u, 1750u, 800000u, 50000u};
    const uint32_t scale[] = {0x80000001u, 0x7FFFFFFFu, 0u, 1u, 1u, 0u};
    for (uint32_t i = 0u; i < 8u; i++) {
        put_word(i, head[i]);
    }
    for (uint32_t i = 0u; i < 30u; i++) {
        put_word(8u + i, scale[i % 6u]);
    }
    for (uint32_t i = 0u; i < 4u; i++) {
        put_word(38u + i, PROTECTION[i]);
    }
    put_word(42u, settings_crc32(record, SETTINGS_BYTES - 4u));
}

/* A network of one connection whose bytes are those of the input. */
static struct {
    const uint8_t *bytes;
    size_t count;
    bool offered, up;
} wire;

static int wire_accept(void)
{
    const bool offered = wire.offered;
    wire.offered = false;
    return offered ? 0 : TCP_NONE;
}

static int wire_receive(int connection, uint8_t *bytes, size_t room)
{
    const size_t count = wire.count < room ? wire.count : room;
    (void)connection;
    if (!wire.up) {
        return -1;
    }
    memcpy(bytes, wire.bytes, count);
    wire.bytes += count;
    wire.count -= count;
    return (int)count;
}

static int wire_send(int connection, const uint8_t *bytes, size_t count)
{
    (void)connection, (void)bytes;
    if (count < 9u || count > 260u) {
        abort();
    }
    return 0;
}

static void wire_close(int connection)
{
    (void)connection;
    wire.up = false;
}

static const struct network WIRE = {wire_accept, wire_receive, wire_send, wire_close};

static uint32_t crc16(const uint8_t *bytes, size_t count)
{
    uint32_t crc = 0xFFFFu;
    for (size_t i = 0u; i < count; i++) {
        crc ^= bytes[i];
        for (int bit = 0; bit < 8; bit++) {
            crc = (crc >> 1) ^ ((crc & 1u) != 0u ? 0xA001u : 0u);
        }
    }
    return crc;
}

static void ask(const uint8_t *body, size_t count, bool over_tcp, bool sealed)
{
    uint8_t frame[300] = {0}, said[1024];
    frames++;
    if (count > 256u) {
        count = 256u;
    }
    if (over_tcp) {
        frame[5] = (uint8_t)count;
        memcpy(&frame[6], body, count);
        wire.bytes = sealed ? frame : body;
        wire.count = sealed ? count + 6u : count;
        for (int turn = 0; turn < 4; turn++) {
            tcp_poll(&WIRE, 1u);
        }
        wire.count = 0u;
        wire.offered = !wire.up;
        wire.up = true;
        virtual_pass(1000u, true, true);
        return;
    }
    memcpy(frame, body, count);
    if (sealed) {
        const uint32_t crc = crc16(frame, count);
        frame[count++] = (uint8_t)(crc & 0xFFu);
        frame[count++] = (uint8_t)(crc >> 8);
    }
    virtual_hear(frame, count);
    virtual_pass(3000u, true, true);
    virtual_said(said, sizeof said);
}

static size_t take(const uint8_t **data, size_t *size, size_t most)
{
    const size_t found = *size < most ? *size : most;
    *data += found;
    *size -= found;
    return found;
}

static void step(const uint8_t **data, size_t *size)
{
    static struct bench_line line;
    const uint8_t what = (*data)[0];
    (void)take(data, size, 1u);
    const uint8_t *at = *data;
    if (what < 0x60u) { /* a frame that is right but for one byte, or quite right */
        const size_t which = what % (sizeof LENGTHS / sizeof LENGTHS[0]);
        uint8_t frame[32];
        memcpy(frame, WHOLE[which], LENGTHS[which]);
        if (take(data, size, 2u) == 2u && (what & 0x10u) != 0u) {
            frame[at[0] % LENGTHS[which]] = at[1];
        }
        ask(frame, LENGTHS[which], (what & 0x40u) != 0u, true);
    } else if (what < 0xC0u) { /* a frame of the input's own */
        const size_t wanted = *size > 0u ? at[0] : 0u;
        (void)take(data, size, 1u);
        at = *data;
        const size_t count = take(data, size, wanted);
        ask(at, count, (what & 1u) != 0u, (what & 2u) != 0u);
    } else if (what < 0xE0u) { /* the sensors */
        const size_t count = take(data, size, 4u);
        virtual_set_input(what % HAL_INPUT_CHANNELS, count == 4u ? (int32_t)(crc16(at, 4u) * 20u) : HAL_NO_VALUE);
        if (what % HAL_INPUT_CHANNELS == HAL_GAUGE_PRESSURE) {
            gauge_seen_us = gauge_absent ? gauge_seen_us : hal_micros();
            gauge_absent = count != 4u;
        }
        for (size_t i = 0u; i < count; i++) {
            (void)bench_take(&line, at[i]);
        }
    } else if (what < 0xF0u) {
        virtual_pass(1000u * (what & 0xFu) * (what & 0xFu), true, true);
    } else if (what < 0xF8u) {
        virtual_hear_damage();
    } else {
        interlocks = what & 7u;
        virtual_set_interlocks(interlocks);
        virtual_pass(SAMPLED_US, true, true);
    }
}

static bool may_pump(void)
{
    const bool gauge = !gauge_absent || hal_micros() - gauge_seen_us <= 1000u * GAUGE_TIMEOUT_MS + SAMPLED_US;
    return gauge && (INTERLOCKS_FITTED & ~interlocks) == 0u;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    make_record();
    memset(&wire, 0, sizeof wire);
    tcp_start();
    virtual_power_on(record, sizeof record);
    virtual_set_input(HAL_GAUGE_PRESSURE, 0);
    interlocks = 7u;
    virtual_set_interlocks(interlocks);
    gauge_absent = false;
    for (unsigned int i = 0u; size > 0u && i < STEPS_MAX; i++) {
        step(&data, &size);
        const bool driven = virtual_pump() > 0u;
        if (virtual_pump() > 50000u || virtual_vent() > 50000u || (driven && virtual_resets() > 0u) ||
            (driven && !may_pump())) {
            abort();
        }
    }
    uint16_t period_ms = 0u;
    if (virtual_pump() > 0u && board_read(MEMBRANE_PERIOD_IN_FORCE_S_ADDRESS, 1u, &period_ms) == BOARD_DONE) {
        virtual_pass(1000u * (period_ms + 1u), true, true);
    }
    if (virtual_pump() > 0u || virtual_resets() > 0u) {
        abort();
    }
    return 0;
}
