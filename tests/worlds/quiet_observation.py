"""What a tick shows while the mirror is held and nothing is wrong."""

from membrane_ctrl.controller.observation import Observation

GOOD = Observation(
    link_up=True,
    reading_age_s=0.0,
    advance_age_s=0.0,
    displacement_um=0.0,
    displacement_valid=True,
    jumps=0,
    error_um=0.0,
    gauge_pressure_pa=600.0,
    pump_mismatch=0.0,
    watchdog_tripped=False,
    board_faults=0,
    lateness_ms=1.0,
)
