#include "rtu.h"

#include <stdbool.h>

#include "hal.h"
#include "modbus.h"

#define FRAME_MAX 256u
#define FRAME_MIN 4u /* unit, function, CRC */
#define BROADCAST 0u
#define DIAGNOSTICS 8u

static struct {
    uint8_t bytes[FRAME_MAX];
    uint32_t count;
    uint32_t heard_us; /* when the last byte was taken */
    uint32_t crc;      /* of all bytes; 0 after a whole frame, as that ends with its own CRC */
    bool damaged;      /* a byte was lost or too many came: unusable until the next silence */
} frame;

static uint32_t crc_next(uint32_t crc, uint8_t byte)
{
    uint32_t next = crc ^ byte;
    for (uint32_t bit = 0u; bit < 8u; bit++) {
        next = (next >> 1) ^ (((next & 1u) != 0u) ? 0xA001u : 0u);
    }
    return next;
}

static void listen(void)
{
    frame.count = 0u;
    frame.crc = 0xFFFFu;
    frame.damaged = false;
}

void rtu_start(void)
{
    listen();
    frame.heard_us = hal_micros();
}

static void take(int heard)
{
    frame.heard_us = hal_micros();
    if ((heard < 0) || (frame.count >= FRAME_MAX)) {
        frame.damaged = true;
        return;
    }
    const uint8_t byte = (uint8_t)heard;
    frame.bytes[frame.count] = byte;
    frame.count++;
    frame.crc = crc_next(frame.crc, byte);
}

static void answer_frame(void)
{
    static uint8_t answer[FRAME_MAX];
    const uint8_t *pdu = &frame.bytes[1];
    const size_t length = (size_t)frame.count - 3u;
    size_t said = 0u;
    if ((pdu[0] == DIAGNOSTICS) && (length >= 3u) && (pdu[1] == 0u) && (pdu[2] == 0u)) {
        for (said = 0u; said < length; said++) {
            answer[1u + said] = pdu[said];
        }
    } else {
        said = modbus_respond(pdu, length, &answer[1]);
    }
    if (frame.bytes[0] == BROADCAST) {
        return;
    }
    answer[0] = frame.bytes[0];
    uint32_t crc = 0xFFFFu;
    for (size_t i = 0u; i <= said; i++) {
        crc = crc_next(crc, answer[i]);
    }
    answer[said + 1u] = (uint8_t)(crc & 0xFFu);
    answer[said + 2u] = (uint8_t)(crc >> 8);
    hal_uart_write(answer, said + 3u);
}

static bool whole_frame(void)
{
    return (!frame.damaged) && (frame.crc == 0u) && (frame.count >= FRAME_MIN) && (frame.count <= FRAME_MAX);
}

/* A frame ends with the line's silence. Where the settings ask for a longer silence than the standard's, because a PC's
 * buffers tear frames apart, one with a right CRC need not wait for that. */
static bool frame_ended(const struct settings *settings)
{
    const uint32_t silence_us = whole_frame() ? settings_standard_silence_us(settings->baud) : settings->silence_us;
    return (hal_micros() - frame.heard_us) >= silence_us;
}

void rtu_poll(const struct settings *settings)
{
    for (uint32_t i = 0u; i < FRAME_MAX; i++) { /* a line that never falls silent must not hold the main loop */
        const int heard = hal_uart_read();
        if (heard == HAL_UART_EMPTY) {
            break;
        }
        take(heard);
    }
    if (((frame.count == 0u) && !frame.damaged) || !frame_ended(settings)) {
        return;
    }
    const uint32_t unit = frame.bytes[0];
    if (whole_frame() && ((unit == settings->unit_id) || (unit == BROADCAST))) {
        answer_frame();
    }
    listen();
}
