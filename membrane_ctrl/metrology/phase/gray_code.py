"""Fringe orders and absolute phase from a complementary Gray code (the paper's eq. 2).

The wrapped phase starts at -pi on each period's low edge, so that the order K1 = floor(s / T)
jumps exactly where the phase does and is unreliable there. K2, from the last bit, jumps half a
period away. Eq. 2 uses K2 near the ends of a period and K1 in the middle: each is used only where
it is a quarter period away from its jumps.
"""

import math

import numpy as np

from membrane_ctrl.model.arrays import ArrayLike, BoolArray, FloatArray, IntArray


def gray_orders(gray: ArrayLike, white: ArrayLike, black: ArrayLike) -> tuple[IntArray, IntArray]:
    """Fringe orders from the Gray-code frames.

    Parameters
    ----------
    gray : (n, ...) array
        Intensities of the bits, most significant first; the last is for half a period.
    white, black : (...) array
        Highest and lowest level at each pixel; the threshold is their mean, pixel by pixel.

    Returns
    -------
    k1, k2 : (...) int arrays
        floor(s / T) from all bits but the last, and floor((V2 + 1) / 2) from all, V2 = floor(2 s /
        T).
    """
    # Integers are averaged as numbers with fractions; single precision holds every camera's levels.
    kind = np.result_type(np.asarray(white), np.float32)
    threshold = (np.asarray(white, kind) + np.asarray(black, kind)) / 2
    return code_orders(np.asarray(gray) > threshold)


def code_orders(bits: BoolArray) -> tuple[IntArray, IntArray]:
    """Fringe orders from Gray bits.

    Parameters
    ----------
    bits : (n, ...) bool array
        Of any number, most significant first; the last is for half a period.

    Returns
    -------
    k1, k2 : (...) int arrays
        As `gray_orders`.
    """
    # Each binary digit is the exclusive or of all Gray bits down to it.
    digit = np.zeros(bits.shape[1:], bool)
    half_periods = np.zeros(bits.shape[1:], np.int32)
    for bit in bits:
        digit ^= bit
        half_periods *= 2
        half_periods += digit
    return half_periods >> 1, (half_periods + 1) >> 1


def absolute_phase(wrapped_rad: FloatArray, k1: IntArray, k2: IntArray) -> FloatArray:
    """Absolute phase from wrapped phase and fringe orders (paper, eq. 2).

    Parameters
    ----------
    wrapped_rad : (...) array
        Phase in (-pi, pi].
    k1, k2 : (...) int arrays
        The orders of `gray_orders`.

    Returns
    -------
    (...) array
        In rad, counted from -pi at the low edge.
    """
    near_low_end = wrapped_rad <= -math.pi / 2
    near_high_end = wrapped_rad >= math.pi / 2

    # Each order is used a quarter period away from its own jumps: K2, which jumps in the middle of
    # a period, near the ends; K1, which jumps at the ends, in the middle.
    order = np.where(near_high_end, k2 - 1, k1)
    order = np.where(near_low_end, k2, order)
    return wrapped_rad + 2 * math.pi * order


def gray_bit(phase_rad: FloatArray, bit: int) -> tuple[BoolArray, FloatArray]:
    """What one Gray frame shows at an absolute phase, and how far that is from an edge.

    With s / T = (phase + pi) / (2 pi) and V2 = floor(2 s / T), bit b of the code changes at V2 =
    2^(4 - b) times an odd number.

    Parameters
    ----------
    phase_rad : (...) array
        Absolute phase.
    bit : int
        Number of the Gray frame, 1 to 4.

    Returns
    -------
    shown : (...) bool array
        Whether the frame is bright there.
    from_edge_rad : (...) array
        Distance to where the bit changes.
    """
    # The half period V2 at the phase, its Gray code, and the bit of this frame in it.
    half_periods = (phase_rad + math.pi) / math.pi
    v2 = np.floor(np.nan_to_num(half_periods)).astype(np.int64)
    gray = v2 ^ (v2 >> 1)
    shown = (gray >> (4 - bit)) & 1

    # The bit changes at odd multiples of this spacing, in half periods.
    spacing = 2 ** (4 - bit)
    from_edge = np.abs(half_periods % (2 * spacing) - spacing)
    return shown.astype(bool), from_edge * math.pi
