"""Which frames of a multi-frequency set do not belong, and what can be done without them.

A set is two axes of some frequencies of four steps, and white and black. It is judged against
itself: how large a disagreement is too large follows from the other series of the set, so that a
display's gamma, which all share, is no fault. Three checks:

- equal pictures: no two frames of a set should be the same (a stale frame, however little it
  matters),
- the closure I0 - I1 + I2 - I3 of each series and, with the phase or the level known, the frame at
  fault;
- the frequencies against each other: exchanging steps 0 and 2, or 1 and 3, keeps the closure but
  reverses the phase, which then contradicts the other frequencies.

One of four steps can be replaced: the phase of the other three gives I0 = I1 + I3 - I2, and
correspondingly for the others.
"""

import math
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from membrane_ctrl.metrology.frame_checks.closure import (
    Closure,
    closure_with_level,
    closure_with_phase,
    compute_closure,
)
from membrane_ctrl.metrology.phase.phase_steps import compute_phasors
from membrane_ctrl.metrology.phase.temporal_unwrap import predict_phase, unwrap_in_time
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.shape_estimate import Verdict

# Shares of the fringes' amplitude. Good real series close to 0.02 to 0.04; a stale frame leaves
# 0.25 or more.
CLOSURE_SHARE = 0.05
CLOSURE_TIMES = 3.0  # of the median of the other series of the set
# Two frames of different steps differ by 0.7 of the amplitude or more where a quarter of a period
# is seen.
SAME_SHARE = 0.15
LEFT_TIMES = 2.0  # of the limit: how far the others may disagree once the bad frame is left out
GAIN = 2.0  # good frames reach 1.4, a stale one gives 6.8 or more
INCONSISTENT_SHARE = 0.1  # pixels whose frequencies disagree; none do in a good set
BEYOND_SHARE = 0.05  # of pixels that a frame shows brighter than white, or darker than black


@dataclass(frozen=True)
class AxisSeries:
    """One axis of a set."""

    axis: str  # "x" or "y"
    frames: FloatArray  # (F, 4, n): frequency, step, pixel
    periods: FloatArray  # (F,): periods a screen, rising
    shifts_rad: FloatArray  # (4,): phase steps

    def phases_rad(self) -> FloatArray:
        """Wrapped phases (F, n)."""
        return np.stack(
            [np.angle(compute_phasors(steps, self.shifts_rad)) for steps in self.frames]
        )

    def inconsistent_share(self) -> float:
        """Share of the pixels whose frequencies disagree."""
        return float(np.mean(~unwrap_in_time(self.phases_rad(), self.periods).consistent))

    def with_frames(self, index: int, steps: FloatArray) -> "AxisSeries":
        """The same with other frames of one frequency."""
        frames = self.frames.copy()
        frames[index] = steps
        return replace(self, frames=frames)


@dataclass(frozen=True)
class SeriesFlag:
    """A frame that does not belong: axis ("x", "y", "white", "black"), frequency and step (0 for
    white), and why.
    """

    axis: str
    index: int
    step: int
    reason: str


@dataclass(frozen=True)
class SeriesCheck:
    """Result: verdict and reason, flags, and both axes with what could be repaired."""

    verdict: Verdict
    reason: str
    flags: tuple[SeriesFlag, ...]
    axes: tuple[AxisSeries, ...]


def check_series(axes: tuple[AxisSeries, ...], black: FloatArray, white: FloatArray) -> SeriesCheck:
    """Check the axes of a set, in the order in which they were taken.

    Raises ValueError if there are no pixels or not four steps.

    Parameters
    ----------
    axes : AxisSeries
        Four steps each.
    black, white : (n,) arrays
        Of the same pixels.
    """
    limits = _closure_limits(axes)
    flags: list[SeriesFlag] = _flat_flags(axes, black, white)
    mended, failures = [], []
    for axis in axes:
        for index in range(len(axis.periods)):
            found, axis = _repair_series(axis, index, limits[axis.axis][index], axes)
            flags += found
        mended.append(axis)
        bad = [
            k for k in range(len(axis.periods)) if _closure_share(axis, k) > limits[axis.axis][k]
        ]
        if bad:
            failures.append(
                f"{axis.axis}, {axis.periods[bad[0]]:g} periods: the steps do not agree"
            )
        elif axis.inconsistent_share() > INCONSISTENT_SHARE:
            failures.append(
                f"{axis.axis}: the frequencies disagree at {axis.inconsistent_share():.0%} "
                "of the pixels"
            )
    if failures:
        return SeriesCheck("rejected", failures[0], tuple(flags), tuple(mended))
    if flags:
        return SeriesCheck(
            "degraded", f"{len(flags)} frame(s) flagged and left out", tuple(flags), tuple(mended)
        )
    return SeriesCheck("ok", "", (), tuple(mended))


def _series_amplitude(steps: FloatArray, shifts_rad: FloatArray) -> float:
    return max(float(np.median(np.abs(compute_phasors(steps, shifts_rad)))), 1e-9)


def _closure_share(axis: AxisSeries, index: int) -> float:
    """Of one series, over its amplitude."""
    steps = axis.frames[index]
    return compute_closure(steps, axis.shifts_rad).rms_adu / _series_amplitude(
        steps, axis.shifts_rad
    )


def _closure_limits(axes: tuple[AxisSeries, ...]) -> dict[str, list[float]]:
    """For each series, from all the others."""
    shares = {
        (axis.axis, k): _closure_share(axis, k) for axis in axes for k in range(len(axis.periods))
    }

    def limit(own: tuple[str, int]) -> float:
        others = [share for key, share in shares.items() if key != own]
        return (
            max(CLOSURE_SHARE, CLOSURE_TIMES * float(np.median(others)))
            if others
            else CLOSURE_SHARE
        )

    return {axis.axis: [limit((axis.axis, k)) for k in range(len(axis.periods))] for axis in axes}


def _repair_series(
    axis: AxisSeries, index: int, limit: float, axes: tuple[AxisSeries, ...]
) -> tuple[list[SeriesFlag], AxisSeries]:
    """Flags of one series, and the axis with the series repaired as far as possible."""
    disagree = _closure_share(axis, index) > limit
    if not disagree and axis.inconsistent_share() <= INCONSISTENT_SHARE:
        return [], axis
    swapped = _find_exchange(axis, index, limit)
    if swapped is not None:
        (a, b), better = swapped
        flags = [
            SeriesFlag(axis.axis, index, k, f"swapped with step {j}") for k, j in ((a, b), (b, a))
        ]
        return flags, better
    if not disagree:
        return [], axis
    closures = _compute_closures(axis, index)
    clearest = max(closures, key=lambda found: found.gain)
    step, reason = clearest.suspect, "does not agree with the other steps"
    twin = _find_twin(axis, index, axes)
    if twin is not None:
        step, reason = twin
    elif step is None or clearest.gain < GAIN:
        return [], axis
    flags = [SeriesFlag(axis.axis, index, step, reason)]
    if index + 1 == len(axis.periods):  # a wrong coarser one makes the next disagree; this has none
        left = min(float(found.without_rms_adu[step]) for found in closures)
        if left > LEFT_TIMES * limit * _series_amplitude(axis.frames[index], axis.shifts_rad):
            return flags, axis  # it is not the only one
    steps = axis.frames[index].copy()
    count = len(steps)
    steps[step] = steps[(step + 1) % count] + steps[(step - 1) % count] - steps[(step + 2) % count]
    return flags, axis.with_frames(index, steps)


def _compute_closures(axis: AxisSeries, index: int) -> tuple[Closure, Closure]:
    """Closures that can name a frame: with the other frequencies' phase known, and with the level
    of the next.
    """
    neighbour = index - 1 if index + 1 == len(axis.periods) else index + 1
    steps, near = axis.frames[index], axis.frames[neighbour]
    amplitude = np.abs(compute_phasors(near, axis.shifts_rad))
    # a finer fringe is blurred: the same all over the picture to a good approximation
    amplitude *= _series_amplitude(steps, axis.shifts_rad) / max(float(np.median(amplitude)), 1e-9)
    expected = predict_phase(axis.phases_rad(), axis.periods, index)
    return (
        closure_with_phase(steps, axis.shifts_rad, expected),
        closure_with_level(steps, axis.shifts_rad, near.mean(axis=0), amplitude),
    )


def _find_exchange(
    axis: AxisSeries, index: int, limit: float
) -> tuple[tuple[int, int], AxisSeries] | None:
    """The only exchange of two steps after which they agree, among themselves and with the other
    frequencies.
    """
    found = []
    for a, b in combinations(range(len(axis.shifts_rad)), 2):
        steps = axis.frames[index].copy()
        steps[[a, b]] = steps[[b, a]]
        other = axis.with_frames(index, steps)
        if (
            _closure_share(other, index) <= limit
            and other.inconsistent_share() <= INCONSISTENT_SHARE
        ):
            found.append(((a, b), other))
    return found[0] if len(found) == 1 else None


def _find_twin(
    axis: AxisSeries, index: int, axes: tuple[AxisSeries, ...]
) -> tuple[int, str] | None:
    """A step that shows the picture of an earlier frame, and which one."""
    earlier: list[tuple[str, FloatArray]] = []
    amplitude = _series_amplitude(axis.frames[index], axis.shifts_rad)
    for series in axes:
        for k, steps in enumerate(series.frames):
            for step, frame in enumerate(steps):
                here = series.axis == axis.axis and k == index
                if here:
                    for name, other in reversed(earlier):
                        if math.sqrt(float(np.mean((frame - other) ** 2))) < SAME_SHARE * amplitude:
                            return step, f"stale: the same picture as {name}"
                earlier.append(
                    (f"{series.axis}, {series.periods[k]:g} periods, step {step}", frame)
                )
            if series.axis == axis.axis and k == index:
                return None
    return None


def _flat_flags(
    axes: tuple[AxisSeries, ...], black: FloatArray, white: FloatArray
) -> list[SeriesFlag]:
    """White and black must enclose all that the fringes show."""
    frames = np.concatenate([axis.frames.reshape(-1, black.size) for axis in axes])
    margin = 0.1 * np.ptp(np.percentile(frames, [5, 95]))
    typical_high, typical_low = np.percentile(frames, [90, 10], axis=0)
    white_share = float(np.mean(typical_high > white + margin))
    black_share = float(np.mean(typical_low < black - margin))
    return [
        SeriesFlag(name, 0, 0, f"not {word} than the fringes at {share:.0%} of the pixels")
        for name, word, share in (
            ("white", "brighter", white_share),
            ("black", "darker", black_share),
        )
        if share > BEYOND_SHARE
    ]
