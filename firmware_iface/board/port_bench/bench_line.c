#include "bench_line.h"

static void begin(struct bench_line *line)
{
    line->count = 0u;
    line->negative = false;
    line->begun = false;
    line->right = true;
}

static void take_digit(struct bench_line *line, int64_t digit)
{
    if (!line->begun) {
        line->begun = true;
        line->count++;
        if (line->count <= BENCH_NUMBERS) {
            line->numbers[line->count - 1u] = 0;
        }
    }
    if (line->count <= BENCH_NUMBERS) {
        int64_t *number = &line->numbers[line->count - 1u];
        *number = (*number * 10) + (line->negative ? -digit : digit);
        line->right = line->right && (*number >= (int64_t)INT32_MIN) && (*number <= (int64_t)INT32_MAX);
        *number = line->right ? *number : 0;
    }
}

bool bench_take(struct bench_line *line, uint8_t byte)
{
    bool complete = false;
    if (byte == (uint8_t)'I') {
        begin(line);
    } else if (byte == (uint8_t)'\n') {
        complete = line->right && (line->count == BENCH_NUMBERS);
        line->right = false;
    } else if ((byte >= (uint8_t)'0') && (byte <= (uint8_t)'9')) {
        take_digit(line, (int64_t)byte - (int64_t)'0');
    } else if (byte == (uint8_t)'-') {
        line->right = line->right && !line->begun;
        line->negative = true;
    } else if (byte == (uint8_t)' ') {
        line->begun = false;
        line->negative = false;
    } else {
        line->right = false;
    }
    return complete;
}

static size_t say_number(uint32_t number, uint8_t *text)
{
    uint32_t unit = 10000u;
    size_t said = 0u;
    while ((unit > 1u) && (number < unit)) {
        unit /= 10u;
    }
    for (; unit > 0u; unit /= 10u) {
        text[said] = (uint8_t)('0' + (int)((number / unit) % 10u));
        said++;
    }
    return said;
}

size_t bench_say(uint32_t pump, uint32_t vent, uint8_t *text)
{
    size_t said = 2u;
    text[0] = (uint8_t)'O';
    text[1] = (uint8_t)' ';
    said += say_number(pump, &text[said]);
    text[said] = (uint8_t)' ';
    said++;
    said += say_number(vent, &text[said]);
    text[said] = (uint8_t)'\n';
    return said + 1u;
}
