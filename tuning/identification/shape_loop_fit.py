"""The shape loop: the figure's response to sag, noise and drift of its measurement, and the time
constant.

A small step of the setpoint moves the sag by a known amount: the change of the Zernike vector over
it is the sensitivity. Sag by deflectometry less the laser's reading is, while the mirror is held,
the deflectometry's noise and the drift between the two: white noise of sigma a cycle of length T,
and a random walk of q µm/sqrt(s). The best time constant between them is
(docs/explanation/physics.md, shape loop)

    tau = sigma sqrt(T) / q.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.control.sag_change import compute_sag_change
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.sessions.live_hold import HoldError
from tuning.identification.local_level import fit_local_level
from tuning.identification.record import Series
from tuning.rigs.hold_rig import HoldRig

STEP_UM = 5.0
# of each level; the ramp, the loop's recovery, and a cycle started earlier
_LEVEL_S = 60.0
_SETTLE_S = 12.0
TYPICAL_S = 3 * (_LEVEL_S + _SETTLE_S)
_LATE_S = 15.0  # that a level may take longer on a busy machine
LEAST_CYCLES = 8
# Below ten cycles it would follow the noise; beyond an hour the drift is unknown.
_CYCLES_MIN = 10.0
_TAU_MAX_S = 3600.0
_APART_MAX = 0.2  # of the figure's response: beyond it the camera sees something else than the sag


@dataclass(frozen=True, slots=True)
class ShapeLoopFit:
    """Result of the fit."""

    sensitivity: Series  # (terms,): change of the coefficients per µm of sag, and standard errors
    sensitivity_sigma: Series  # (terms,)
    agreement: (
        float  # cosine between it and the one assumed, piston left out; 1 is the same direction
    )
    scale: float  # sag by deflectometry per µm of laser reading
    sigma_um: float  # noise of a cycle
    cycle_s: float  # between results
    drift_um_per_sqrt_h: float  # between laser and deflectometry
    drift_seen: bool  # otherwise no drift was seen, and the figure is its upper bound
    time_constant_s: float  # proposed for `shape.time_constant_s`


def run_step_experiment(rig: HoldRig) -> list[list[ShapeEstimate]]:
    """Hold low, high, low with the shape loop off; return the shapes of each level.

    Each level is a trial, after which the hold itself restores setpoint and shape loop.
    """
    levels: list[list[ShapeEstimate]] = []
    why = "shape loop: sag sensitivity"
    try:
        for step_um in (0.0, STEP_UM, 0.0):
            rig.set_gains(rig.loop, why, _SETTLE_S + _LEVEL_S + _LATE_S, setpoint_step_um=step_um)
            rig.hold(_SETTLE_S)
            before = len(rig.shapes)
            rig.hold(_LEVEL_S)
            levels.append([shape for shape in rig.shapes[before:] if shape.verdict != "rejected"])
    finally:
        rig.set_gains(rig.loop, f"{why}: back")
    if min(len(level) for level in levels) < LEAST_CYCLES:
        raise HoldError(
            f"fewer than {LEAST_CYCLES} shapes per level: is the shape measured every few seconds?"
        )
    return levels


def fit_shape_loop(
    levels: Sequence[Sequence[ShapeEstimate]], steady: Sequence[ShapeEstimate], assumed: Series
) -> ShapeLoopFit:
    """Sensitivity from the levels (low, high, low), noise and drift from these and the shapes of a
    steady hold.

    `assumed` (terms,) is the controller's sensitivity. Raises ValueError if there are too few
    shapes.
    """
    means = [np.mean([shape.coeffs_um for shape in level], axis=0) for level in levels]
    laser_um = [float(np.mean([shape.displacement_um for shape in level])) for level in levels]
    step_um = laser_um[1] - (laser_um[0] + laser_um[2]) / 2
    sensitivity = (means[1] - (means[0] + means[2]) / 2) / step_um
    scatter = np.mean(
        [np.var([s.coeffs_um for s in level], axis=0, ddof=1) / len(level) for level in levels],
        axis=0,
    )
    shapes = sorted(
        (*steady, *(s for level in levels for s in level)), key=lambda shape: shape.time_s
    )
    times_s, gaps_um = compute_gaps_um(shapes, assumed)
    cycle_s = float(np.median(np.diff(times_s)))
    noise = fit_local_level(gaps_um, times_s)
    best_s = noise.white * math.sqrt(cycle_s / noise.walk)
    kept, wanted = sensitivity[1:], assumed[1:]
    return ShapeLoopFit(
        sensitivity=sensitivity,
        sensitivity_sigma=np.sqrt(1.5 * scatter) / abs(step_um),
        agreement=float(kept @ wanted / (np.linalg.norm(kept) * np.linalg.norm(wanted))),
        scale=float(kept @ wanted / (wanted @ wanted)),
        sigma_um=noise.white,
        cycle_s=cycle_s,
        drift_um_per_sqrt_h=math.sqrt(3600 * noise.walk),
        drift_seen=noise.seen,
        time_constant_s=min(max(best_s, _CYCLES_MIN * cycle_s), _TAU_MAX_S),
    )


def compute_gaps_um(shapes: Sequence[ShapeEstimate], assumed: Series) -> tuple[Series, Series]:
    """Times, and change of sag less laser reading: the drift between the two and the noise of a
    cycle.
    """
    first = shapes[0]
    seen = (
        compute_sag_change(s.coeffs_um, first.coeffs_um, s.covariance_um2, assumed).change_um
        for s in shapes
    )
    gaps_um = np.array(
        [sag_um - shape.displacement_um for sag_um, shape in zip(seen, shapes, strict=True)]
    )
    return np.array([shape.time_s for shape in shapes]), gaps_um


def find_unfit_reason(found: ShapeLoopFit) -> str:
    """Why a time constant must not be tried; empty if it may be."""
    if found.agreement < 1 - _APART_MAX or abs(found.scale - 1) > _APART_MAX:
        return (
            f"the figure answers the setpoint by {found.scale:.2f} of what is assumed (direction "
            f"{found.agreement:.2f}): calibrate the camera first"
        )
    return ""
