"""The campaign's configuration and its demands on the code: limits, and how long each safe level
may last.
"""

from __future__ import annotations

from membrane_ctrl.model.telemetry import SafeLevel

RATE_HZ = 25.0
TICK_S = 1 / RATE_HZ
WATCHDOG_S = 0.5
HOLD_FLOW_S, RAMP_S, PUMP_OFF_S = 8.0, 6.0, 10.0
STALE_S = 0.3
GAUGE_STUCK_S = 5.0
BOARD_PRESSURE_MAX_PA = 800.0
RESUME_WAIT_S = 3.0
RESUMES_A_DAY = 2
# after a lasting fault enters on a safe level, the pump must stop and the vent open within these
# times
OFF_AFTER_S = {
    SafeLevel.HOLD_FLOW: HOLD_FLOW_S + RAMP_S,
    SafeLevel.RAMP_DOWN: RAMP_S,
    SafeLevel.PUMP_OFF: 0.0,
    SafeLevel.VENT: 0.0,
}
VENTS_AFTER_S = {
    SafeLevel.HOLD_FLOW: HOLD_FLOW_S + RAMP_S + PUMP_OFF_S,
    SafeLevel.RAMP_DOWN: RAMP_S + PUMP_OFF_S,
    SafeLevel.PUMP_OFF: PUMP_OFF_S,
    SafeLevel.VENT: 0.0,
}
# limits near the setpoint, so that a run of a minute can reach them: 40 µm are 2 Pa, the gauge's
# noise is 0.5 Pa
DISPLACEMENT_MIN_UM, DISPLACEMENT_MAX_UM = -80.0, 40.0
FOLLOWING_ERROR_MAX_UM = 25.0
GAUGE_MARGIN_PA = 5.0  # over the pressure at which the mirror is held
