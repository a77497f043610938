"""Absolute phases of x and y from the images of a full cycle."""

import numpy as np

from membrane_ctrl.config.schema import PatternConfig
from membrane_ctrl.metrology.phase.gray_code import absolute_phase, gray_orders
from membrane_ctrl.metrology.phase.pattern_sequence import FullSlots
from membrane_ctrl.metrology.phase.phase_steps import compute_phasors
from membrane_ctrl.metrology.phase.screen_scale import inside_pattern
from membrane_ctrl.model.arrays import FloatArray

# A pixel sees the screen in the mirror if white differs from black by this share of what the bright
# pixels show; the rest of the room differs by stray light only.
CONTRAST_SHARE = 0.2
# ... and if the fringes swing by this share of it: less is a blurred edge, dust or a mixture of two
# places.
FRINGE_SHARE = 0.1


def decode_full(images: FloatArray, pattern: PatternConfig, shifts_rad: FloatArray) -> FloatArray:
    """Absolute phases of x and y (2, ...), counted from the low edge's -pi; NaN where the pattern
    is not seen.

    `images` (2 (N + 4) + 2, ...) are in the order of `full_sequence`, `shifts_rad` (2, N) the phase
    steps of x and y. Raises ValueError if there are more or fewer images.
    """
    slots = FullSlots(pattern.steps)
    if len(images) != slots.count:
        raise ValueError(f"a full cycle has {slots.count} frames, not {len(images)}")
    white, black = images[slots.white], images[slots.black]
    contrast = white - black
    valid = contrast > CONTRAST_SHARE * np.percentile(contrast, 95)
    phases = []
    for sinusoids, gray, shifts in zip(slots.sinusoids, slots.gray, shifts_rad, strict=True):
        z = compute_phasors(images[sinusoids], shifts)
        k1, k2 = gray_orders(images[gray], white, black)
        phases.append(absolute_phase(np.angle(z), k1, k2))
        valid &= (np.abs(z) > FRINGE_SHARE * contrast) & inside_pattern(phases[-1], pattern)
    return np.where(valid, np.stack(phases), np.nan)
