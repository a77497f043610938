"""Whether the Gray frames that are left determine the fringe orders of a set."""

import math

import numpy as np

from membrane_ctrl.metrology.frame_checks import bin_view, frame_faults
from membrane_ctrl.metrology.frame_checks.checked_set import RejectedSetError
from membrane_ctrl.metrology.phase import frame_stack
from membrane_ctrl.metrology.phase.gray_code import gray_bit
from membrane_ctrl.metrology.phase.pattern_sequence import AXES
from membrane_ctrl.model.arrays import BoolArray, FloatArray

# Share of a bit's bins that may contradict the orders: no other set of orders explains so many.
_BIT_MISMATCH = 0.02
_EDGE_RAD = 0.5  # bins nearer to a bit's edge than this are not compared
# Absolute phases of the code: eight periods from -pi, and half a period beyond at each end.
_LEAST_PHASE_RAD = -1.5 * math.pi
_LARGEST_PHASE_RAD = 15.5 * math.pi
_OTHER_ORDERS = range(-7, 8)  # shifts of all orders that are tried, in periods


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
        # Axes of which a Gray frame was left out.
        gray = stack.gray(axis)
        good = [bit for bit, frame in enumerate(gray, start=1) if frame not in excluded]
        if not gray or len(good) == len(gray):
            continue
        # Shifts of all orders by whole periods that the remaining bits allow as well.
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
