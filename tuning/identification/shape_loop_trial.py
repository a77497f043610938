"""The trial of a time constant of the shape loop.

The drift does not depend on the trim, so that both trackers can be run on the very shapes of the
trial: only the tracker differs, and no weather has to be compared.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.control.drift_tracker import DriftTracker
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.telemetry import ShapeState
from tuning.identification.record import Series
from tuning.identification.shape_loop_fit import LEAST_CYCLES, compute_gaps_um
from tuning.rigs.hold_rig import HoldRig

_SPARE_S = 120.0
_BACK_S = 1.0  # a trial that is over at once: the hold takes its own time constant back
GROWTH_MAX = 1.1  # of the error with which the next shape is predicted
_TRACKING_LEAST = 0.9  # of the trial


@dataclass(frozen=True, slots=True)
class OuterTrial:
    """`outer_verified.json`: the verification of a time constant of the shape loop."""

    before_s: float
    after_s: float
    error_before_um: float  # rms prediction error of each tracker on the shapes of the trial
    error_um: float
    tracking: float  # share of the trial in which the shape loop tracked
    reason: str  # why it is taken back; empty if it is kept


def try_time_constant(
    rig: HoldRig,
    times_s: tuple[float, float],
    earlier: Sequence[ShapeEstimate],
    assumed: Series,
    duration_s: float,
) -> OuterTrial:
    """Hold with another time constant; keep it if it predicts the shapes as well as the
    present one.

    If the session ends, or is killed, the hold takes it back by itself.

    Parameters
    ----------
    rig : HoldRig
        The hold.
    times_s : (float, float)
        The present time constant, and the one to try.
    earlier : sequence of ShapeEstimate
        Shapes before the trial, with which both trackers settle.
    assumed : (terms,) array
        Zernike coefficients of a film of sag 1, as the hold assumes them.
    duration_s : float
        Length of the trial.
    """
    # Hold with the new one, on trial: the hold itself restores the former if this session ends.
    before_s, after_s = times_s
    why = "shape loop: time constant"
    rig.set_gains(rig.loop, why, duration_s + _SPARE_S, after_s)
    begun = len(rig.shapes)
    try:
        rows = rig.ticks(duration_s)
    except BaseException:  # Ctrl-C above all
        rig.set_gains(rig.loop, f"{why}: interrupted", _BACK_S)
        raise
    # What either time constant would have predicted of each next shape.
    during = [shape for shape in rig.shapes[begun:] if shape.verdict != "rejected"]
    tracking = float(np.mean([row.shape_state == ShapeState.TRACKING for row in rows]))
    gaps = compute_gaps_um([*earlier, *during], assumed)
    error_before_um, error_um = (
        _prediction_error(*gaps, memory_s, len(during)) for memory_s in (before_s, after_s)
    )
    # Kept only if the loop tracked, and predicts as well as before.
    reason = ""
    if len(during) < LEAST_CYCLES or tracking < _TRACKING_LEAST:
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
        rig.keep_gains()
    return OuterTrial(before_s, after_s, error_before_um, error_um, tracking, reason)


def _prediction_error(times_s: Series, gaps_um: Series, memory_s: float, last: int) -> float:
    """Rms error with which a tracker predicts the last gaps, each from those before it."""
    tracker = DriftTracker()
    tracker.begin(float(times_s[0]))
    errors_um: list[float] = []
    from_first_um = gaps_um[1:] - gaps_um[0]
    for time_s, gap_um in zip(times_s[1:].tolist(), from_first_um.tolist(), strict=True):
        errors_um.append(gap_um - tracker.drift_at(time_s, memory_s))
        tracker.add_reading(gap_um, time_s, memory_s)
    if not last:
        return math.nan
    return float(np.sqrt(np.mean(np.square(errors_um[-last:]))))
