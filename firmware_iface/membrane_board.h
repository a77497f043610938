/* Registers of the membrane pump board. Generated from firmware_iface/registers.toml with python -m firmware_iface.generate; do not edit.
 * Modbus holding registers, addresses from 0, big word first. value = raw / COUNTS_PER_UNIT. */
#ifndef MEMBRANE_BOARD_H
#define MEMBRANE_BOARD_H

#define MEMBRANE_MAP_VERSION 3u
#define MEMBRANE_DEVICE_KIND 0x4D42u
#define MEMBRANE_I32_NO_VALUE (-2147483647 - 1) /* there is no value */

/* identity (ro): Identity, and the limits that the board itself enforces. */
#define MEMBRANE_BLOCK_IDENTITY_ADDRESS 0u
#define MEMBRANE_BLOCK_IDENTITY_WORDS 11u
#define MEMBRANE_DEVICE_KIND_ADDRESS 0u /* u16: 19778 (0x4D42): a membrane pump board */
#define MEMBRANE_MAP_VERSION_ADDRESS 1u /* u16: version of this map; a controller refuses one it does not know */
#define MEMBRANE_FIRMWARE_VERSION_ADDRESS 2u /* u32: major * 65536 + minor * 256 + patch */
#define MEMBRANE_GAUGE_PRESSURE_LIMIT_PA_ADDRESS 4u /* f32: above it the board itself stops the pump and opens the vent */
#define MEMBRANE_PUMP_LIMIT_FRACTION_ADDRESS 6u /* u16: highest drive that the board gives to the pump, whatever the command */
#define MEMBRANE_PUMP_LIMIT_FRACTION_COUNTS_PER_UNIT 50000
#define MEMBRANE_GAUGE_FITTED_ADDRESS 7u /* u16: 1: the board requires its gauge; 0: no gauge is fitted, and the board has no over-pressure protection */
#define MEMBRANE_GAUGE_TIMEOUT_S_ADDRESS 8u /* u16: longest time that the pump runs without a value of the fitted gauge */
#define MEMBRANE_GAUGE_TIMEOUT_S_COUNTS_PER_UNIT 1000
#define MEMBRANE_GAUGE_FROZEN_S_ADDRESS 9u /* u16: longest time of pumping during which the fitted gauge may repeat one value; 0: not judged */
#define MEMBRANE_GAUGE_FROZEN_S_COUNTS_PER_UNIT 100
#define MEMBRANE_INTERLOCKS_FITTED_ADDRESS 10u /* u16: bit i: interlock input i is fitted, and the board stops the pump when its circuit opens */

/* sensors (ro): One consistent sample and the state of the board: read it whole, once a tick. */
#define MEMBRANE_BLOCK_SENSORS_ADDRESS 16u
#define MEMBRANE_BLOCK_SENSORS_WORDS 26u
#define MEMBRANE_SAMPLE_COUNTER_ADDRESS 16u /* u32: counts samples, wraps; a constant value means a frozen board */
#define MEMBRANE_DEVICE_TIME_S_ADDRESS 18u /* u32: whole seconds since power-up at the sample */
#define MEMBRANE_DEVICE_TIME_FRACTION_S_ADDRESS 20u /* u16: fraction of a second to add to device_time_s */
#define MEMBRANE_DEVICE_TIME_FRACTION_S_COUNTS_PER_UNIT 10000
#define MEMBRANE_DISPLACEMENT_QUALITY_ADDRESS 21u /* u16: 0 good, else the laser's error code */
#define MEMBRANE_DISPLACEMENT_UM_ADDRESS 22u /* i32: laser reading, positive when the bowl deepens; its zero is arbitrary */
#define MEMBRANE_DISPLACEMENT_UM_COUNTS_PER_UNIT 1000
#define MEMBRANE_GAUGE_PRESSURE_PA_ADDRESS 24u /* i32: gas between the films, relative to the room */
#define MEMBRANE_GAUGE_PRESSURE_PA_COUNTS_PER_UNIT 1000
#define MEMBRANE_AMBIENT_PRESSURE_PA_ADDRESS 26u /* i32: barometer */
#define MEMBRANE_AMBIENT_PRESSURE_PA_COUNTS_PER_UNIT 1000
#define MEMBRANE_AIR_TEMPERATURE_C_ADDRESS 28u /* i32: air beside the mirror */
#define MEMBRANE_AIR_TEMPERATURE_C_COUNTS_PER_UNIT 10000
#define MEMBRANE_GAS_TEMPERATURE_C_ADDRESS 30u /* i32: gas between the films */
#define MEMBRANE_GAS_TEMPERATURE_C_COUNTS_PER_UNIT 10000
#define MEMBRANE_PUMP_READBACK_FRACTION_ADDRESS 32u /* u16: present drive of the pump */
#define MEMBRANE_PUMP_READBACK_FRACTION_COUNTS_PER_UNIT 50000
#define MEMBRANE_VENT_READBACK_FRACTION_ADDRESS 33u /* u16: present opening of the vent */
#define MEMBRANE_VENT_READBACK_FRACTION_COUNTS_PER_UNIT 50000
#define MEMBRANE_HEARTBEAT_ECHO_ADDRESS 34u /* u16: the last heartbeat that fed the watchdog */
#define MEMBRANE_WATCHDOG_ARMED_ADDRESS 35u /* u16: 1 armed; 0 after power-up */
#define MEMBRANE_WATCHDOG_TRIPPED_ADDRESS 36u /* u16: 1 from a trip until the fault is cleared */
#define MEMBRANE_LATCHED_FAULTS_ADDRESS 37u /* u16: fault bits; the pump stays off while one is set */
#define MEMBRANE_PERIOD_IN_FORCE_S_ADDRESS 38u /* u16: watchdog period now */
#define MEMBRANE_PERIOD_IN_FORCE_S_COUNTS_PER_UNIT 1000
#define MEMBRANE_CLAIM_IN_FORCE_ADDRESS 39u /* u32: claim_id of the present or last holder of the board; 0: none */
#define MEMBRANE_INTERLOCK_INPUTS_ADDRESS 41u /* u16: bit i: the circuit of interlock input i is closed at the sample; a cut wire is open */

/* settings (rw): Lost at power-down. From map version 2 on, arming claims the board; written whole or not at all. */
#define MEMBRANE_BLOCK_SETTINGS_ADDRESS 48u
#define MEMBRANE_BLOCK_SETTINGS_WORDS 6u
#define MEMBRANE_WATCHDOG_PERIOD_S_ADDRESS 48u /* u16: longest time between two feeding writes */
#define MEMBRANE_WATCHDOG_PERIOD_S_COUNTS_PER_UNIT 1000
#define MEMBRANE_WATCHDOG_PERIOD_S_MIN_RAW 50
#define MEMBRANE_WATCHDOG_PERIOD_S_MAX_RAW 10000
#define MEMBRANE_WATCHDOG_ARM_ADDRESS 49u /* u16: 1 arms (arming again does not feed); 0 disarms, refused while the pump command is above 0 */
#define MEMBRANE_WATCHDOG_ARM_MIN_RAW 0
#define MEMBRANE_WATCHDOG_ARM_MAX_RAW 1
#define MEMBRANE_CLAIM_ID_ADDRESS 50u /* u32: random public name of the claim */
#define MEMBRANE_CLAIM_ID_MIN_RAW 1
#define MEMBRANE_CLAIM_ID_MAX_RAW 4294967295
#define MEMBRANE_CLAIM_KEY_ADDRESS 52u /* u32: random secret of the claim; reads as 0 */
#define MEMBRANE_CLAIM_KEY_MIN_RAW 1
#define MEMBRANE_CLAIM_KEY_MAX_RAW 4294967295

/* command (rw): Written whole at the end of every completed tick, which is what feeds the watchdog. A write of a part of it is refused (map version 1: it commands, but does not feed). */
#define MEMBRANE_BLOCK_COMMAND_ADDRESS 56u
#define MEMBRANE_BLOCK_COMMAND_WORDS 5u
#define MEMBRANE_PUMP_COMMAND_FRACTION_ADDRESS 56u /* u16: pump drive; set to 0 by the board at a fault and when faults are cleared */
#define MEMBRANE_PUMP_COMMAND_FRACTION_COUNTS_PER_UNIT 50000
#define MEMBRANE_PUMP_COMMAND_FRACTION_MIN_RAW 0
#define MEMBRANE_PUMP_COMMAND_FRACTION_MAX_RAW 50000
#define MEMBRANE_VENT_COMMAND_FRACTION_ADDRESS 57u /* u16: vent opening */
#define MEMBRANE_VENT_COMMAND_FRACTION_COUNTS_PER_UNIT 50000
#define MEMBRANE_VENT_COMMAND_FRACTION_MIN_RAW 0
#define MEMBRANE_VENT_COMMAND_FRACTION_MAX_RAW 50000
#define MEMBRANE_HEARTBEAT_ADDRESS 58u /* u16: a value other than the last one feeds the watchdog */
#define MEMBRANE_HEARTBEAT_MIN_RAW 0
#define MEMBRANE_HEARTBEAT_MAX_RAW 65535
#define MEMBRANE_COMMAND_KEY_ADDRESS 59u /* u32: claim_key of the active claim; reads as 0 */
#define MEMBRANE_COMMAND_KEY_MIN_RAW 1
#define MEMBRANE_COMMAND_KEY_MAX_RAW 4294967295

/* reset (rw): A person decides to clear; no driver does it by itself. */
#define MEMBRANE_BLOCK_RESET_ADDRESS 64u
#define MEMBRANE_BLOCK_RESET_WORDS 3u
#define MEMBRANE_CLEAR_FAULTS_ADDRESS 64u /* u16: fault bits to clear; also sets the pump command to 0; reads as 0 */
#define MEMBRANE_CLEAR_FAULTS_MIN_RAW 0
#define MEMBRANE_CLEAR_FAULTS_MAX_RAW 65535
#define MEMBRANE_CLEAR_KEY_ADDRESS 65u /* u32: claim_key of the active claim; reads as 0 */
#define MEMBRANE_CLEAR_KEY_MIN_RAW 1
#define MEMBRANE_CLEAR_KEY_MAX_RAW 4294967295

/* stop (rw): Any program may stop the pump without a claim. */
#define MEMBRANE_BLOCK_STOP_ADDRESS 72u
#define MEMBRANE_BLOCK_STOP_WORDS 1u
#define MEMBRANE_STOP_ADDRESS 72u /* u16: 1 latches the fault `stopped`; reads as 0 */
#define MEMBRANE_STOP_MIN_RAW 1
#define MEMBRANE_STOP_MAX_RAW 1

/* bits of latched_faults and clear_faults */
#define MEMBRANE_FAULT_WATCHDOG 0x0001u /* no write of the whole command block with a new heartbeat within the period: pump off, vent as it was */
#define MEMBRANE_FAULT_OVER_PRESSURE 0x0002u /* gauge pressure above gauge_pressure_limit_pa: pump off, vent open */
#define MEMBRANE_FAULT_STOPPED 0x0004u /* a program wrote `stop`: pump off, vent as it was */
#define MEMBRANE_FAULT_GAUGE_LOST 0x0008u /* a pump command above 0 while the fitted gauge has had no value for gauge_timeout_s, or has repeated its value for gauge_frozen_s of pumping: pump off, vent as it was */
#define MEMBRANE_FAULT_INTERLOCK 0x0010u /* the circuit of a fitted interlock input is open: pump off, vent as it was */

#endif
