"""A full cycle's images to absolute phases: the paper's section 2.2 on any stack, of pixels or of bins."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.config import PatternConfig
from membrane_ctrl.metrology.patterns import GRAY_BITS
from membrane_ctrl.metrology.phase import modulation, phasors, wrapped_phase
from membrane_ctrl.metrology.unwrap import absolute_phase, gray_orders, inside_pattern

FloatArray = NDArray[np.float64]

# A pixel sees the screen in the mirror if white differs from black by this share of what the bright pixels show;
# the rest of the room differs by stray light only.
CONTRAST_SHARE = 0.2
# ... and if the fringes swing by this share of it: less is a blurred edge, dust or a mixture of two places.
FRINGE_SHARE = 0.1


@dataclass(frozen=True)
class FullSlots:
    """Where the images of a full cycle stand in its sequence."""

    steps: int

    @property
    def sinusoids(self) -> tuple[slice, slice]:
        """x and y."""
        second = self.steps + GRAY_BITS
        return slice(0, self.steps), slice(second, second + self.steps)

    @property
    def gray(self) -> tuple[slice, slice]:
        """x and y."""
        return tuple(slice(s.stop, s.stop + GRAY_BITS) for s in self.sinusoids)  # type: ignore[return-value]

    @property
    def white(self) -> int:
        """Highest level."""
        return 2 * (self.steps + GRAY_BITS)

    @property
    def black(self) -> int:
        """Lowest level."""
        return self.white + 1

    @property
    def count(self) -> int:
        """All images."""
        return self.black + 1


@dataclass(frozen=True)
class Decoded:
    """Absolute phases of a full cycle.

    Attributes
    ----------
    phase_rad : (2, ...) array
        x and y, counted from the low edge's -pi (see `unwrap`); NaN where not valid.
    modulation_adu : (2, ...) array
        Fringe amplitude.
    valid : (...) bool array
        Pixels that see the pattern in the mirror.
    """

    phase_rad: FloatArray
    modulation_adu: FloatArray
    valid: NDArray[np.bool_]


def decode_full(images: FloatArray, pattern: PatternConfig, shifts_rad: FloatArray) -> Decoded:
    """Decode the images of a full cycle (2 (N + 4) + 2, ...), in `patterns.full_sequence`'s order.

    Parameters
    ----------
    shifts_rad : (2, N) array
        Phase steps of x and y.

    Raises
    ------
    ValueError
        If there are more or fewer images.
    """
    slots = FullSlots(pattern.steps)
    if len(images) != slots.count:
        raise ValueError(f"a full cycle has {slots.count} frames, not {len(images)}")
    white, black = images[slots.white], images[slots.black]
    contrast = white - black
    valid = contrast > CONTRAST_SHARE * np.percentile(contrast, 95)
    phases, swings = [], []
    for sinusoids, gray, shifts in zip(slots.sinusoids, slots.gray, shifts_rad, strict=True):
        z = phasors(images[sinusoids], shifts)
        k1, k2 = gray_orders(images[gray], white, black)
        phase = absolute_phase(wrapped_phase(z), k1, k2)
        swing = modulation(z)
        valid &= (swing > FRINGE_SHARE * contrast) & inside_pattern(phase, pattern)
        phases.append(phase)
        swings.append(swing)
    absolute = np.stack(phases)
    absolute[:, ~valid] = np.nan
    return Decoded(absolute, np.stack(swings), valid)
