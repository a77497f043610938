"""Wrapped phase and modulation from N phase steps, equal or not (the paper's eq. 1 for N = 4).

Each frame is I_k = A + B cos(phi + d_k) = A + C cos d_k - S sin d_k with C = B cos phi and S = B sin phi: linear
in (A, C, S). Where the light of the frames is known to differ, frame k is l_k A + b_k B cos(phi + d_k), with its
level l_k and its swing b_k about 1. Least squares over the frames is one fixed 3 x N matrix for all pixels. For equal
steps it is C = 2/N sum I cos d, S = -2/N sum I sin d, and for N = 4 S : C = (I4 - I2) : (I1 - I3), the paper's
formula.

The phasor C + iS is linear in the intensities: sums over pixels may be taken before the arctangent, which weighs
each pixel by its modulation and never meets a phase jump.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from firmware_iface.roles import Pattern
from membrane_ctrl.config.schema import PatternConfig
from membrane_ctrl.model.arrays import ArrayLike, BoolArray, ComplexArray, FloatArray, IntArray


def step_design(shifts_rad: Sequence[float] | FloatArray, light: FloatArray | None = None) -> FloatArray:
    """Rows (N, 3) that turn A, C and S of a pixel into its intensities: [l, b cos d, -b sin d].

    `light` (2, N) has the level l and the swing b of each frame; 1 by default.
    """
    shifts = np.asarray(shifts_rad, float)
    level, swing = np.ones((2, shifts.size)) if light is None else light
    return np.stack([level, swing * np.cos(shifts), -swing * np.sin(shifts)], axis=1)


def step_weights(shifts_rad: Sequence[float] | FloatArray, light: FloatArray | None = None) -> FloatArray:
    """Rows (3, N) that turn the N intensities of a pixel into A, C and S: pseudo-inverse of `step_design`.

    The phase steps (N,) may have any order and spacing. Raises ValueError if they do not determine a phase (fewer
    than three different ones on the circle).
    """
    design = step_design(shifts_rad, light)
    # a condition number beyond this multiplies the noise of the phase a hundredfold
    if len(design) < 3 or np.linalg.cond(design) > 100:
        raise ValueError(f"phase steps {np.round(shifts_rad, 3).tolist()} rad do not determine a phase")
    return np.asarray(np.linalg.pinv(design), np.float64)


def equal_shifts(steps: int) -> FloatArray:
    """The N equal steps 2 pi k / N."""
    return 2 * math.pi * np.arange(steps) / steps


def phasors(frames: ArrayLike, shifts_rad: Sequence[float] | FloatArray) -> ComplexArray:
    """Phasor C + iS per pixel from a stack of frames (N, ...): its angle is the phase, its length the amplitude B."""
    stack = np.asarray(frames, float)
    _, cosine, sine = step_weights(shifts_rad)
    out = np.empty(stack.shape[1:], np.complex128)
    out.real = np.einsum("k,k...->...", cosine, stack)
    out.imag = np.einsum("k,k...->...", sine, stack)
    return out


def step_residual(frames: ArrayLike, shifts_rad: Sequence[float] | FloatArray) -> FloatArray:
    """Residual of each frame after the model A + B cos(phi + d_k), (N, ...): zero but for noise if all is well."""
    stack = np.asarray(frames, float)
    projector = np.eye(len(stack)) - step_design(shifts_rad) @ step_weights(shifts_rad)
    return np.asarray(np.tensordot(projector, stack, axes=1))


def phase_sigma_rad(shifts_rad: Sequence[float] | FloatArray, noise_adu: float, modulation_adu: float) -> float:
    """Standard deviation of the phase for white noise in the frames; mean over the phase.

    The phasor's components have the variances sigma^2 sum w^2; across the phasor, averaged over its direction, half
    their sum is left. For N equal steps: sigma sqrt(2 / N) / B.
    """
    _, cosine, sine = step_weights(shifts_rad)
    return noise_adu * math.sqrt(float(cosine @ cosine + sine @ sine) / 2) / modulation_adu


# Absolute phase: complementary Gray code (the paper's eq. 2), and its distance on the screen from O'.
#
# The wrapped phase starts at -pi on each period's low edge, so that the order K1 = floor(s / T) jumps exactly where
# the phase does and cannot be trusted there. K2, from the fourth bit, jumps half a period away: eq. 2 takes K2 near
# the ends of a period and K1 in the middle, and each is used only where it is a quarter period away from its jumps.


def gray_orders(gray: ArrayLike, white: ArrayLike, black: ArrayLike) -> tuple[IntArray, IntArray]:
    """Fringe orders from the Gray-code frames.

    Parameters
    ----------
    gray : (4, ...) array
        Intensities of the bits, most significant first.
    white, black : (...) array
        Highest and lowest level at each pixel; the threshold is their mean, pixel by pixel.

    Returns
    -------
    k1, k2 : (...) int arrays
        floor(s / T) from bits 1-3 and floor((V2 + 1) / 2) from all four, V2 = floor(2 s / T).
    """
    threshold = (np.asarray(white, float) + np.asarray(black, float)) / 2
    return code_orders(np.asarray(gray, float) > threshold)


def code_orders(bits: BoolArray) -> tuple[IntArray, IntArray]:
    """The same from the bits (4, ...)."""
    binary = np.bitwise_xor.accumulate(bits.astype(np.int64), axis=0)  # each bit is the xor of all above it
    k1 = 4 * binary[0] + 2 * binary[1] + binary[2]
    return k1, (2 * k1 + binary[3] + 1) // 2


def absolute_phase(wrapped_rad: FloatArray, k1: IntArray, k2: IntArray) -> FloatArray:
    """The paper's eq. 2: phase counted from the low edge's -pi."""
    order = np.where(wrapped_rad <= -math.pi / 2, k2, np.where(wrapped_rad >= math.pi / 2, k2 - 1, k1))
    return wrapped_rad + 2 * math.pi * order


def centre_phase_rad(pattern: PatternConfig) -> float:
    """Absolute phase at O': there s is half the region, where phi = 2 pi s / T - pi gives pi (periods - 1)."""
    return math.pi * (pattern.periods - 1)


def mm_per_rad(pattern: PatternConfig) -> float:
    """T / (2 pi)."""
    return pattern.period_mm / (2 * math.pi)


def screen_mm(absolute_rad: FloatArray, pattern: PatternConfig) -> FloatArray:
    """Distance from O' on the screen, the paper's O'A = T phi / (2 pi) with phi relative to O'."""
    return (absolute_rad - centre_phase_rad(pattern)) * mm_per_rad(pattern)


def inside_pattern(absolute_rad: FloatArray, pattern: PatternConfig) -> BoolArray:
    """Whether the phase lies in the pattern; one from a wrong Gray bit at its rim does not."""
    return np.abs(absolute_rad - centre_phase_rad(pattern)) <= math.pi * pattern.periods


# The images of a measurement cycle, in their order on the screen and in the memory.
#
# A full cycle is, for x and then for y, N sinusoids and 4 Gray-code bits, then white and black: 18 images for N = 4.
# A fringes-only cycle is the 2 N sinusoids, x first.

GRAY_BITS = 4  # 16 half periods: enough for the 8 periods a configuration may ask for
AXES = ("x", "y")


def sinusoids(axis: str, steps: int) -> tuple[Pattern, ...]:
    """The N phase steps of one axis: I = A + B cos(phi + 2 pi k / N), k = 0..N-1 (N = 4: the paper's eq. 1)."""
    return tuple(Pattern("sin", axis, k, 2 * math.pi * k / steps) for k in range(steps))


def gray_codes(axis: str) -> tuple[Pattern, ...]:
    """The Gray-code bits of one axis, most significant first; bits count from 1."""
    return tuple(Pattern("gray", axis, bit) for bit in range(1, GRAY_BITS + 1))


def full_sequence(pattern: PatternConfig) -> tuple[Pattern, ...]:
    """All images of a full cycle: 2 (N + 4) + 2."""
    by_axis = (image for axis in AXES for image in (*sinusoids(axis, pattern.steps), *gray_codes(axis)))
    return (*by_axis, Pattern("white"), Pattern("black"))


def fringe_sequence(pattern: PatternConfig) -> tuple[Pattern, ...]:
    """The images of a fringes-only cycle: 2 N."""
    return tuple(image for axis in AXES for image in sinusoids(axis, pattern.steps))


# A pixel sees the screen in the mirror if white differs from black by this share of what the bright pixels show; the
# rest of the room differs by stray light only.
CONTRAST_SHARE = 0.2
# ... and if the fringes swing by this share of it: less is a blurred edge, dust or a mixture of two places.
FRINGE_SHARE = 0.1


@dataclass(frozen=True)
class FullSlots:
    """Positions of the images in the sequence of a full cycle."""

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


def decode_full(images: FloatArray, pattern: PatternConfig, shifts_rad: FloatArray) -> FloatArray:
    """Absolute phases of x and y (2, ...), counted from the low edge's -pi; NaN where the pattern is not seen.

    `images` (2 (N + 4) + 2, ...) are in the order of `full_sequence`, `shifts_rad` (2, N) the phase steps of x and y.
    Raises ValueError if there are more or fewer images.
    """
    slots = FullSlots(pattern.steps)
    if len(images) != slots.count:
        raise ValueError(f"a full cycle has {slots.count} frames, not {len(images)}")
    white, black = images[slots.white], images[slots.black]
    contrast = white - black
    valid = contrast > CONTRAST_SHARE * np.percentile(contrast, 95)
    phases = []
    for sinusoids, gray, shifts in zip(slots.sinusoids, slots.gray, shifts_rad, strict=True):
        z = phasors(images[sinusoids], shifts)
        k1, k2 = gray_orders(images[gray], white, black)
        phases.append(absolute_phase(np.angle(z), k1, k2))
        valid &= (np.abs(z) > FRINGE_SHARE * contrast) & inside_pattern(phases[-1], pattern)
    return np.where(valid, np.stack(phases), np.nan)
