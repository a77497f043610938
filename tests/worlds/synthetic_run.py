"""A made-up run for the recorder: telemetry with known statistics, events, shape estimates."""

from __future__ import annotations

from dataclasses import fields
from datetime import UTC, datetime

import numpy as np

from membrane_ctrl.model.shape_estimate import ShapeEstimate, Verdict
from membrane_ctrl.model.telemetry import SafeLevel, ShapeState, State, TelemetryRow, unpack_rows
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from tests.worlds.nights import messages_of

RATE_HZ = 50.0
STARTED_UTC = datetime(2026, 11, 21, 1, 23, 45, tzinfo=UTC)


def rows_of(seconds: float, seed: int = 0, truth: bool = True) -> list[TelemetryRow]:
    """Standby for 1 s, settle until 6 s, then hold at a target of 10 µm."""
    rng = np.random.default_rng(seed)
    return [_row(k, rng, truth) for k in range(round(seconds * RATE_HZ))]


def _row(k: int, rng: np.random.Generator, truth: bool) -> TelemetryRow:
    time_s = k / RATE_HZ
    state = State.STANDBY if time_s < 1 else State.SETTLE if time_s < 6 else State.HOLD
    moving = state is not State.STANDBY
    target_um = 10.0
    true_um = (
        target_um
        - 25.0 * np.exp(-max(0.0, time_s - 1.0))
        + 0.1 * np.sin(time_s / 3)
        + 0.05 * rng.normal()
    )
    reading_um = true_um + rng.normal()
    flow = 1.24 + 0.3 * np.sin(time_s / 5) if moving else 0.0
    values = dict.fromkeys((field.name for field in fields(TelemetryRow)), 0.0)
    values |= {
        "mono_s": time_s,
        "tick": float(k),
        "dt_s": 1 / RATE_HZ,
        "lateness_ms": 1.0 + rng.exponential(0.5),
        "state": float(state),
        "shape_state": float(ShapeState.TRACKING if state is State.HOLD else ShapeState.OFF),
        "safe_level": float(SafeLevel.NONE),
        "target_um": target_um,
        "setpoint_um": target_um + 0.02,
        "trim_um": 0.02,
        "displacement_um": reading_um,
        "filtered_um": true_um + 0.3 * rng.normal(),
        "error_um": target_um - reading_um,
        "p_um_per_s": 0.6 * (target_um - true_um),
        "i_um_per_s": 1.24,
        "feedforward_um_per_s": 0.2 * np.sin(time_s / 7),
        "flow_wanted_um_per_s": flow * 1.05,
        "flow_um_per_s": flow,
        "pump_fraction": 0.3 if moving else 0.0,
        "pump_readback_fraction": 0.3 if moving else 0.0,
        "gauge_pressure_pa": 600.0 + 0.1 * rng.normal(),
        "ambient_pressure_pa": 101325.0 + 3 * np.sin(time_s / 30),
        "air_temperature_c": 21.0 + 0.05 * np.sin(time_s / 90),
        "gas_temperature_c": float("nan"),
        "sample_counter": float(k),
        "device_time_s": time_s,
        "leak_um_per_s": 1.24 if time_s > 3 else float("nan"),
        "truth_displacement_um": true_um if truth else float("nan"),
        "truth_laser_bias_um": 0.01 * time_s if truth else float("nan"),
    }
    return TelemetryRow(**values)


def message_of(row: TelemetryRow) -> bytes:
    """A tick as it crosses to the recorder."""
    return messages_of(unpack_rows([row.pack()]))[0]


def shape_of(time_s: float, cycle: int, verdict: Verdict = "ok", seed: int = 0) -> ShapeEstimate:
    """A paraboloid 37 mm deep with an astigmatism that grows by 0.02 µm/s."""
    rng = np.random.default_rng(seed + cycle)
    coeffs_um = np.zeros(ZERNIKE_TERMS)
    # a paraboloid of 37 mm sag, 0 at the vertex: sag rho^2 = sag (Z4 / sqrt(3) + 1) / 2
    coeffs_um[[0, 3]] = 37_000 / 2, 37_000 / (2 * np.sqrt(3))
    coeffs_um[1:] += 0.02 * rng.normal(size=ZERNIKE_TERMS - 1)
    coeffs_um[5] += 0.02 * time_s
    return ShapeEstimate(
        time_s=time_s,
        kind="full" if cycle == 0 else "fringes",
        coeffs_um=coeffs_um,
        hencky_um=0.0,
        covariance_um2=np.diag(np.linspace(0.02, 0.005, ZERNIKE_TERMS) ** 2),
        sag_um=37_000.0 + 0.1 * rng.normal(),
        sag_change_sigma_um=0.1,
        displacement_um=10.0 + 0.1 * rng.normal(),
        slope_residual_urad=3.1 + 0.2 * rng.normal(),
        valid_fraction=0.99,
        modulation_median_adu=81.0,
        saturated_fraction=0.0,
        verdict=verdict,
        reason="",
        latency_s=0.05 + 0.01 * float(rng.random()),
        cycle=cycle,
    )
