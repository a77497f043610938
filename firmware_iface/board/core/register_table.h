/* Blocks of registers and limits of writes. Generated from firmware_iface/registers.toml with python -m firmware_iface.generate; do not edit. */
#ifndef MEMBRANE_REGISTER_TABLE_H
#define MEMBRANE_REGISTER_TABLE_H

#include <stdbool.h>
#include <stdint.h>

struct register_block {
    uint32_t address;
    uint32_t words;
    bool writable;
};

struct register_limits {
    uint32_t address;
    uint32_t words;
    uint32_t low;
    uint32_t high;
};

#define REGISTER_BLOCKS_COUNT 6u
#define REGISTER_LIMITS_COUNT 11u

static const struct register_block REGISTER_BLOCKS[REGISTER_BLOCKS_COUNT] = {
    {0u, 11u, false}, /* identity */
    {16u, 26u, false}, /* sensors */
    {48u, 6u, true}, /* settings */
    {56u, 5u, true}, /* command */
    {64u, 3u, true}, /* reset */
    {72u, 1u, true}, /* stop */
};

static const struct register_limits REGISTER_LIMITS[REGISTER_LIMITS_COUNT] = {
    {48u, 1u, 50u, 10000u}, /* watchdog_period_s */
    {49u, 1u, 0u, 1u}, /* watchdog_arm */
    {50u, 2u, 1u, 4294967295u}, /* claim_id */
    {52u, 2u, 1u, 4294967295u}, /* claim_key */
    {56u, 1u, 0u, 50000u}, /* pump_command_fraction */
    {57u, 1u, 0u, 50000u}, /* vent_command_fraction */
    {58u, 1u, 0u, 65535u}, /* heartbeat */
    {59u, 2u, 1u, 4294967295u}, /* command_key */
    {64u, 1u, 0u, 65535u}, /* clear_faults */
    {65u, 2u, 1u, 4294967295u}, /* clear_key */
    {72u, 1u, 1u, 1u}, /* stop */
};

#endif
