/* The board's settings: unit id, line, limits and the scales of its inputs. Written once with the firmware's tool
 * (python -m firmware_iface.board_settings) and protected by a CRC.
 *
 * Record: 32-bit words, big-endian: magic, length in bytes, unit_id, baud, parity, silence_us, pressure_limit_mpa,
 * pump_limit, then for each analog channel raw_low, raw_high, raw_zero, multiplier, divisor, offset; then the CRC-32
 * (zlib's) of all before it.
 * A record that is damaged or absent gives a board that answers as unit 1 at 19200 baud even, has no sensor values and
 * never drives the pump (pump_limit_fraction reads 0). */
#ifndef MEMBRANE_SETTINGS_H
#define MEMBRANE_SETTINGS_H

#include <stddef.h>
#include <stdint.h>

#include "hal.h"

#define SETTINGS_MAGIC 0x4D425331u /* "MBS1" */
#define SETTINGS_BYTES ((8u + (6u * (uint32_t)HAL_ANALOG_CHANNELS) + 1u) * 4u)

/* counts of the register = offset + (raw - raw_zero) * multiplier / divisor; no value outside raw_low..raw_high */
struct scale {
    int32_t raw_low;
    int32_t raw_high;
    int32_t raw_zero;
    int32_t multiplier;
    int32_t divisor;
    int32_t offset;
};

struct settings {
    uint32_t unit_id;            /* 1..247 */
    uint32_t baud;               /* 1200..1000000 */
    uint32_t parity;             /* enum hal_parity */
    uint32_t silence_us;         /* between two frames; at least 3.5 characters, more for a line through a PC's buffers */
    uint32_t pressure_limit_mpa; /* the board's own limit, 1..100000000 */
    uint32_t pump_limit;         /* highest drive, 0..HAL_FULL_SCALE; 0 only in a board without a valid record */
    struct scale scales[HAL_ANALOG_CHANNELS];
};

/* The settings of a record; those of a board without one if it is not valid. */
struct settings settings_load(const uint8_t *record, size_t length);

/* Register counts of a raw value; HAL_NO_VALUE outside the scale's range or an i32. */
int32_t settings_counts(const struct scale *scale, int32_t raw);

/* 3.5 characters of 11 bits; above 19200 baud the standard's 1750 us (Modbus over serial line 1.02, 2.5.1.1). */
uint32_t settings_standard_silence_us(uint32_t baud);

/* CRC-32 of zlib and Ethernet. */
uint32_t settings_crc32(const uint8_t *bytes, size_t count);

#endif
