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
_LEVEL_S = 60.0  # of each level
_SETTLE_S = 12.0  # before it: the ramp, the loop's recovery, and a cycle started earlier
TYPICAL_S = 3 * (_LEVEL_S + _SETTLE_S)
_LATE_S = 15.0  # that a level may take longer on a busy machine
LEAST_CYCLES = 8
# Below ten cycles it would follow the noise; beyond an hour the drift is unknown.
_CYCLES_MIN = 10.0
_TAU_MAX_S = 3600.0
_APART_MAX = 0.2  # of the figure's response: beyond it the camera sees something else than the sag
# Variance of (high - mean of the two low levels), over the mean variance of a level.
_VARIANCE_OF_STEP = 1.5


@dataclass(frozen=True, slots=True)
class ShapeLoopFit:
    """Result of the fit.

    Attributes
    ----------
    sensitivity, sensitivity_sigma : (terms,) arrays
        Change of the coefficients per µm of sag, and its standard errors.
    agreement : float
        Cosine between it and the assumed one, piston left out; 1 is the same direction.
    scale : float
        Sag by deflectometry per µm of laser reading.
    sigma_um : float
        Noise of a cycle.
    cycle_s : float
        Time between results.
    drift_um_per_sqrt_h : float
        Between laser and deflectometry.
    drift_seen : bool
        Whether a drift is significant; else the figure is its upper bound.
    time_constant_s : float
        Proposed for `shape.time_constant_s`.
    """

    sensitivity: Series
    sensitivity_sigma: Series
    agreement: float
    scale: float
    sigma_um: float
    cycle_s: float
    drift_um_per_sqrt_h: float
    drift_seen: bool
    time_constant_s: float


def run_step_experiment(rig: HoldRig) -> list[list[ShapeEstimate]]:
    """Hold low, high, low with the shape loop off; return the shapes of each level.

    Each level is a trial, after which the hold itself restores setpoint and shape loop.
    """
    # Low, high, low: a drift of the figure during the experiment cancels in the mean of the two low
    # levels, which lie evenly before and after the high one.
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
    """Fit the shape loop.

    Parameters
    ----------
    levels : three sequences of ShapeEstimate
        Low, high, low: for the sensitivity.
    steady : sequence of ShapeEstimate
        Of a steady hold: with the levels, for noise and drift.
    assumed : (terms,) array
        The controller's sensitivity.

    Returns
    -------
    ShapeLoopFit

    Raises
    ------
    ValueError
        There are too few shapes.
    """
    # The change from the mean of the two low levels to the high one: an even drift cancels.
    means = [np.mean([shape.coeffs_um for shape in level], axis=0) for level in levels]
    laser_um = [float(np.mean([shape.displacement_um for shape in level])) for level in levels]
    step_um = laser_um[1] - (laser_um[0] + laser_um[2]) / 2
    sensitivity = (means[1] - (means[0] + means[2]) / 2) / step_um

    # Its error, from the scatter within the levels.
    variances = []
    for level in levels:
        coeffs_um = [shape.coeffs_um for shape in level]
        variances.append(np.var(coeffs_um, axis=0, ddof=1) / len(level))
    scatter = np.mean(variances, axis=0)
    sensitivity_sigma = np.sqrt(_VARIANCE_OF_STEP * scatter) / abs(step_um)

    # Noise and drift of sag less laser; the best time constant is sigma sqrt(T) / q.
    of_levels = [shape for level in levels for shape in level]
    shapes = sorted((*steady, *of_levels), key=lambda shape: shape.time_s)
    times_s, gaps_um = compute_gaps_um(shapes, assumed)
    cycle_s = float(np.median(np.diff(times_s)))
    noise = fit_local_level(gaps_um, times_s)
    best_s = noise.white * math.sqrt(cycle_s / noise.walk)

    # Direction and size of the response, over the assumed one; without piston.
    found = sensitivity[1:]
    wanted = assumed[1:]
    lengths = np.linalg.norm(found) * np.linalg.norm(wanted)
    return ShapeLoopFit(
        sensitivity=sensitivity,
        sensitivity_sigma=sensitivity_sigma,
        agreement=float(found @ wanted / lengths),
        scale=float(found @ wanted / (wanted @ wanted)),
        sigma_um=noise.white,
        cycle_s=cycle_s,
        drift_um_per_sqrt_h=math.sqrt(3600 * noise.walk),
        drift_seen=noise.seen,
        time_constant_s=min(max(best_s, _CYCLES_MIN * cycle_s), _TAU_MAX_S),
    )


def compute_gaps_um(shapes: Sequence[ShapeEstimate], assumed: Series) -> tuple[Series, Series]:
    """Compute the differences between optics and laser.

    Parameters
    ----------
    shapes : n ShapeEstimate
        In the order of their times.
    assumed : (terms,) array
        Change of the coefficients per µm of sag.

    Returns
    -------
    times_s, gaps_um : (n,) arrays
        Change of sag since the first shape, less the laser's reading: the drift between the two,
        and the noise of a cycle.
    """
    first = shapes[0]
    gaps_um = []
    for shape in shapes:
        change = compute_sag_change(shape.coeffs_um, first.coeffs_um, shape.covariance_um2, assumed)
        gaps_um.append(change.change_um - shape.displacement_um)
    times_s = np.array([shape.time_s for shape in shapes])
    return times_s, np.array(gaps_um)


def find_unfit_reason(found: ShapeLoopFit) -> str:
    """Why a time constant must not be tried; empty if it may be."""
    if found.agreement < 1 - _APART_MAX or abs(found.scale - 1) > _APART_MAX:
        return (
            f"the figure answers the setpoint by {found.scale:.2f} of what is assumed (direction "
            f"{found.agreement:.2f}): calibrate the camera first"
        )
    return ""
