#include "settings.h"

#include <stdbool.h>

#define HEAD_WORDS 8u
#define SCALE_WORDS 6u

static const struct settings WITHOUT_RECORD = {
    .unit_id = 1u,
    .baud = 19200u,
    .parity = (uint32_t)HAL_PARITY_EVEN,
    .silence_us = 2006u,
    /* scales: divisor 0, so that no channel has a value */
    .gauge_fitted = 1u,
    .gauge_timeout_ms = SETTINGS_GAUGE_TIMEOUT_MS,
    .gauge_frozen_ms = SETTINGS_GAUGE_FROZEN_MS,
};

uint32_t settings_crc32(const uint8_t *bytes, size_t count)
{
    uint32_t crc = 0xFFFFFFFFu;
    for (size_t i = 0u; i < count; i++) {
        crc ^= bytes[i];
        for (uint32_t bit = 0u; bit < 8u; bit++) {
            crc = (crc >> 1) ^ (((crc & 1u) != 0u) ? 0xEDB88320u : 0u);
        }
    }
    return crc ^ 0xFFFFFFFFu;
}

uint32_t settings_standard_silence_us(uint32_t baud)
{
    return (baud > 19200u) ? 1750u : ((38500000u + baud - 1u) / baud);
}

static uint32_t word_at(const uint8_t *record, uint32_t index)
{
    const uint8_t *at = &record[4u * index];
    return ((uint32_t)at[0] << 24) | ((uint32_t)at[1] << 16) | ((uint32_t)at[2] << 8) | (uint32_t)at[3];
}

static int32_t signed_of(uint32_t word)
{
    return (word <= (uint32_t)INT32_MAX) ? (int32_t)word : (-(int32_t)(UINT32_MAX - word) - 1);
}

static struct scale scale_at(const uint8_t *record, uint32_t index)
{
    const struct scale scale = {
        .raw_low = signed_of(word_at(record, index)),
        .raw_high = signed_of(word_at(record, index + 1u)),
        .raw_zero = signed_of(word_at(record, index + 2u)),
        .multiplier = signed_of(word_at(record, index + 3u)),
        .divisor = signed_of(word_at(record, index + 4u)),
        .offset = signed_of(word_at(record, index + 5u)),
    };
    return scale;
}

static bool within(uint32_t value, uint32_t low, uint32_t high)
{
    return (value >= low) && (value <= high);
}

static bool usable(const struct settings *found)
{
    bool right = within(found->unit_id, 1u, 247u) && within(found->baud, 1200u, 1000000u) &&
                 within(found->parity, (uint32_t)HAL_PARITY_NONE, (uint32_t)HAL_PARITY_ODD) &&
                 within(found->pressure_limit_mpa, 1u, 100000000u) && within(found->pump_limit, 1u, HAL_FULL_SCALE);
    for (uint32_t i = 0u; i < (uint32_t)HAL_ANALOG_CHANNELS; i++) {
        right = right && (found->scales[i].divisor > 0);
    }
    right = right && within(found->gauge_fitted, 0u, 1u) && within(found->gauge_timeout_ms, 100u, 60000u) &&
            ((found->gauge_frozen_ms == 0u) || within(found->gauge_frozen_ms, 1000u, 600000u)) &&
            within(found->interlocks_fitted, 0u, 0xFFFFu);
    return right && within(found->silence_us, settings_standard_silence_us(found->baud), 1000000u);
}

/* The length that the record states, if it is one of the two, its bytes are there and their CRC is right; otherwise 0. */
static size_t sound_length(const uint8_t *record, size_t length)
{
    size_t found = 0u;
    if ((record != NULL) && (length >= SETTINGS_BYTES_MAP_2) && (word_at(record, 0u) == SETTINGS_MAGIC)) {
        const uint32_t stated = word_at(record, 1u);
        const bool known = (stated == SETTINGS_BYTES) || (stated == SETTINGS_BYTES_MAP_2);
        if (known && (stated <= length) &&
            (word_at(record, (stated / 4u) - 1u) == settings_crc32(record, stated - 4u))) {
            found = stated;
        }
    }
    return found;
}

struct settings settings_load(const uint8_t *record, size_t length)
{
    const size_t stated = sound_length(record, length);
    if (stated == 0u) {
        return WITHOUT_RECORD;
    }
    struct settings found = {
        .unit_id = word_at(record, 2u),
        .baud = word_at(record, 3u),
        .parity = word_at(record, 4u),
        .silence_us = word_at(record, 5u),
        .pressure_limit_mpa = word_at(record, 6u),
        .pump_limit = word_at(record, 7u),
        .gauge_fitted = WITHOUT_RECORD.gauge_fitted,
        .gauge_timeout_ms = WITHOUT_RECORD.gauge_timeout_ms,
        .gauge_frozen_ms = WITHOUT_RECORD.gauge_frozen_ms,
        .interlocks_fitted = WITHOUT_RECORD.interlocks_fitted,
    };
    for (uint32_t i = 0u; i < (uint32_t)HAL_ANALOG_CHANNELS; i++) {
        found.scales[i] = scale_at(record, HEAD_WORDS + (SCALE_WORDS * i));
    }
    if (stated == SETTINGS_BYTES) {
        const uint32_t at = HEAD_WORDS + (SCALE_WORDS * (uint32_t)HAL_ANALOG_CHANNELS);
        found.gauge_fitted = word_at(record, at);
        found.gauge_timeout_ms = word_at(record, at + 1u);
        found.gauge_frozen_ms = word_at(record, at + 2u);
        found.interlocks_fitted = word_at(record, at + 3u);
    }
    return usable(&found) ? found : WITHOUT_RECORD;
}

int32_t settings_counts(const struct scale *scale, int32_t raw)
{
    int32_t counts = HAL_NO_VALUE;
    if ((raw != HAL_NO_VALUE) && (scale->divisor > 0) && (raw >= scale->raw_low) && (raw <= scale->raw_high)) {
        /* (2^32 - 1) * 2^31 at most, and the offset: 64 bits hold it */
        const int64_t span = ((int64_t)raw - scale->raw_zero) * scale->multiplier;
        const int64_t found = scale->offset + (span / scale->divisor);
        if ((found > (int64_t)INT32_MIN) && (found <= (int64_t)INT32_MAX)) {
            counts = (int32_t)found;
        }
    }
    return counts;
}
