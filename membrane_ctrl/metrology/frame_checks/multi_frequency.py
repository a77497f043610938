"""Sets of several fringe periods: the coarser fringes give the orders of the finest, whose phase is
measured.

The periods may have any ratio. Each bin votes for the place on the screen that explains all its
phases (`multi_period.places_mm`), and continuity of the finest phase decides
(`fringe_orders.resolve_orders_by_votes`). The finest fringes are then measured as a set that refers
to a full one, so that the noise of the figure is theirs.
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.frame_checks import closure, frame_faults
from membrane_ctrl.metrology.frame_checks.checked_set import Anchor, Checked, RejectedSetError
from membrane_ctrl.metrology.frame_checks.frame_faults import Flag, FrameDefect
from membrane_ctrl.metrology.frame_checks.frequency_series import CLOSURE_SHARE, CLOSURE_TIMES, GAIN
from membrane_ctrl.metrology.frame_checks.set_check import check_set
from membrane_ctrl.metrology.phase import (
    fringe_orders,
    full_decoder,
    multi_period,
    pattern_sequence,
    phase_steps,
    screen_scale,
)
from membrane_ctrl.metrology.phase.frame_stack import Binned, FrameStack, bin_frames
from membrane_ctrl.model.arrays import BoolArray, FloatArray

# Standard deviations of a phase that are tried, of noise and harmonics together: the largest with
# which most bins have one place.
_SIGMAS_RAD = (0.2, 0.1, 0.05, 0.02)
_MOST = 0.5  # share of the bins
_LEAST_KNOWN = 0.02  # share of the bins with fringes: fewer places are chance
_BRIGHTEST_PERCENTILE = 95  # the swing that `CONTRAST_SHARE` refers to


@dataclass(frozen=True)
class _Series:
    """The N usable steps of one axis and period.

    Attributes
    ----------
    axis : int
        0: x, 1: y.
    period_mm : float
        Period on the screen.
    frames : list of int
        The usable steps.
    shifts_rad : (N,) array
        Phase steps.
    seen : (N, bins) array
        Intensities of the bins with fringes.
    """

    axis: int
    period_mm: float
    frames: list[int]
    shifts_rad: FloatArray
    seen: FloatArray

    @property
    def phasor(self) -> FloatArray:
        """Complex phasor of the fringes in each bin (bins,)."""
        return np.asarray(phase_steps.compute_phasors(self.seen, self.shifts_rad))

    def closure_share(self) -> float:
        """What a sinusoid leaves of the frames, over its amplitude; NaN for three steps, which
        always agree.
        """
        if len(self.frames) <= 3:
            return np.nan
        rms_adu = closure.compute_closure(self.seen, self.shifts_rad).rms_adu
        amplitude_adu = float(np.median(np.abs(self.phasor)))
        return rms_adu / max(amplitude_adu, 1e-9)

    def compute_naming_closure(self, place_mm: FloatArray) -> closure.Closure:
        """The closure that can name a frame: of five steps, or of four with a known phase.

        That phase follows from the places (bins,) that all periods together give.
        """
        if len(self.frames) > 4:
            return closure.compute_closure(self.seen, self.shifts_rad)
        known = np.isfinite(place_mm)
        expected_rad = 2 * np.pi * place_mm[known] / self.period_mm - np.pi
        return closure.closure_with_phase(self.seen[:, known], self.shifts_rad, expected_rad)


def check_frequencies(stack: FrameStack, optics: OpticsConfig) -> Checked:
    """Check a set of several periods, the finest first, and fit its bins.

    Parameters
    ----------
    stack : FrameStack
        The set; patterns of the coarser periods state theirs.
    optics : OpticsConfig
        The bench.

    Returns
    -------
    Checked
        The frames of the finest period, with the flags of all.

    Raises
    ------
    RejectedSetError
        The frames give no figure.
    """
    binned = bin_frames(stack, 2**optics.camera.bits - 1)
    finest = [k for k, pattern in enumerate(stack.patterns) if not pattern.period_mm]
    count = len(finest)
    flags: dict[int, Flag] = {}
    for k, reason in stack.unusable.items():
        if k >= count:
            flags[k] = frame_faults.flag_unreadable(k, reason)

    # Places on the screen, without the frames of coarser periods that disagree, one after the
    # other.
    mask = _find_fringes(stack, binned)
    while True:
        series = list(_all_series(stack, binned, optics, mask, flags))
        places = [_locate_bins(series, axis, optics) for axis in range(2)]
        bad = _find_bad_frame(stack, series, places)
        if bad is None:
            break
        flags[bad.frame] = bad
    named = tuple(flags[k] for k in sorted(flags))

    # They give the orders of the finest fringes, which are then checked as a set with an anchor.
    absolute_rad = np.stack(
        [_unwrap_finest(series, axis, places[axis], optics, mask, named) for axis in range(2)]
    )
    light = binned.means[finest].mean(axis=0).astype(float)
    fine = _take_finest(stack, count)
    try:
        checked = check_set(fine, optics, Anchor(absolute_rad, light))
    except RejectedSetError as error:
        flagged = error.flags + named
        raise RejectedSetError(str(error), flagged, error.saturated_fraction) from None
    return replace(checked, flags=checked.flags + named)


def _take_finest(stack: FrameStack, count: int) -> FrameStack:
    """The set of the first `count` frames alone."""
    before = [stack.frame_before(frame) for frame in range(count)]
    return FrameStack(
        stack.frames[:count],
        stack.patterns[:count],
        stack.displacement_um[:count],
        {k: reason for k, reason in stack.unusable.items() if k < count},
        before=tuple(frame if frame < count else -1 for frame in before),
    )


def _find_fringes(stack: FrameStack, binned: Binned) -> BoolArray:
    """Bins (rows, columns) where all periods swing, the median of their swings at least."""
    swings = []
    for axis in pattern_sequence.AXES:
        for period in sorted({pattern.period_mm for pattern in stack.patterns}):
            frames = _make_series(stack, axis, period, ())
            shifts = stack.shifts_rad(frames)
            swings.append(np.abs(phase_steps.compute_phasors(binned.means[frames], shifts)))
    swing = np.median(swings, axis=0)
    least_swing = full_decoder.CONTRAST_SHARE * np.percentile(swing, _BRIGHTEST_PERCENTILE)
    return np.asarray((swing > least_swing) & ~binned.saturated.any(axis=0))


def _make_series(
    stack: FrameStack, axis: str, period_mm: float, left_out: Collection[int]
) -> list[int]:
    """The frames of an axis and period; 0: the finest."""
    return [
        k
        for k, p in enumerate(stack.patterns)
        if (p.axis, p.period_mm) == (axis, period_mm) and k not in left_out
    ]


def _all_series(
    stack: FrameStack,
    binned: Binned,
    optics: OpticsConfig,
    mask: BoolArray,
    left_out: Collection[int],
) -> Iterator[_Series]:
    """All series, without the frames left out. Raises RejectedSetError if too few steps remain of
    one.
    """
    for k, axis in enumerate(pattern_sequence.AXES):
        for period in sorted({pattern.period_mm for pattern in stack.patterns}):
            # One axis and period; its steps must determine a phase.
            frames = _make_series(stack, axis, period, left_out)
            shifts = stack.shifts_rad(frames)
            period_mm = period or optics.pattern.period_mm
            try:
                phase_steps.step_weights(shifts)
            except ValueError:
                reason = (
                    f"{len(frames)} {axis} phase steps of {period_mm:g} mm are usable: too few "
                    "for a phase"
                )
                named = tuple(Flag(n, FrameDefect.LEFT_OUT, "left out", np.inf) for n in left_out)
                raise RejectedSetError(reason, named) from None

            # The light of the bins in these steps.
            seen = binned.means[frames][:, mask].astype(float)
            yield _Series(k, period_mm, frames, shifts, seen)


def _locate_bins(series: list[_Series], axis: int, optics: OpticsConfig) -> FloatArray:
    """Places (bins,) from the pattern's low edge, mm; NaN where the periods do not determine
    them.
    """
    # The phases of all periods of this axis.
    own = [each for each in series if each.axis == axis]
    wrapped_rad = np.stack([np.angle(each.phasor) + np.pi for each in own])
    periods_mm = [each.period_mm for each in own]
    side_mm = optics.pattern.periods * optics.pattern.period_mm
    best_mm = np.full(wrapped_rad.shape[1], np.nan)
    # A larger assumed noise finds fewer places that are wrong, and more that remain open: the
    # smallest that leaves most of them is used.
    for sigma_rad in _SIGMAS_RAD:
        places = multi_period.places_mm(wrapped_rad, periods_mm, (0.0, side_mm), sigma_rad)
        if np.isfinite(places.place_mm).sum() > np.isfinite(best_mm).sum():
            best_mm = places.place_mm
        if np.mean(np.isfinite(places.place_mm)) > _MOST:
            break
    return best_mm


def _find_bad_frame(
    stack: FrameStack, series: list[_Series], places: list[FloatArray]
) -> Flag | None:
    """The frame of the coarser periods that disagrees most, if one does.

    `check_set` judges the finest.
    """
    shares = [each.closure_share() for each in series]
    flags = []
    for k, each in enumerate(series):
        if not stack.patterns[each.frames[0]].period_mm:
            continue  # the finest
        # A series disagrees if it closes much worse than the others.
        others = [share for j, share in enumerate(shares) if j != k and np.isfinite(share)]
        limit = CLOSURE_SHARE
        if others:
            limit = max(CLOSURE_SHARE, CLOSURE_TIMES * float(np.median(others)))
        if not shares[k] > limit:
            continue
        # The frame without which the rest agrees.
        place_mm = places[each.axis]
        if not np.isfinite(place_mm).any():
            continue
        found = each.compute_naming_closure(place_mm)
        if found.suspect_frame is None or found.residual_ratio <= GAIN:
            continue
        reason = (
            f"does not agree with the other steps: {shares[k]:.0%} of the fringes' amplitude is "
            "left"
        )
        frame = each.frames[found.suspect_frame]
        flags.append(Flag(frame, FrameDefect.INCONSISTENT, reason, shares[k] / limit))
    return max(flags, key=lambda flag: flag.severity, default=None)


def _unwrap_finest(
    series: list[_Series],
    axis: int,
    place_mm: FloatArray,
    optics: OpticsConfig,
    mask: BoolArray,
    flags: tuple[Flag, ...],
) -> FloatArray:
    """Absolute phase (rows, columns) of the finest fringes; NaN where not known. Raises
    RejectedSetError.
    """
    # The phase of the finest fringes, modulo 2 pi.
    finest = next(each for each in series if each.axis == axis)
    wrapped_rad = np.full(mask.shape, np.nan)
    wrapped_rad[mask] = np.angle(finest.phasor)

    # Each bin votes for the order that is next to its place by all periods; neighbours then agree
    # on one order for each connected region.
    coarse_rad = 2 * np.pi * place_mm / finest.period_mm - np.pi
    orders = np.rint((coarse_rad - wrapped_rad[mask]) / (2 * np.pi))
    voted_rad = np.full(mask.shape, np.nan)
    voted_rad[mask] = wrapped_rad[mask] + 2 * np.pi * orders
    found = fringe_orders.resolve_orders_by_votes(np.nan_to_num(wrapped_rad), voted_rad, mask)
    if found.torn or not np.mean(np.isfinite(place_mm)) > _LEAST_KNOWN:
        raise RejectedSetError(
            f"the phases of the {pattern_sequence.AXES[axis]} periods do not agree on the fringe "
            "orders: check period_mm, axis and index of these frames",
            flags,
        )

    # Phases beside the pattern are those of no fringe.
    inside = screen_scale.inside_pattern(found.phase_rad, optics.pattern)
    return np.where(inside, found.phase_rad, np.nan)
