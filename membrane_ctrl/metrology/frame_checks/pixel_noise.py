"""Noise of the pixels, by what the phase steps of a set leave.

A sinusoid has three unknowns, so that N steps leave N - 3 numbers of each pixel. They contain the
noise, and also what a whole picture has in common: harmonics of the fringes, by the response of
panel and camera (a gamma of 2.2 makes one of 15 % of the light), and a frame whose light differs
or whose film has moved. These are fitted over the picture and removed; the rest is noise.
"""

import math
from collections.abc import Sequence

import numpy as np

from membrane_ctrl.metrology.phase.frame_stack import FrameStack
from membrane_ctrl.model.arrays import FloatArray, IntArray

_HARMONICS = (2, 3, 4)  # of the fringes
_SAMPLES = 20_000  # pixels: the noise is then known to half a per cent
_SINGULAR = 1e-9  # share of the largest eigenvalue below which columns are the same


def estimate_pixel_noise_adu(
    stack: FrameStack, used: Sequence[list[int]], index: IntArray
) -> float:
    """Estimate the standard deviation of a pixel in one frame.

    Parameters
    ----------
    stack : FrameStack
        The set.
    used : two lists of int
        The used sinusoids of x and of y.
    index : (n,) int array
        Pixels that see the fringes, counted row by row.

    Returns
    -------
    float
        In ADU; NaN for three steps, which leave nothing.
    """
    # N steps leave N - 3 numbers of a pixel that level, contrast and phase do not explain.
    freedom = sum(len(frames) - 3 for frames in used)
    if freedom == 0 or index.size == 0:
        return math.nan

    # Squares of what the steps leave, of some pixels; the median is robust to dust and motion.
    some = index[:: max(1, index.size // _SAMPLES)]
    row, column = np.divmod(some, stack.size_px[1])
    squares = np.zeros(some.size)
    for frames in used:
        if len(frames) > 3:
            squares += _take_squares(stack, frames, row, column)
    return float(np.sqrt(np.median(squares) / freedom))


def _take_squares(
    stack: FrameStack, frames: list[int], row: IntArray, column: IntArray
) -> FloatArray:
    """Sum of squares (n,) of what the steps of one axis leave, less what pixels have in common."""
    seen = np.stack([_take_pixels(stack, frame, row, column) for frame in frames])

    # What the steps leave: the part that is orthogonal to level, cosine and sine.
    design = stack.design(frames)
    orthogonal = np.linalg.svd(design)[0][:, 3:].T
    level, cosine, sine = np.linalg.pinv(design) @ seen
    left = orthogonal @ seen

    # Columns of what the whole picture has in common.
    psi_rad = np.arctan2(sine, cosine) + stack.shifts_rad(frames)[:, None]
    wave = np.hypot(cosine, sine) * np.exp(1j * psi_rad)
    unit = np.exp(1j * psi_rad)
    places = [np.ones(row.size), _centre_places(row), _centre_places(column)]
    columns = []
    for order in _HARMONICS:
        harmonic = orthogonal @ (wave * unit ** (order - 1))
        columns += [part * place for part in (harmonic.real, harmonic.imag) for place in places]
    for k, weight in enumerate(orthogonal.T):
        fringes = [part * place for part in (wave[k].real, wave[k].imag) for place in places]
        columns += [weight[:, None] * part for part in (level, *fringes)]

    # Least squares for their amplitudes; columns of unit length.
    table = np.stack([column.ravel() for column in columns])
    length = np.linalg.norm(table, axis=1, keepdims=True)
    table = table[length[:, 0] > _SINGULAR * length.max()]
    table /= np.linalg.norm(table, axis=1, keepdims=True)
    inverse = np.linalg.pinv(table @ table.T, _SINGULAR, hermitian=True)
    rest = left.ravel() - (inverse @ (table @ left.ravel())) @ table
    return np.asarray(np.sum(np.square(rest.reshape(left.shape)), axis=0))


def _take_pixels(stack: FrameStack, frame: int, row: IntArray, column: IntArray) -> FloatArray:
    """Light (n,) of a frame without that of the previous picture, and without bands."""
    seen: FloatArray = stack.frames[frame, row, column].astype(float)
    previous = stack.frame_before(frame)
    if any(stack.lag_shares) and previous >= 0:
        rise, fall = (share / (1 - share) for share in stack.lag_shares)
        more = seen - stack.frames[previous, row, column]
        seen += np.where(more > 0, rise, fall) * more
    if stack.gain is not None:
        seen = seen / stack.gain[frame, row]
    return seen


def _centre_places(place_px: IntArray) -> FloatArray:
    """Places from -1 to 1."""
    middle = (place_px.min() + place_px.max()) / 2
    return np.asarray((place_px - middle) / max(place_px.max() - middle, 1.0))
