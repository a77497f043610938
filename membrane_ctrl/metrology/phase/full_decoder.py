"""Absolute phases of x and y from the images of a full cycle."""

import numpy as np

from membrane_ctrl.config.schema import PatternConfig
from membrane_ctrl.metrology.phase.gray_code import absolute_phase, gray_orders
from membrane_ctrl.metrology.phase.pattern_sequence import FullSlots
from membrane_ctrl.metrology.phase.phase_steps import compute_phasors
from membrane_ctrl.metrology.phase.screen_scale import inside_pattern
from membrane_ctrl.model.arrays import FloatArray, Singles

# A pixel sees the screen in the mirror if white differs from black by this share of what the bright
# pixels show; the rest of the room differs by stray light only.
CONTRAST_SHARE = 0.2
_BRIGHTEST_PERCENTILE = 95  # what counts as bright
_ENOUGH_PIXELS = 20_000  # for that percentile
# The fringes must swing by this share of white less black, too: less is a blurred edge, dust or a
# mixture of two places.
FRINGE_SHARE = 0.1


def decode_full(
    images: FloatArray | Singles, pattern: PatternConfig, shifts_rad: FloatArray
) -> FloatArray:
    """Absolute phases of x and y from the images of a full cycle (eq. 1 and 2).

    Parameters
    ----------
    images : (2 (N + 4) + 2, ...) array
        In the order of `pattern_sequence.full_sequence`.
    pattern : PatternConfig
        The pattern.
    shifts_rad : (2, N) array
        Phase steps of x and y.

    Returns
    -------
    (2, ...) array
        In rad, counted from -pi at the low edge; NaN where the pattern is not seen.

    Raises
    ------
    ValueError
        There are more or fewer images.
    """
    slots = FullSlots(pattern.steps)
    if len(images) != slots.count:
        raise ValueError(f"a full cycle has {slots.count} frames, not {len(images)}")
    # Pixels that see the screen, by the difference of white and black.
    white = images[slots.white]
    black = images[slots.black]
    contrast = white - black
    stride = max(1, contrast.size // _ENOUGH_PIXELS)
    bright = np.percentile(contrast.ravel()[::stride], _BRIGHTEST_PERCENTILE)
    valid = contrast > CONTRAST_SHARE * bright

    # Of each axis: wrapped phase (paper, eq. 1), fringe orders, absolute phase (paper, eq. 2).
    phases = []
    for sinusoids, gray, shifts in zip(slots.sinusoids, slots.gray, shifts_rad, strict=True):
        phasor = compute_phasors(images[sinusoids], shifts)
        k1, k2 = gray_orders(images[gray], white, black)
        phase_rad = absolute_phase(np.angle(phasor), k1, k2)
        phases.append(phase_rad)
        has_fringes = np.abs(phasor) > FRINGE_SHARE * contrast
        valid &= has_fringes & inside_pattern(phase_rad, pattern)
    return np.where(valid, np.stack(phases), np.nan)
