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

# A phase that moved further than this between two sets may have got the order of the next period.
_GUARD_RAD = 0.9 * math.pi
_LOST_SHARE = 0.01  # share of such points that a set may have
# Share of a bit's bins that may contradict the orders: no other set of orders explains so many.
_BIT_MISMATCH = 0.02
_EDGE_RAD = 0.5  # bins nearer to a bit's edge than this are not compared
# Absolute phases of the code: eight periods from -pi, and half a period beyond at each end.
_LEAST_PHASE_RAD = -1.5 * math.pi
_LARGEST_PHASE_RAD = 15.5 * math.pi
_OTHER_ORDERS = range(-7, 8)  # shifts of all orders that are tried, in periods


def absolute_phases_of_bins(
    stack: frame_stack.FrameStack,
    binned: frame_stack.Binned,
    view: bin_view.BinView,
    anchor: Anchor | None,
    optics: OpticsConfig,
) -> FloatArray:
    """Absolute phases of the bins, (2, rows, columns); NaN where not valid.

    They follow from the Gray code or, with an `anchor`, from the phases of the set that it was made
    of. Raises NoFigureError if the film moved too far from the anchor.
    """
    if anchor is not None:
        return _follow_anchor(view, anchor)
    return absolute_phases(stack, binned, view, optics.pattern)


def absolute_phases(
    stack: frame_stack.FrameStack,
    binned: frame_stack.Binned,
    view: bin_view.BinView,
    pattern: PatternConfig,
) -> FloatArray:
    """Absolute phases (2, rows, columns) of a set with Gray code; NaN where not valid (eq. 2)."""
    absolute_rad = np.empty_like(view.phase_rad)
    for k, axis in enumerate(AXES):
        # A bit is bright above half the light: the mean of the fringes, which no single frame can
        # spoil.
        bits = binned.means[stack.gray(axis)] > view.light
        phase_rad = resolve_orders(view.phase_rad[k], bits, view.mask).phase_rad
        absolute_rad[k] = np.where(inside_pattern(phase_rad, pattern), phase_rad, np.nan)
    return absolute_rad


def _follow_anchor(view: bin_view.BinView, anchor: Anchor) -> FloatArray:
    """Absolute phases nearest to the anchor's. Raises NoFigureError if the film moved so far that
    the orders are not certain.
    """
    change_rad = np.angle(np.exp(1j * (view.phase_rad - anchor.phase_rad)))
    seen = view.mask & np.isfinite(anchor.phase_rad).all(axis=0)
    lost = 1.0
    if seen.any():
        largest_rad = np.abs(change_rad[:, seen]).max(axis=0)
        lost = float(np.mean(largest_rad > _GUARD_RAD))
    if lost > _LOST_SHARE:
        raise bin_view.NoFigureError(
            f"the phase moved by half a period from the reference at {lost:.0%} of the points"
        )
    return np.where(seen, anchor.phase_rad + change_rad, np.nan)


def confirm_orders(
    stack: frame_stack.FrameStack,
    phase_rad: FloatArray,
    binned: frame_stack.Binned,
    view: bin_view.BinView,
    excluded: set[int],
    flags: tuple[frame_faults.Flag, ...],
) -> None:
    """Raise RejectedSetError if Gray frames are excluded and the others allow other orders, too.

    Parameters
    ----------
    stack, binned, view : FrameStack, Binned, BinView
        The set.
    phase_rad : (2, rows, columns) array
        Absolute phases, with the orders as chosen.
    excluded : set of int
        Frames that do not belong to the set.
    flags : tuple of Flag
        For the error.
    """
    for k, axis in enumerate(AXES):
        gray = stack.gray(axis)
        good = [bit for bit, frame in enumerate(gray, start=1) if frame not in excluded]
        if not gray or len(good) == len(gray):
            continue
        seen = np.isfinite(phase_rad[k])
        phase = phase_rad[k][seen]
        bits = {bit: (binned.means[gray[bit - 1]] > view.light)[seen] for bit in good}
        explained = [
            shift for shift in _OTHER_ORDERS if _explain_bits(phase + 2 * math.pi * shift, bits)
        ]
        if explained != [0]:
            raise RejectedSetError(
                f"the {axis} fringe orders are not certain without all Gray frames", flags
            )


def _explain_bits(phase_rad: FloatArray, bits: dict[int, BoolArray]) -> bool:
    """Whether these orders lie in the pattern and show these bits, away from the bits' edges."""
    if np.min(phase_rad) < _LEAST_PHASE_RAD or np.max(phase_rad) > _LARGEST_PHASE_RAD:
        return False
    for bit, seen in bits.items():
        shown, from_edge_rad = gray_bit(phase_rad, bit)
        sure = from_edge_rad > _EDGE_RAD
        if np.mean(shown[sure] != seen[sure]) > _BIT_MISMATCH:
            return False
    return bool(bits)
