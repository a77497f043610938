"""Absolute phases of the bins of a set: from its Gray code, or from the set that it refers to."""

import math

import numpy as np

from membrane_ctrl.config.schema import OpticsConfig, PatternConfig
from membrane_ctrl.metrology.frame_checks import bin_view, frame_faults
from membrane_ctrl.metrology.frame_checks.checked_set import Anchor, RejectedSetError
from membrane_ctrl.metrology.phase import frame_stack
from membrane_ctrl.metrology.phase.fringe_orders import resolve_orders
from membrane_ctrl.metrology.phase.gray_code import gray_bit
from membrane_ctrl.metrology.phase.pattern_sequence import AXES
from membrane_ctrl.metrology.phase.screen_scale import inside_pattern
from membrane_ctrl.model.arrays import BoolArray, FloatArray

# A point whose phase moved further than this between two sets may have been taken for its neighbour
# a period away
_GUARD_RAD = 0.9 * math.pi
_LOST_SHARE = 0.01
# With these few of an axis' bits contradicting the orders, no other set of orders explains the rest
_BIT_MISMATCH = 0.02


def absolute_phases_of_bins(
    stack: frame_stack.FrameStack,
    binned: frame_stack.Binned,
    view: bin_view.BinView,
    anchor: Anchor | None,
    optics: OpticsConfig,
) -> FloatArray:
    """Absolute phases of the bins, (2, rows, columns); NaN where not valid."""
    if anchor is not None:
        return _follow_anchor(view, anchor)
    return absolute_phases(stack, binned, view, optics.pattern)


def absolute_phases(
    stack: frame_stack.FrameStack,
    binned: frame_stack.Binned,
    view: bin_view.BinView,
    pattern: PatternConfig,
) -> FloatArray:
    """Those of a set with Gray code, by that alone."""
    out = np.empty_like(view.phase_rad)
    for k, axis in enumerate(AXES):
        # the fringes' mean is half the light, which no single frame can spoil
        bits = binned.means[stack.gray(axis)] > view.light
        phase = resolve_orders(view.phase_rad[k], bits, view.mask).phase_rad
        out[k] = np.where(inside_pattern(phase, pattern), phase, np.nan)
    return out


def _follow_anchor(view: bin_view.BinView, anchor: Anchor) -> FloatArray:
    """Phases next to the anchor's. Raises NoFigureError if the film moved too far to tell."""
    change = np.angle(np.exp(1j * (view.phase_rad - anchor.phase_rad)))
    seen = view.mask & np.isfinite(anchor.phase_rad).all(axis=0)
    lost = float(np.mean(np.abs(change[:, seen]).max(axis=0) > _GUARD_RAD)) if seen.any() else 1.0
    if lost > _LOST_SHARE:
        raise bin_view.NoFigureError(
            f"the phase moved by half a period from the reference at {lost:.0%} of the points"
        )
    return np.where(seen, anchor.phase_rad + change, np.nan)


def confirm_orders(
    stack: frame_stack.FrameStack,
    phase_rad: FloatArray,
    binned: frame_stack.Binned,
    view: bin_view.BinView,
    excluded: set[int],
    flags: tuple[frame_faults.Flag, ...],
) -> None:
    """Raise unless the usable Gray bits of each axis allow no other orders than those taken."""
    for k, axis in enumerate(AXES):
        gray = stack.gray(axis)
        good = [bit for bit, frame in enumerate(gray, start=1) if frame not in excluded]
        if not gray or len(good) == len(gray):
            continue
        seen = np.isfinite(phase_rad[k])
        phase = phase_rad[k][seen]
        bits = {bit: (binned.means[gray[bit - 1]] > view.light)[seen] for bit in good}
        explained = [
            shift for shift in range(-7, 8) if _explain_bits(phase + 2 * math.pi * shift, bits)
        ]
        if explained != [0]:
            raise RejectedSetError(
                f"the {axis} fringe orders are not certain without all Gray frames", flags
            )


def _explain_bits(phase_rad: FloatArray, bits: dict[int, BoolArray]) -> bool:
    """Whether these orders lie in the pattern and show these bits, away from the bits' edges."""
    if np.min(phase_rad) < -1.5 * math.pi or np.max(phase_rad) > 15.5 * math.pi:
        return False
    for bit, seen in bits.items():
        shown, from_edge = gray_bit(phase_rad, bit)
        sure = from_edge > 0.5
        if np.mean(shown[sure] != seen[sure]) > _BIT_MISMATCH:
            return False
    return bool(bits)
