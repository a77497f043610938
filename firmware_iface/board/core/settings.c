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
    return right && within(found->silence_us, settings_standard_silence_us(found->baud), 1000000u);
}

struct settings settings_load(const uint8_t *record, size_t length)
{
    if ((record == NULL) || (length < SETTINGS_BYTES) || (word_at(record, 0u) != SETTINGS_MAGIC) ||
        (word_at(record, 1u) != SETTINGS_BYTES) ||
        (word_at(record, (SETTINGS_BYTES / 4u) - 1u) != settings_crc32(record, SETTINGS_BYTES - 4u))) {
        return WITHOUT_RECORD;
    }
    struct settings found = {
        .unit_id = word_at(record, 2u),
        .baud = word_at(record, 3u),
        .parity = word_at(record, 4u),
        .silence_us = word_at(record, 5u),
        .pressure_limit_mpa = word_at(record, 6u),
        .pump_limit = word_at(record, 7u),
    };
    for (uint32_t i = 0u; i < (uint32_t)HAL_ANALOG_CHANNELS; i++) {
        found.scales[i] = scale_at(record, HEAD_WORDS + (SCALE_WORDS * i));
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
