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

from membrane_ctrl.control.drift_tracker import DriftTracker
from membrane_ctrl.control.sag_change import sag_change
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.telemetry import ShapeState
from membrane_ctrl.sessions.live_hold import HoldError
from tuning.identification.loop_model import Series
from tuning.rig import HoldRig

# White noise on a random walk, at any times: the amount of each, and the largest walk that the data
# permit.
#
# The likelihood of the local level model by its Kalman filter, with the noise's variance
# concentrated out, over the ratio of walk to noise. Source: Durbin and Koopman, Time Series
# Analysis by State Space Methods
# (2012), chapter 2.

_RATIOS = np.geomspace(1e-9, 10.0, 61)  # variance of the walk per cycle over that of the noise
_DROP = 2.0  # of the log likelihood: 95 % one-sided, with some margin for the grid


@dataclass(frozen=True, slots=True)
class LocalLevel:
    """Result of the fit."""

    white: float  # standard deviation of the noise
    # variance of the walk per second; if no walk is seen, the largest that the data permit
    walk: float
    seen: bool  # the data are much less likely without a walk


def fit_local_level(values: FloatArray, times_s: FloatArray) -> LocalLevel:
    """Fit the model. Raises ValueError for fewer than 20 values."""
    if values.size < 20:
        raise ValueError(f"{values.size} values are too few to tell noise from drift: 20 at least")
    steps_s = np.diff(times_s)
    cycle_s = float(np.median(steps_s))
    fits = [_likelihood(values, steps_s / cycle_s, float(ratio)) for ratio in _RATIOS]
    likely = np.array([fit[0] for fit in fits])
    best = int(np.argmax(likely))
    seen = bool(likely[best] - likely[0] > _DROP)
    chosen = best if seen else int(np.flatnonzero(likely > likely[best] - _DROP)[-1])
    variance = fits[best][1]
    return LocalLevel(math.sqrt(variance), float(_RATIOS[chosen]) * variance / cycle_s, seen)


def _likelihood(values: FloatArray, steps: FloatArray, ratio: float) -> tuple[float, float]:
    """Log likelihood and noise variance for a ratio; the first value
    only initialises the filter.
    """
    level, spread = float(values[0]), 1.0
    squares = logs = 0.0
    for value, step in zip(values[1:].tolist(), steps.tolist(), strict=True):
        spread += ratio * step
        expected = spread + 1.0
        off = value - level
        squares += off * off / expected
        logs += math.log(expected)
        gain = spread / expected
        level += gain * off
        spread *= 1.0 - gain
    count = values.size - 1
    variance = squares / count
    return -0.5 * (count * math.log(variance) + logs), variance


STEP_UM = 5.0
_LEVEL_S, _SETTLE_S = (
    60.0,
    12.0,
)  # of each level; the ramp, the loop's recovery, and a cycle started earlier
TYPICAL_S = 3 * (_LEVEL_S + _SETTLE_S)
_LATE_S = 15.0  # that a level may take longer on a busy machine
_LEAST_CYCLES = 8
_SPARE_S = 120.0
_BACK_S = 1.0  # a trial that is over at once: the hold takes its own time constant back
# Below ten cycles it would follow the noise; beyond an hour the drift is unknown.
_CYCLES_MIN, _TAU_MAX_S = 10.0, 3600.0


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


def step_experiment(rig: HoldRig) -> list[list[ShapeEstimate]]:
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
    if min(len(level) for level in levels) < _LEAST_CYCLES:
        raise HoldError(
            f"fewer than {_LEAST_CYCLES} shapes per level: is the shape measured every few seconds?"
        )
    return levels


def evaluate(
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
    times_s, gaps_um = _gaps(shapes, assumed)
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


def _gaps(shapes: Sequence[ShapeEstimate], assumed: Series) -> tuple[Series, Series]:
    """Times, and change of sag less laser reading: the drift between the two and the noise of a
    cycle.
    """
    first = shapes[0]
    seen = (
        sag_change(s.coeffs_um, first.coeffs_um, s.covariance_um2, assumed).change_um
        for s in shapes
    )
    gaps_um = np.array(
        [sag_um - shape.displacement_um for sag_um, shape in zip(seen, shapes, strict=True)]
    )
    return np.array([shape.time_s for shape in shapes]), gaps_um


# The trial of a time constant. The drift does not depend on the trim, so that both trackers can be
# run on the very shapes of the trial: what differs is the tracker alone, and no weather has to be
# compared.

GROWTH_MAX = 1.1  # of the error with which the next shape is predicted
_TRACKING_LEAST = 0.9  # of the trial
_APART_MAX = 0.2  # of the figure's response: beyond it the camera sees something else than the sag


@dataclass(frozen=True, slots=True)
class OuterTrial:
    """`outer_verified.json`: the verification of a time constant of the shape loop."""

    before_s: float
    after_s: float
    error_before_um: float  # rms prediction error of each tracker on the shapes of the trial
    error_um: float
    tracking: float  # share of the trial in which the shape loop tracked
    reason: str  # why it is taken back; empty if it is kept


def trial(
    rig: HoldRig,
    times_s: tuple[float, float],
    earlier: Sequence[ShapeEstimate],
    assumed: Series,
    duration_s: float,
) -> OuterTrial:
    """Hold with the second time constant; keep it if it predicts the shapes as well as the first,
    the present one.

    `earlier` shapes let both trackers settle. If the session ends, or is killed, the hold takes it
    back by itself.
    """
    before_s, after_s = times_s
    why = "shape loop: time constant"
    rig.set_gains(rig.loop, why, duration_s + _SPARE_S, after_s)
    begun = len(rig.shapes)
    try:
        rows = rig.ticks(duration_s)
    except BaseException:  # Ctrl-C above all
        rig.set_gains(rig.loop, f"{why}: interrupted", _BACK_S)
        raise
    during = [shape for shape in rig.shapes[begun:] if shape.verdict != "rejected"]
    tracking = float(np.mean([row.shape_state == ShapeState.TRACKING for row in rows]))
    gaps = _gaps([*earlier, *during], assumed)
    error_before_um, error_um = (
        _predicted(*gaps, memory_s, len(during)) for memory_s in (before_s, after_s)
    )
    reason = ""
    if len(during) < _LEAST_CYCLES or tracking < _TRACKING_LEAST:
        reason = (
            f"the shape loop tracked only {tracking:.0%} of the trial, with {len(during)} shapes"
        )
    elif error_um > GROWTH_MAX * error_before_um:
        reason = (
            f"the next shape is predicted to {error_um:.2f} µm, by the former one to "
            f"{error_before_um:.2f} µm"
        )
    if reason:
        rig.set_gains(rig.loop, f"{why}: {reason}"[:250], _BACK_S)
    else:
        rig.keep()
    return OuterTrial(before_s, after_s, error_before_um, error_um, tracking, reason)


def unfit(found: ShapeLoopFit) -> str:
    """Why a time constant must not be tried; empty if it may be."""
    if found.agreement < 1 - _APART_MAX or abs(found.scale - 1) > _APART_MAX:
        return (
            f"the figure answers the setpoint by {found.scale:.2f} of what is assumed (direction "
            f"{found.agreement:.2f}): calibrate the camera first"
        )
    return ""


def _predicted(times_s: Series, gaps_um: Series, memory_s: float, last: int) -> float:
    """Rms error with which a tracker predicts the last gaps, each from those before it."""
    tracker = DriftTracker()
    tracker.begin(float(times_s[0]))
    errors_um: list[float] = []
    for time_s, gap_um in zip(
        times_s[1:].tolist(), (gaps_um[1:] - gaps_um[0]).tolist(), strict=True
    ):
        errors_um.append(gap_um - tracker.at(time_s, memory_s))
        tracker.take(gap_um, time_s, memory_s)
    return float(np.sqrt(np.mean(np.square(errors_um[-last:])))) if last else math.nan
