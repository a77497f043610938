#include "board.h"

#include <string.h>

#include "guard.h"
#include "hal.h"
#include "register_table.h"
#include "rtu.h"
#include "settings.h"

#define AGE_MAX_US 1000000000u /* ages stop here: longer than every period and time-out, and no overflow */
#define PERIOD_AT_START_MS 1000u
#define QUALITY_UNKNOWN 0xFFFF /* of a laser that says nothing */

/* What the board decides by. 32-bit members only: the guard counts words. */
struct state {
    struct settings settings;
    int32_t sensors[HAL_INPUT_CHANNELS]; /* of the newest sample, in counts of the registers */
    uint32_t sample_counter;
    uint32_t sample_s; /* when it was taken, since power-up */
    uint32_t sample_us;
    uint32_t up_s; /* since power-up */
    uint32_t up_us;
    uint32_t tick_us; /* hal_micros() of the last tick */
    uint32_t next_sample_us;
    int32_t unfed_us; /* age of the last feed at the last tick; below 0: fed since */
    uint32_t period_ms;
    uint32_t armed;
    uint32_t claim_id;
    uint32_t claim_key; /* 0: no claim */
    uint32_t pump;      /* commanded, in counts */
    uint32_t vent;
    uint32_t heartbeat;     /* written last */
    uint32_t heartbeat_fed; /* that fed last */
    uint32_t faults;
    uint32_t interlocks;       /* bit i: the circuit of input i is closed, at the newest sample */
    uint32_t gauge_missing_us; /* since the gauge last had a value; AGE_MAX_US: not since power-up */
    int32_t gauge_mpa;         /* its newest value; HAL_NO_VALUE before the first one */
    uint32_t gauge_same_us;    /* of pumping since this value changed, or since a person cleared `gauge_lost` */
};

static union {
    struct state state;
    uint32_t words[sizeof(struct state) / sizeof(uint32_t)];
} now; /* in force; changed only between hal_lock() and hal_unlock() or in the tick */

#define STATE_WORDS (sizeof(now.words) / sizeof(now.words[0]))

static uint32_t inverse[STATE_WORDS]; /* of `now`: they differ once memory is damaged */
static volatile uint32_t stalled_ticks; /* since the main loop turned */

static bool sound(void)
{
    return guard_holds(now.words, inverse, STATE_WORDS);
}

static void seal(void)
{
    guard_seal(now.words, inverse, STATE_WORDS);
}

void board_start(void)
{
    size_t length = 0u;
    const uint8_t *record = hal_settings(&length);
    (void)memset(&now, 0, sizeof(now));
    now.state.settings = settings_load(record, length);
    for (uint32_t i = 0u; i < (uint32_t)HAL_ANALOG_CHANNELS; i++) {
        now.state.sensors[i] = HAL_NO_VALUE;
    }
    now.state.sensors[HAL_DISPLACEMENT_QUALITY] = QUALITY_UNKNOWN;
    now.state.gauge_missing_us = AGE_MAX_US;
    now.state.gauge_mpa = HAL_NO_VALUE;
    now.state.period_ms = PERIOD_AT_START_MS;
    now.state.tick_us = hal_micros();
    seal();
    stalled_ticks = 0u;
    rtu_start();
}

const struct settings *board_settings(void)
{
    return &now.state.settings;
}

void board_turned(void)
{
    stalled_ticks = 0u;
}

void board_poll(void)
{
    board_turned();
    rtu_poll(&now.state.settings);
}

static uint32_t pump_driven(const struct state *state)
{
    const uint32_t limit = state->settings.pump_limit;
    const uint32_t wanted = (state->pump < limit) ? state->pump : limit;
    return (state->faults != 0u) ? 0u : wanted;
}

static uint32_t vent_driven(const struct state *state)
{
    return ((state->faults & MEMBRANE_FAULT_OVER_PRESSURE) != 0u) ? HAL_FULL_SCALE : state->vent;
}

static void latch(struct state *state, uint32_t fault)
{
    state->faults |= fault;
    state->pump = 0u; /* nothing moves when the fault is cleared */
}

static uint32_t age_after(uint32_t age_us, uint32_t elapsed_us)
{
    return (elapsed_us < (AGE_MAX_US - age_us)) ? (age_us + elapsed_us) : AGE_MAX_US;
}

/* The gauge protects only while its values are new: for how long has it had none, or the same one? */
static void watch_gauge(struct state *state, uint32_t elapsed_us)
{
    const int32_t gauge_mpa = state->sensors[HAL_GAUGE_PRESSURE];
    const bool present = gauge_mpa != HAL_NO_VALUE;
    state->gauge_missing_us = present ? 0u : age_after(state->gauge_missing_us, elapsed_us);
    if (pump_driven(state) > 0u) {
        state->gauge_same_us = age_after(state->gauge_same_us, elapsed_us);
    }
    if (present && (gauge_mpa != state->gauge_mpa)) {
        state->gauge_mpa = gauge_mpa;
        state->gauge_same_us = 0u;
    }
}

static bool gauge_lost(const struct state *state)
{
    const struct settings *settings = &state->settings;
    const bool missing = state->gauge_missing_us > (settings->gauge_timeout_ms * 1000u);
    const bool frozen =
        (settings->gauge_frozen_ms != 0u) && (state->gauge_same_us > (settings->gauge_frozen_ms * 1000u));
    return (settings->gauge_fitted != 0u) && (missing || frozen);
}

/* Judged in every tick and after every write, so that no command drives the pump even for a tick.
 *
 * A lost gauge matters only to a pump that is to run. Its age grows while the fault is latched and when it is cleared:
 * without a new value the pump does not run again. An open circuit latches always: that somebody pressed an emergency
 * stop must not be forgotten because the pump was off at that moment. */
static void protect(struct state *state)
{
    if ((state->pump > 0u) && gauge_lost(state)) {
        latch(state, MEMBRANE_FAULT_GAUGE_LOST);
    }
    if ((state->settings.interlocks_fitted & ~state->interlocks) != 0u) {
        latch(state, MEMBRANE_FAULT_INTERLOCK);
    }
}

static void sample(struct state *state)
{
    for (uint32_t i = 0u; i < (uint32_t)HAL_ANALOG_CHANNELS; i++) {
        state->sensors[i] = settings_counts(&state->settings.scales[i], hal_input((enum hal_input_channel)i));
    }
    const int32_t quality = hal_input(HAL_DISPLACEMENT_QUALITY);
    state->sensors[HAL_DISPLACEMENT_QUALITY] = (quality == HAL_NO_VALUE) ? QUALITY_UNKNOWN : quality;
    state->interlocks = hal_interlocks() & 0xFFFFu;
    state->sample_counter++;
    state->sample_s = state->up_s;
    state->sample_us = state->up_us;
    const int32_t gauge_mpa = state->sensors[HAL_GAUGE_PRESSURE];
    if ((gauge_mpa > 0) && ((uint32_t)gauge_mpa > state->settings.pressure_limit_mpa)) {
        latch(state, MEMBRANE_FAULT_OVER_PRESSURE);
    }
}

static void pass(struct state *state, uint32_t elapsed_us)
{
    state->up_us += elapsed_us;
    while (state->up_us >= 1000000u) {
        state->up_us -= 1000000u;
        state->up_s++;
    }
    state->unfed_us += (int32_t)((elapsed_us < AGE_MAX_US) ? elapsed_us : AGE_MAX_US);
    if (state->unfed_us > (int32_t)AGE_MAX_US) {
        state->unfed_us = (int32_t)AGE_MAX_US;
    }
}

static bool fed_in_time(const struct state *state)
{
    return state->unfed_us <= (int32_t)(state->period_ms * 1000u);
}

void board_tick(void)
{
    struct state *state = &now.state;
    const uint32_t now_us = hal_micros();
    const uint32_t elapsed_us = now_us - state->tick_us;
    if ((!sound()) || (elapsed_us == 0u)) { /* memory is damaged, or the clock stands still */
        hal_outputs(0u, 0u);
        hal_reset();
        return;
    }
    state->tick_us = now_us;
    pass(state, elapsed_us);
    state->next_sample_us -= (elapsed_us < state->next_sample_us) ? elapsed_us : state->next_sample_us;
    if (state->next_sample_us == 0u) {
        state->next_sample_us = BOARD_SAMPLE_US;
        sample(state);
    }
    watch_gauge(state, elapsed_us);
    protect(state);
    if ((state->armed != 0u) && !fed_in_time(state)) {
        latch(state, MEMBRANE_FAULT_WATCHDOG);
    }
    if (stalled_ticks < BOARD_STALLED_TICKS) {
        stalled_ticks++;
        hal_outputs(pump_driven(state), vent_driven(state));
        hal_watchdog_feed();
    } else { /* nobody answers any more: the hardware watchdog ends this */
        hal_outputs(0u, vent_driven(state));
    }
    seal();
}

static void put(uint16_t *image, uint32_t address, uint32_t value)
{
    image[address] = (uint16_t)(value >> 16);
    image[address + 1u] = (uint16_t)(value & 0xFFFFu);
}

static uint32_t bits_of(float value)
{
    uint32_t bits;
    (void)memcpy(&bits, &value, sizeof(bits));
    return bits;
}

static void identify(const struct state *state, uint16_t *image)
{
    image[MEMBRANE_DEVICE_KIND_ADDRESS] = (uint16_t)MEMBRANE_DEVICE_KIND;
    image[MEMBRANE_MAP_VERSION_ADDRESS] = (uint16_t)MEMBRANE_MAP_VERSION;
    put(image, MEMBRANE_FIRMWARE_VERSION_ADDRESS, BOARD_FIRMWARE_VERSION);
    put(image, MEMBRANE_GAUGE_PRESSURE_LIMIT_PA_ADDRESS,
        bits_of((float)state->settings.pressure_limit_mpa / 1000.0f));
    image[MEMBRANE_PUMP_LIMIT_FRACTION_ADDRESS] = (uint16_t)state->settings.pump_limit;
    image[MEMBRANE_GAUGE_FITTED_ADDRESS] = (uint16_t)state->settings.gauge_fitted;
    image[MEMBRANE_GAUGE_TIMEOUT_S_ADDRESS] = (uint16_t)state->settings.gauge_timeout_ms;
    image[MEMBRANE_GAUGE_FROZEN_S_ADDRESS] = (uint16_t)(state->settings.gauge_frozen_ms / 10u);
    image[MEMBRANE_INTERLOCKS_FITTED_ADDRESS] = (uint16_t)state->settings.interlocks_fitted;
}

static void report(const struct state *state, uint16_t *image)
{
    put(image, MEMBRANE_SAMPLE_COUNTER_ADDRESS, state->sample_counter);
    put(image, MEMBRANE_DEVICE_TIME_S_ADDRESS, state->sample_s);
    image[MEMBRANE_DEVICE_TIME_FRACTION_S_ADDRESS] = (uint16_t)(state->sample_us / 100u);
    image[MEMBRANE_DISPLACEMENT_QUALITY_ADDRESS] = (uint16_t)((uint32_t)state->sensors[HAL_DISPLACEMENT_QUALITY]);
    put(image, MEMBRANE_DISPLACEMENT_UM_ADDRESS, (uint32_t)state->sensors[HAL_DISPLACEMENT]);
    put(image, MEMBRANE_GAUGE_PRESSURE_PA_ADDRESS, (uint32_t)state->sensors[HAL_GAUGE_PRESSURE]);
    put(image, MEMBRANE_AMBIENT_PRESSURE_PA_ADDRESS, (uint32_t)state->sensors[HAL_AMBIENT_PRESSURE]);
    put(image, MEMBRANE_AIR_TEMPERATURE_C_ADDRESS, (uint32_t)state->sensors[HAL_AIR_TEMPERATURE]);
    put(image, MEMBRANE_GAS_TEMPERATURE_C_ADDRESS, (uint32_t)state->sensors[HAL_GAS_TEMPERATURE]);
    image[MEMBRANE_PUMP_READBACK_FRACTION_ADDRESS] = (uint16_t)pump_driven(state);
    image[MEMBRANE_VENT_READBACK_FRACTION_ADDRESS] = (uint16_t)vent_driven(state);
    image[MEMBRANE_HEARTBEAT_ECHO_ADDRESS] = (uint16_t)state->heartbeat_fed;
    image[MEMBRANE_WATCHDOG_ARMED_ADDRESS] = (uint16_t)state->armed;
    image[MEMBRANE_WATCHDOG_TRIPPED_ADDRESS] = ((state->faults & MEMBRANE_FAULT_WATCHDOG) != 0u) ? 1u : 0u;
    image[MEMBRANE_LATCHED_FAULTS_ADDRESS] = (uint16_t)state->faults;
    image[MEMBRANE_PERIOD_IN_FORCE_S_ADDRESS] = (uint16_t)state->period_ms;
    put(image, MEMBRANE_CLAIM_IN_FORCE_ADDRESS, state->claim_id);
    image[MEMBRANE_INTERLOCK_INPUTS_ADDRESS] = (uint16_t)state->interlocks;
}

/* What was written and can be read; keys, clear_faults and stop read as 0. */
static void echo(const struct state *state, uint16_t *image)
{
    image[MEMBRANE_WATCHDOG_PERIOD_S_ADDRESS] = (uint16_t)state->period_ms;
    image[MEMBRANE_WATCHDOG_ARM_ADDRESS] = (uint16_t)state->armed;
    put(image, MEMBRANE_CLAIM_ID_ADDRESS, state->claim_id);
    image[MEMBRANE_PUMP_COMMAND_FRACTION_ADDRESS] = (uint16_t)state->pump;
    image[MEMBRANE_VENT_COMMAND_FRACTION_ADDRESS] = (uint16_t)state->vent;
    image[MEMBRANE_HEARTBEAT_ADDRESS] = (uint16_t)state->heartbeat;
}

static bool exists(uint32_t address)
{
    bool found = false;
    for (size_t i = 0u; i < REGISTER_BLOCKS_COUNT; i++) {
        const struct register_block *block = &REGISTER_BLOCKS[i];
        found = found || ((address >= block->address) && (address < (block->address + block->words)));
    }
    return found;
}

enum board_answer board_read(uint32_t address, uint32_t count, uint16_t *words)
{
    for (uint32_t i = 0u; i < count; i++) {
        if (!exists(address + i)) {
            return BOARD_ADDRESS;
        }
    }
    const uint32_t before = hal_lock();
    const bool right = sound();
    const struct state copy = now.state;
    hal_unlock(before);
    if (!right) {
        return BOARD_FAILED; /* the next tick resets the board */
    }
    uint16_t image[BOARD_WORDS] = {0u};
    identify(&copy, image);
    report(&copy, image);
    echo(&copy, image);
    (void)memcpy(words, &image[address], count * sizeof(words[0]));
    return BOARD_DONE;
}

/* The value of a register in the words of its block. */
static uint32_t value_at(const uint16_t *words, uint32_t block, uint32_t address, uint32_t length)
{
    const uint32_t at = address - block;
    return (length == 1u) ? words[at] : (((uint32_t)words[at] << 16) | (uint32_t)words[at + 1u]);
}

static enum board_answer check_write(uint32_t address, uint32_t count, const uint16_t *words)
{
    bool writable = false;
    for (size_t i = 0u; i < REGISTER_BLOCKS_COUNT; i++) {
        const struct register_block *block = &REGISTER_BLOCKS[i];
        writable = writable || (block->writable && (block->address == address) && (block->words == count));
    }
    if (!writable) {
        return BOARD_ADDRESS;
    }
    for (size_t i = 0u; i < REGISTER_LIMITS_COUNT; i++) {
        const struct register_limits *limits = &REGISTER_LIMITS[i];
        if ((limits->address >= address) && (limits->address < (address + count))) {
            const uint32_t value = value_at(words, address, limits->address, limits->words);
            if ((value < limits->low) || (value > limits->high)) {
                return BOARD_VALUE;
            }
        }
    }
    return BOARD_DONE;
}

/* Whether this key may write; a program without the claim learns whether somebody has it. */
static enum board_answer check_key(const struct state *state, uint32_t key, bool claims)
{
    enum board_answer answer = BOARD_DONE;
    if (key != state->claim_key) {
        const bool held = (state->claim_key != 0u) && fed_in_time(state);
        answer = held ? BOARD_BUSY : (claims ? BOARD_DONE : BOARD_VALUE);
    }
    return answer;
}

static void feed(struct state *state)
{
    state->unfed_us = -(int32_t)(hal_micros() - state->tick_us); /* the next tick counts from the last one */
}

static enum board_answer write_settings(struct state *state, const uint16_t *words)
{
    const uint32_t block = MEMBRANE_BLOCK_SETTINGS_ADDRESS;
    const bool arms = value_at(words, block, MEMBRANE_WATCHDOG_ARM_ADDRESS, 1u) != 0u;
    const uint32_t key = value_at(words, block, MEMBRANE_CLAIM_KEY_ADDRESS, 2u);
    const enum board_answer answer = check_key(state, key, arms);
    if (answer != BOARD_DONE) {
        return answer;
    }
    if ((!arms) && (state->armed != 0u) && (state->pump > 0u)) {
        return BOARD_VALUE;
    }
    if (arms && ((state->armed == 0u) || (key != state->claim_key))) {
        feed(state);
    }
    state->period_ms = value_at(words, block, MEMBRANE_WATCHDOG_PERIOD_S_ADDRESS, 1u);
    state->armed = arms ? 1u : 0u;
    state->claim_id = arms ? value_at(words, block, MEMBRANE_CLAIM_ID_ADDRESS, 2u) : 0u;
    state->claim_key = arms ? key : 0u;
    return BOARD_DONE;
}

static enum board_answer write_command(struct state *state, const uint16_t *words)
{
    const uint32_t block = MEMBRANE_BLOCK_COMMAND_ADDRESS;
    const enum board_answer answer =
        check_key(state, value_at(words, block, MEMBRANE_COMMAND_KEY_ADDRESS, 2u), false);
    if (answer == BOARD_DONE) {
        state->pump = value_at(words, block, MEMBRANE_PUMP_COMMAND_FRACTION_ADDRESS, 1u);
        state->vent = value_at(words, block, MEMBRANE_VENT_COMMAND_FRACTION_ADDRESS, 1u);
        state->heartbeat = value_at(words, block, MEMBRANE_HEARTBEAT_ADDRESS, 1u);
        if (state->heartbeat != state->heartbeat_fed) {
            state->heartbeat_fed = state->heartbeat;
            feed(state);
        }
    }
    return answer;
}

static enum board_answer write_reset(struct state *state, const uint16_t *words)
{
    const uint32_t block = MEMBRANE_BLOCK_RESET_ADDRESS;
    const enum board_answer answer = check_key(state, value_at(words, block, MEMBRANE_CLEAR_KEY_ADDRESS, 2u), false);
    const uint32_t cleared = state->faults & value_at(words, block, MEMBRANE_CLEAR_FAULTS_ADDRESS, 1u);
    if ((answer == BOARD_DONE) && (cleared != 0u)) {
        state->faults &= ~cleared;
        state->pump = 0u;
        if ((cleared & MEMBRANE_FAULT_WATCHDOG) != 0u) {
            feed(state);
        }
        if ((cleared & MEMBRANE_FAULT_GAUGE_LOST) != 0u) {
            state->gauge_same_us = 0u; /* a gauge at rest shows that it works only once the pump runs */
        }
    }
    return answer;
}

static enum board_answer write_block(struct state *state, uint32_t address, const uint16_t *words)
{
    enum board_answer answer = BOARD_DONE;
    switch (address) {
    case MEMBRANE_BLOCK_SETTINGS_ADDRESS:
        answer = write_settings(state, words);
        break;
    case MEMBRANE_BLOCK_COMMAND_ADDRESS:
        answer = write_command(state, words);
        break;
    case MEMBRANE_BLOCK_RESET_ADDRESS:
        answer = write_reset(state, words);
        break;
    default: /* `stop`: needs no claim */
        latch(state, MEMBRANE_FAULT_STOPPED);
        break;
    }
    protect(state);
    return answer;
}

enum board_answer board_write(uint32_t address, uint32_t count, const uint16_t *words)
{
    enum board_answer answer = check_write(address, count, words);
    if (answer == BOARD_DONE) {
        const uint32_t before = hal_lock();
        if (sound()) {
            answer = write_block(&now.state, address, words);
            seal();
        } else {
            answer = BOARD_FAILED; /* sealing would hide the damage from the next tick */
        }
        hal_unlock(before);
    }
    return answer;
}
