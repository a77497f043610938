"""Sets of several fringe periods: the coarser fringes give the orders of the finest, whose phase is
measured.

The periods may have any ratio. Each bin votes for the place on the screen that explains all its
phases (`phase.places_mm`), and continuity of the finest phase decides (`orders.by_votes`). What
follows measures the finest fringes like any set that refers to a full one, so that its noise is
theirs.
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

# 1 sigma of a phase, noise and harmonics together: the largest with which most bins know their
# place
_SIGMAS_RAD = (0.2, 0.1, 0.05, 0.02)
_MOST = 0.5
_LEAST_KNOWN = 0.02  # of the bins with fringes: fewer places are chance


@dataclass(frozen=True)
class _Series:
    """The steps of one axis and period."""

    axis: int
    period_mm: float
    frames: list[int]  # those that are usable
    shifts_rad: FloatArray
    seen: FloatArray  # (N, bins): where there are fringes

    @property
    def phasor(self) -> FloatArray:
        """(bins,), complex."""
        return np.asarray(phase_steps.compute_phasors(self.seen, self.shifts_rad))

    def share(self) -> float:
        """What a sinusoid leaves of the frames, over its amplitude; NaN for three steps, which
        always agree.
        """
        return (
            self._over_amplitude(closure.compute_closure(self.seen, self.shifts_rad).rms_adu)
            if len(self.frames) > 3
            else np.nan
        )

    def _over_amplitude(self, rms_adu: float) -> float:
        return rms_adu / max(float(np.median(np.abs(self.phasor))), 1e-9)

    def blamed(self, place_mm: FloatArray) -> closure.Closure:
        """The closure that can name a frame: of five steps, or with the phase by the other periods'
        place.
        """
        if len(self.frames) > 4:
            return closure.compute_closure(self.seen, self.shifts_rad)
        known = np.isfinite(place_mm)
        expected = 2 * np.pi * place_mm[known] / self.period_mm - np.pi
        return closure.closure_with_phase(self.seen[:, known], self.shifts_rad, expected)


def check_frequencies(stack: FrameStack, optics: OpticsConfig) -> Checked:
    """Check a set of several periods, the finest first, and fit its bins.
    Raises RejectedSetError.
    """
    binned, flags = bin_frames(stack, 2**optics.camera.bits - 1), dict[int, Flag]()
    finest = [k for k, pattern in enumerate(stack.patterns) if not pattern.period_mm]
    count = len(finest)
    coarser = {k: reason for k, reason in stack.unusable.items() if k >= count}
    flags |= {k: frame_faults.flag_unreadable(k, reason) for k, reason in coarser.items()}
    mask = _find_fringes(stack, binned)
    while True:
        series = list(_all_series(stack, binned, optics, mask, flags))
        places = [_locate_bins(series, axis, optics) for axis in range(2)]
        bad = _bad_frame(stack, series, places)
        if bad is None:
            break
        flags[bad.frame] = bad
    named = tuple(flags[k] for k in sorted(flags))
    absolute = np.stack(
        [_unwrap_finest(series, axis, places[axis], optics, mask, named) for axis in range(2)]
    )
    light = binned.means[finest].mean(axis=0).astype(float)
    former = [stack.before_of(frame) for frame in range(count)]
    fine = FrameStack(
        stack.frames[:count],
        stack.patterns[:count],
        stack.displacement_um[:count],
        {k: reason for k, reason in stack.unusable.items() if k < count},
        before=tuple(before if before < count else -1 for before in former),
    )
    try:
        checked = check_set(fine, optics, Anchor(absolute, light))
    except RejectedSetError as error:
        flagged = error.flags + named
        raise RejectedSetError(str(error), flagged, error.saturated_fraction) from None
    return replace(checked, flags=checked.flags + named)


def _find_fringes(stack: FrameStack, binned: Binned) -> BoolArray:
    """Bins (rows, columns) where all periods swing, the median of their swings at least."""
    swings = []
    for axis in pattern_sequence.AXES:
        for period in sorted({pattern.period_mm for pattern in stack.patterns}):
            frames = _make_series(stack, axis, period, ())
            shifts = stack.shifts_rad(frames)
            swings.append(np.abs(phase_steps.compute_phasors(binned.means[frames], shifts)))
    swing = np.median(swings, axis=0)
    return np.asarray(
        (swing > full_decoder.CONTRAST_SHARE * np.percentile(swing, 95))
        & ~binned.saturated.any(axis=0)
    )


def _make_series(
    stack: FrameStack, axis: str, period_mm: float, left_out: Collection[int]
) -> list[int]:
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
            frames = _make_series(stack, axis, period, left_out)
            shifts, period_mm = stack.shifts_rad(frames), period or optics.pattern.period_mm
            try:
                phase_steps.step_weights(shifts)
            except ValueError:
                said = (
                    f"{len(frames)} {axis} phase steps of {period_mm:g} mm are usable: too few "
                    "for a phase"
                )
                named = tuple(Flag(n, FrameDefect.LEFT_OUT, "left out", np.inf) for n in left_out)
                raise RejectedSetError(said, named) from None
            yield _Series(k, period_mm, frames, shifts, binned.means[frames][:, mask].astype(float))


def _locate_bins(series: list[_Series], axis: int, optics: OpticsConfig) -> FloatArray:
    """Places (bins,) from the pattern's low edge; NaN where the periods do not tell."""
    own = [one for one in series if one.axis == axis]
    wrapped = np.stack([np.angle(one.phasor) + np.pi for one in own])
    periods_mm, side_mm = (
        [one.period_mm for one in own],
        optics.pattern.periods * optics.pattern.period_mm,
    )
    found = []
    for sigma_rad in _SIGMAS_RAD:
        found.append(
            multi_period.places_mm(wrapped, periods_mm, (0.0, side_mm), sigma_rad).place_mm
        )
        if np.mean(np.isfinite(found[-1])) > _MOST:
            break
    return max(found, key=lambda place_mm: np.count_nonzero(np.isfinite(place_mm)))


def _bad_frame(stack: FrameStack, series: list[_Series], places: list[FloatArray]) -> Flag | None:
    """The frame of the coarser periods that disagrees most, if one does.
    `check` judges the finest.
    """
    shares = [one.share() for one in series]
    found = []
    for k, one in enumerate(series):
        others = [share for j, share in enumerate(shares) if j != k and np.isfinite(share)]
        limit = (
            max(CLOSURE_SHARE, CLOSURE_TIMES * float(np.median(others)))
            if others
            else CLOSURE_SHARE
        )
        if not stack.patterns[one.frames[0]].period_mm or not shares[k] > limit:
            continue
        if not np.isfinite(places[one.axis]).any():
            continue
        blamed = one.blamed(places[one.axis])
        if blamed.suspect is not None and blamed.gain > GAIN:
            said = (
                f"does not agree with the other steps: {shares[k]:.0%} of the fringes' amplitude "
                "is left"
            )
            frame = one.frames[blamed.suspect]
            found.append(Flag(frame, FrameDefect.INCONSISTENT, said, shares[k] / limit))
    return max(found, key=lambda flag: flag.severity, default=None)


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
    finest = next(one for one in series if one.axis == axis)
    wrapped, coded = np.full((2, *mask.shape), np.nan)
    wrapped[mask] = np.angle(finest.phasor)
    coarse = 2 * np.pi * place_mm / finest.period_mm - np.pi
    coded[mask] = wrapped[mask] + 2 * np.pi * np.rint((coarse - wrapped[mask]) / (2 * np.pi))
    found = fringe_orders.resolve_orders_by_votes(np.nan_to_num(wrapped), coded, mask)
    if found.torn or not np.mean(np.isfinite(place_mm)) > _LEAST_KNOWN:
        raise RejectedSetError(
            f"the phases of the {pattern_sequence.AXES[axis]} periods do not agree on the fringe "
            "orders: check period_mm, axis and index of these frames",
            flags,
        )
    return np.where(
        screen_scale.inside_pattern(found.phase_rad, optics.pattern), found.phase_rad, np.nan
    )
