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

# The largest closure of a series, over the fringes' amplitude: this share, or a multiple of the
# median of the other series of the set. Good real series close to 0.02 to 0.04; a stale frame
# leaves 0.25 or more.
CLOSURE_SHARE = 0.05
CLOSURE_TIMES = 3.0
# Largest RMS difference of equal pictures, over the amplitude. Frames of different steps differ by
# 0.7 of the amplitude or more where a quarter of a period is seen.
SAME_SHARE = 0.15
LEFT_TIMES = 2.0  # closure of the other frames over the limit, once the bad frame is left out
GAIN = (
    2.0  # least `Closure.residual_ratio` of a bad frame: good ones reach 1.4, a stale one gives 6.8
)
INCONSISTENT_SHARE = 0.1  # share of pixels whose frequencies disagree; 0 in a good set
# Share of pixels that the fringes show brighter than white, or darker than black; by more than a
# tenth of their range.
BEYOND_SHARE = 0.05
_BEYOND_MARGIN = 0.1


@dataclass(frozen=True)
class AxisSeries:
    """One axis of a set, of F frequencies, four steps and n pixels.

    Attributes
    ----------
    axis : str
        "x" or "y".
    frames : (F, 4, n) array
        Intensities.
    periods : (F,) array
        Periods a screen, rising.
    shifts_rad : (4,) array
        Phase steps.
    """

    axis: str
    frames: FloatArray
    periods: FloatArray
    shifts_rad: FloatArray

    def phases_rad(self) -> FloatArray:
        """Wrapped phases (F, n)."""
        phasors = [compute_phasors(steps, self.shifts_rad) for steps in self.frames]
        return np.stack([np.angle(phasor) for phasor in phasors])

    def inconsistent_share(self) -> float:
        """Share of the pixels whose frequencies disagree."""
        return float(np.mean(~unwrap_in_time(self.phases_rad(), self.periods).consistent))

    def with_frames(self, index: int, steps: FloatArray) -> "AxisSeries":
        """Return the series with other frames of one frequency.

        Parameters
        ----------
        index : int
            Number of the frequency.
        steps : (4, n) array
            Its frames.
        """
        frames = self.frames.copy()
        frames[index] = steps
        return replace(self, frames=frames)


@dataclass(frozen=True)
class SeriesFlag:
    """A frame that does not belong to its set.

    Attributes
    ----------
    axis : str
        "x", "y", "white" or "black".
    index, step : int
        Frequency and step; 0 for white and black.
    reason : str
        For people.
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

    Parameters
    ----------
    axes : tuple of AxisSeries
        Four steps each.
    black, white : (n,) arrays
        Intensities of the same pixels.

    Returns
    -------
    SeriesCheck
        "rejected" if an axis still disagrees after the repair, "degraded" if frames are flagged.

    Raises
    ------
    ValueError
        No pixels, or not four steps.
    """
    limits = _closure_limits(axes)
    flags: list[SeriesFlag] = _judge_white_and_black(axes, black, white)
    repaired = []
    failures = []

    # Each series of each axis is repaired if one frame alone is wrong.
    for axis in axes:
        for index in range(len(axis.periods)):
            found, axis = _repair_series(axis, index, limits[axis.axis][index], axes)
            flags += found
        repaired.append(axis)
        failure = _describe_failure(axis, limits[axis.axis])
        if failure:
            failures.append(failure)

    # The verdict.
    if failures:
        return SeriesCheck("rejected", failures[0], tuple(flags), tuple(repaired))
    if flags:
        reason = f"{len(flags)} frame(s) flagged and left out"
        return SeriesCheck("degraded", reason, tuple(flags), tuple(repaired))
    return SeriesCheck("ok", "", (), tuple(repaired))


def _describe_failure(axis: AxisSeries, limits: list[float]) -> str:
    """Why an axis is not usable after the repair; empty if it is."""
    for k, limit in enumerate(limits):
        if _closure_share(axis, k) > limit:
            return f"{axis.axis}, {axis.periods[k]:g} periods: the steps do not agree"
    share = axis.inconsistent_share()
    if share > INCONSISTENT_SHARE:
        return f"{axis.axis}: the frequencies disagree at {share:.0%} of the pixels"
    return ""


def _series_amplitude(steps: FloatArray, shifts_rad: FloatArray) -> float:
    """Median amplitude of the fringes of one series."""
    return max(float(np.median(np.abs(compute_phasors(steps, shifts_rad)))), 1e-9)


def _closure_share(axis: AxisSeries, index: int) -> float:
    """Closure of one series, over its amplitude."""
    steps = axis.frames[index]
    rms_adu = compute_closure(steps, axis.shifts_rad).rms_adu
    return rms_adu / _series_amplitude(steps, axis.shifts_rad)


def _closure_limits(axes: tuple[AxisSeries, ...]) -> dict[str, list[float]]:
    """Largest closure share of each series by axis, from all the other series."""
    shares = {
        (axis.axis, k): _closure_share(axis, k) for axis in axes for k in range(len(axis.periods))
    }

    def compute_limit(own: tuple[str, int]) -> float:
        others = [share for key, share in shares.items() if key != own]
        if not others:
            return CLOSURE_SHARE
        return max(CLOSURE_SHARE, CLOSURE_TIMES * float(np.median(others)))

    return {
        axis.axis: [compute_limit((axis.axis, k)) for k in range(len(axis.periods))]
        for axis in axes
    }


def _repair_series(
    axis: AxisSeries, index: int, limit: float, axes: tuple[AxisSeries, ...]
) -> tuple[list[SeriesFlag], AxisSeries]:
    """Flags of one series, and the axis with the series repaired as far as possible."""
    disagrees = _closure_share(axis, index) > limit
    if not disagrees and axis.inconsistent_share() <= INCONSISTENT_SHARE:
        return [], axis

    # Two steps exchanged: an exchange back makes all agree.
    swapped = _find_exchange(axis, index, limit)
    if swapped is not None:
        (a, b), exchanged = swapped
        flags = [
            SeriesFlag(axis.axis, index, a, f"swapped with step {b}"),
            SeriesFlag(axis.axis, index, b, f"swapped with step {a}"),
        ]
        return flags, exchanged
    if not disagrees:
        return [], axis

    # The wrong step: it shows an earlier picture, or without it the others agree.
    closures = _compute_closures(axis, index)
    clearest = max(closures, key=lambda found: found.residual_ratio)
    step = clearest.suspect_frame
    reason = "does not agree with the other steps"
    same_picture = _find_same_picture(axis, index, axes)
    if same_picture is not None:
        step, reason = same_picture
    elif step is None or clearest.residual_ratio < GAIN:
        return [], axis
    flags = [SeriesFlag(axis.axis, index, step, reason)]

    # If the others still disagree, it is not the only wrong step. A coarser series that is wrong
    # makes the next one disagree; the finest has no next one, and is tested here.
    if index + 1 == len(axis.periods):
        left_adu = min(float(found.without_rms_adu[step]) for found in closures)
        amplitude_adu = _series_amplitude(axis.frames[index], axis.shifts_rad)
        if left_adu > LEFT_TIMES * limit * amplitude_adu:
            return flags, axis

    # I0 = I1 + I3 - I2, and correspondingly for the others.
    steps = axis.frames[index].copy()
    count = len(steps)
    after = steps[(step + 1) % count]
    before = steps[(step - 1) % count]
    opposite = steps[(step + 2) % count]
    steps[step] = after + before - opposite
    return flags, axis.with_frames(index, steps)


def _compute_closures(axis: AxisSeries, index: int) -> tuple[Closure, Closure]:
    """Closures that can name a frame: with the phase by the other frequencies, and with mean and
    amplitude by the next frequency.
    """
    is_finest = index + 1 == len(axis.periods)
    neighbour = index - 1 if is_finest else index + 1
    steps = axis.frames[index]
    steps_of_neighbour = axis.frames[neighbour]

    # A finer fringe is blurred: by the same factor all over the picture, to a good approximation.
    amplitude = np.abs(compute_phasors(steps_of_neighbour, axis.shifts_rad))
    own_amplitude = _series_amplitude(steps, axis.shifts_rad)
    amplitude *= own_amplitude / max(float(np.median(amplitude)), 1e-9)
    mean = steps_of_neighbour.mean(axis=0)

    expected_rad = predict_phase(axis.phases_rad(), axis.periods, index)
    return (
        closure_with_phase(steps, axis.shifts_rad, expected_rad),
        closure_with_level(steps, axis.shifts_rad, mean, amplitude),
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
        if _closure_share(other, index) > limit:
            continue
        if other.inconsistent_share() > INCONSISTENT_SHARE:
            continue
        found.append(((a, b), other))
    if len(found) == 1:
        return found[0]
    return None


def _find_same_picture(
    axis: AxisSeries, index: int, axes: tuple[AxisSeries, ...]
) -> tuple[int, str] | None:
    """A step of a series that shows the picture of an earlier frame, and the reason."""
    # Two frames show the same picture if they differ by less than this share of the fringes' swing.
    largest_difference = SAME_SHARE * _series_amplitude(axis.frames[index], axis.shifts_rad)

    # The frames in the order of capture; each step of this series against all before it, the last
    # one first, since a camera or panel that lags repeats that.
    earlier: list[tuple[str, FloatArray]] = []
    for series in axes:
        for k, steps in enumerate(series.frames):
            is_own = series.axis == axis.axis and k == index
            for step, frame in enumerate(steps):
                if is_own:
                    for name, other in reversed(earlier):
                        difference = math.sqrt(float(np.mean((frame - other) ** 2)))
                        if difference < largest_difference:
                            return step, f"stale: the same picture as {name}"
                name = f"{series.axis}, {series.periods[k]:g} periods, step {step}"
                earlier.append((name, frame))
            if is_own:
                return None
    return None


def _judge_white_and_black(
    axes: tuple[AxisSeries, ...], black: FloatArray, white: FloatArray
) -> list[SeriesFlag]:
    """Flags of white and black, which must enclose all that the fringes show."""
    # Brightest and darkest tenth of the fringes at each pixel, against white and black with a
    # margin for noise and flicker.
    frames = np.concatenate([axis.frames.reshape(-1, black.size) for axis in axes])
    margin = _BEYOND_MARGIN * np.ptp(np.percentile(frames, [5, 95]))
    typical_high, typical_low = np.percentile(frames, [90, 10], axis=0)
    white_share = float(np.mean(typical_high > white + margin))
    black_share = float(np.mean(typical_low < black - margin))
    flags = []
    if white_share > BEYOND_SHARE:
        reason = f"not brighter than the fringes at {white_share:.0%} of the pixels"
        flags.append(SeriesFlag("white", 0, 0, reason))
    if black_share > BEYOND_SHARE:
        reason = f"not darker than the fringes at {black_share:.0%} of the pixels"
        flags.append(SeriesFlag("black", 0, 0, reason))
    return flags
