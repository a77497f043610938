"""The images of a measurement cycle, in their order on the screen and in memory.

A full cycle is, for x and then for y, N sinusoids and 4 Gray-code bits, then white and black: 18
images for N = 4. A fringes-only cycle is the 2 N sinusoids, x first.
"""

import math

from firmware_iface.optical_roles import Pattern
from membrane_ctrl.config.schema import PatternConfig

GRAY_BITS = 4  # 16 half periods: enough for the 8 periods a configuration may ask for
AXES = ("x", "y")


def sinusoid_patterns(axis: str, steps: int) -> tuple[Pattern, ...]:
    """Return the phase steps of one axis: I = A + B cos(phi + 2 pi k / N), k = 0..N-1.

    For N = 4 they are the paper's (eq. 1).

    Parameters
    ----------
    axis : str
        "x" or "y".
    steps : int
        N.
    """
    return tuple(Pattern("sin", axis, k, 2 * math.pi * k / steps) for k in range(steps))


def gray_codes(axis: str) -> tuple[Pattern, ...]:
    """The Gray-code bits of one axis, most significant first; bits count from 1."""
    return tuple(Pattern("gray", axis, bit) for bit in range(1, GRAY_BITS + 1))


def full_sequence(pattern: PatternConfig) -> tuple[Pattern, ...]:
    """All images of a full cycle: 2 (N + 4) + 2."""
    images: list[Pattern] = []
    for axis in AXES:
        images += sinusoid_patterns(axis, pattern.steps)
        images += gray_codes(axis)
    return (*images, Pattern("white"), Pattern("black"))


def fringe_sequence(pattern: PatternConfig) -> tuple[Pattern, ...]:
    """The images of a fringes-only cycle: 2 N."""
    return tuple(image for axis in AXES for image in sinusoid_patterns(axis, pattern.steps))


class FullSlots:
    """Positions of the images in the sequence of a full cycle.

    Parameters
    ----------
    steps : int
        Phase steps of an axis, N.

    Attributes
    ----------
    count : int
        Images of the cycle, 2 (N + 4) + 2.
    sinusoids, gray : (slice, slice)
        Of x and of y.
    white, black : int
    """

    def __init__(self, steps: int) -> None:
        second = steps + GRAY_BITS  # where the y frames begin
        self.steps = steps
        self.count = 2 * second + 2
        self.sinusoids = slice(0, steps), slice(second, second + steps)  # of x and y
        self.gray = slice(steps, second), slice(second + steps, 2 * second)
        self.white = 2 * second
        self.black = 2 * second + 1
