/* The board's settings: unit id, line, limits, the scales of its inputs, and which protections are fitted. Written once
 * with the firmware's tool (python -m firmware_iface.board_settings) and protected by a CRC.
 *
 * Record: 32-bit words, big-endian: magic, length in bytes, unit_id, baud, parity, silence_us, pressure_limit_mpa,
 * pump_limit, then for each analog channel raw_low, raw_high, raw_zero, multiplier, divisor, offset; then gauge_fitted,
 * gauge_timeout_ms, gauge_frozen_ms, interlocks_fitted; then the CRC-32 (zlib's) of all before it.
 * A record of a board of map version 1 or 2 is shorter: it has no words after the scales. It means that the gauge is
 * fitted, with the times below, and that no interlock is.
 * A record that is damaged or absent gives a board that answers as unit 1 at 19200 baud even, has no sensor values and
 * never drives the pump (pump_limit_fraction reads 0). */
#ifndef MEMBRANE_SETTINGS_H
#define MEMBRANE_SETTINGS_H

#include <stddef.h>
#include <stdint.h>

#include "hal.h"

#define SETTINGS_MAGIC 0x4D425331u /* "MBS1" */
#define SETTINGS_BYTES_MAP_2 ((8u + (6u * (uint32_t)HAL_ANALOG_CHANNELS) + 1u) * 4u)
#define SETTINGS_BYTES (SETTINGS_BYTES_MAP_2 + 16u)

/* Longer than the host takes to notice a missing gauge and to ramp the flow down; short against the hours that a pump
 * needs from the working pressure to the limit. */
#define SETTINGS_GAUGE_TIMEOUT_MS 15000u
/* The noise of a pressure transmitter changes its reading many times a second. */
#define SETTINGS_GAUGE_FROZEN_MS 60000u

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
    uint32_t gauge_fitted;      /* 0: no gauge, the board has no pressure limit; otherwise 1 */
    uint32_t gauge_timeout_ms;  /* of pumping without a value of the gauge, 100..60000 */
    uint32_t gauge_frozen_ms;   /* of pumping with a gauge that repeats its value, 1000..600000; 0: not judged */
    uint32_t interlocks_fitted; /* bit i: input i stops the pump when it is open, 0..65535 */
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
