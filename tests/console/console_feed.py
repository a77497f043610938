"""Telemetry, events and shapes of a made-up run."""

from __future__ import annotations

import json
import math
import random
from dataclasses import replace
from typing import Any

import numpy as np

from membrane_ctrl.model.shape_estimate import ShapeEstimate, Verdict
from membrane_ctrl.model.telemetry import FIELDS, SafeLevel, ShapeState, State, TelemetryRow
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS

RATE_HZ = 50.0
NOTHING = TelemetryRow(**dict.fromkeys(FIELDS, math.nan))
HOLDING = replace(
    NOTHING,
    mono_s=0.0,
    tick=0.0,
    dt_s=0.02,
    lateness_ms=1.3,
    missed_ticks=0.0,
    state=State.HOLD,
    shape_state=ShapeState.TRACKING,
    safe_level=SafeLevel.NONE,
    fault=0.0,
    target_um=0.0,
    setpoint_um=0.12,
    displacement_um=0.1,
    filtered_um=0.1,
    error_um=0.02,
    p_um_per_s=0.01,
    i_um_per_s=1.24,
    d_um_per_s=0.0,
    feedforward_um_per_s=-0.11,
    flow_wanted_um_per_s=1.14,
    flow_um_per_s=1.14,
    pump_fraction=0.29,
    vent_fraction=0.0,
    gauge_pressure_pa=600.04,
    ambient_pressure_pa=101325.0,
    air_temperature_c=20.013,
    displacement_quality=0.0,
    leak_um_per_s=1.24,
    trim_um=0.12,
    truth_displacement_um=0.03,
    truth_laser_bias_um=0.1,
)


def rows(seconds_s: float, start_s: float = 0.0, seed: int = 1) -> list[TelemetryRow]:
    """A held mirror with 0.3 µm of error, correlated over a second."""
    noise = random.Random(seed)
    error_um, made = 0.0, []
    for k in range(round(seconds_s * RATE_HZ)):
        error_um += -0.02 * error_um + noise.gauss(0.0, 0.06)
        made.append(
            replace(
                HOLDING,
                mono_s=start_s + k / RATE_HZ,
                tick=float(k + 1),
                error_um=error_um,
                displacement_um=0.12 - error_um,
                filtered_um=0.12 - error_um,
                lateness_ms=1.0 + abs(noise.gauss(0.0, 0.5)),
            )
        )
    return made


def shape(
    time_s: float = 0.0,
    sag_um: float = 37100.0,
    verdict: Verdict = "ok",
    reason: str = "",
    cycle: int = 1,
) -> ShapeEstimate:
    return ShapeEstimate(
        time_s=time_s,
        kind="full" if cycle == 1 else "fringes",
        coeffs_um=np.zeros(ZERNIKE_TERMS),
        hencky_um=0.0,
        covariance_um2=np.eye(ZERNIKE_TERMS),
        sag_um=sag_um,
        sag_change_sigma_um=0.012,
        displacement_um=0.0,
        slope_residual_urad=3.1,
        valid_fraction=0.99,
        modulation_median_adu=81.0,
        saturated_fraction=0.0,
        verdict=verdict,
        reason=reason,
        latency_s=0.031,
        cycle=cycle,
    )


def event(mono_s: float, kind: str, **more: Any) -> dict[str, Any]:
    return {"time_utc": "2026-11-21T03:12:00+00:00", "mono_s": mono_s, "kind": kind, **more}


def packed(given: dict[str, Any]) -> bytes:
    return json.dumps(given).encode()


FAULT = {
    "code": 30,
    "name": "link_lost",
    "cause": "the link to the pump board is down",
    "seen": "link down",
    "limit": "must be up",
    "safe_level": "pump_off",
    "latching": True,
    "remedy": "check cable, power and address; a board's watchdog stops its pump",
}
