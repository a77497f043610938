"""Wrapped phase and modulation from N phase steps, equal or not (the paper's eq. 1 for N = 4).

Each frame is I_k = A + B cos(phi + d_k) = A + C cos d_k - S sin d_k with C = B cos phi and S = B
sin phi: linear in (A, C, S). Where the light of the frames is known to differ, frame k is l_k A +
b_k B cos(phi + d_k), with its level l_k and its swing b_k about 1. Least squares over the frames is
one fixed 3 x N matrix for all pixels. For equal steps it is C = 2/N sum I cos d, S = -2/N sum I sin
d, and for N = 4 S : C = (I4 - I2) : (I1 - I3), the paper's formula.

The phasor C + iS is linear in the intensities: sums over pixels may be taken before the arctangent,
which weighs each pixel by its modulation and never meets a phase jump.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from firmware_iface.roles import Pattern
from membrane_ctrl.config.schema import PatternConfig
from membrane_ctrl.model.arrays import ArrayLike, BoolArray, ComplexArray, FloatArray, IntArray


def step_design(
    shifts_rad: Sequence[float] | FloatArray, light: FloatArray | None = None
) -> FloatArray:
    """Rows (N, 3) that turn A, C and S of a pixel into its intensities: [l, b cos d, -b sin d].

    `light` (2, N) has the level l and the swing b of each frame; 1 by default.
    """
    shifts = np.asarray(shifts_rad, float)
    level, swing = np.ones((2, shifts.size)) if light is None else light
    return np.stack([level, swing * np.cos(shifts), -swing * np.sin(shifts)], axis=1)


def step_weights(
    shifts_rad: Sequence[float] | FloatArray, light: FloatArray | None = None
) -> FloatArray:
    """Rows (3, N) that turn the N intensities of a pixel into A, C and S: pseudo-inverse of
    `step_design`.

    The phase steps (N,) may have any order and spacing. Raises ValueError if they do not determine
    a phase (fewer than three different ones on the circle).
    """
    design = step_design(shifts_rad, light)
    # a condition number beyond this multiplies the noise of the phase a hundredfold
    if len(design) < 3 or np.linalg.cond(design) > 100:
        raise ValueError(
            f"phase steps {np.round(shifts_rad, 3).tolist()} rad do not determine a phase"
        )
    return np.asarray(np.linalg.pinv(design), np.float64)


def equal_shifts(steps: int) -> FloatArray:
    """The N equal steps 2 pi k / N."""
    return 2 * math.pi * np.arange(steps) / steps


def phasors(frames: ArrayLike, shifts_rad: Sequence[float] | FloatArray) -> ComplexArray:
    """Phasor C + iS per pixel from a stack of frames (N, ...): its angle is the phase, its length
    the amplitude B.
    """
    stack = np.asarray(frames, float)
    _, cosine, sine = step_weights(shifts_rad)
    out = np.empty(stack.shape[1:], np.complex128)
    out.real = np.einsum("k,k...->...", cosine, stack)
    out.imag = np.einsum("k,k...->...", sine, stack)
    return out


def step_residual(frames: ArrayLike, shifts_rad: Sequence[float] | FloatArray) -> FloatArray:
    """Residual of each frame after the model A + B cos(phi + d_k), (N, ...): zero but for noise if
    all is well.
    """
    stack = np.asarray(frames, float)
    projector = np.eye(len(stack)) - step_design(shifts_rad) @ step_weights(shifts_rad)
    return np.asarray(np.tensordot(projector, stack, axes=1))


def phase_sigma_rad(
    shifts_rad: Sequence[float] | FloatArray, noise_adu: float, modulation_adu: float
) -> float:
    """Standard deviation of the phase for white noise in the frames; mean over the phase.

    The phasor's components have the variances sigma^2 sum w^2; across the phasor, averaged over its
    direction, half their sum is left. For N equal steps: sigma sqrt(2 / N) / B.
    """
    _, cosine, sine = step_weights(shifts_rad)
    return noise_adu * math.sqrt(float(cosine @ cosine + sine @ sine) / 2) / modulation_adu


# Absolute phase: complementary Gray code (the paper's eq. 2), and its distance on the screen from
# O'.
#
# The wrapped phase starts at -pi on each period's low edge, so that the order K1 = floor(s / T)
# jumps exactly where the phase does and cannot be trusted there. K2, from the fourth bit, jumps
# half a period away: eq. 2 takes K2 near the ends of a period and K1 in the middle, and each is
# used only where it is a
# quarter period away
# from its jumps.


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
    threshold = (np.asarray(white, float) + np.asarray(black, float)) / 2
    return code_orders(np.asarray(gray, float) > threshold)


def code_orders(bits: BoolArray) -> tuple[IntArray, IntArray]:
    """The same from bits (n, ...) of any number, the last of them for half a period."""
    binary = np.bitwise_xor.accumulate(
        bits.astype(np.int64), axis=0
    )  # each bit is the xor of all above it
    half_periods = np.tensordot(1 << np.arange(len(binary))[::-1], binary, axes=1)
    return half_periods // 2, (half_periods + 1) // 2


def absolute_phase(wrapped_rad: FloatArray, k1: IntArray, k2: IntArray) -> FloatArray:
    """The paper's eq. 2: phase counted from the low edge's -pi."""
    order = np.where(
        wrapped_rad <= -math.pi / 2, k2, np.where(wrapped_rad >= math.pi / 2, k2 - 1, k1)
    )
    return wrapped_rad + 2 * math.pi * order


# Frames of other benches (docs/how-to/library.md): fringes of several periods, and fringes of both
# axes in one frame.


@dataclass(frozen=True)
class Places:
    """Places on the screen from phases of several periods."""

    place_mm: (
        FloatArray  # (...): NaN where the phases contradict each other, or fit two places alike
    )
    # (...): chi-square of the phases there, a number near F - 1 if `sigma_rad` is right
    misfit: FloatArray


def places_mm(
    wrapped_rad: FloatArray,
    periods_mm: Sequence[float] | FloatArray,
    range_mm: tuple[float, float],
    sigma_rad: float = 0.1,
) -> Places:
    """Places that explain wrapped phases of any two or more periods, which need not be multiples of
    each other.

    Every order of the shortest period within the range is tried; the others choose. The place is
    then the least squares of all. It is NaN unless its chi-square is believable (below F - 1 + 25)
    and 25 better than that of every place more than half a shortest period away: five sigma.

    Parameters
    ----------
    wrapped_rad : (F, ...) array
        Phases, zero (or any multiple of 2 pi) at place 0, growing with the place; any branch.
    periods_mm : (F,) array
        In any order.
    range_mm : (float, float)
        Where on the screen to look.
    sigma_rad : float
        1 sigma of a phase, noise and the display's harmonics together.

    Raises ValueError for fewer than two periods, periods that do not match the phases, or an empty
    range.
    """
    periods = np.asarray(periods_mm, float)
    low, high = range_mm
    if (
        periods.shape != (len(wrapped_rad),)
        or periods.size < 2
        or not (periods > 0).all()
        or not high > low
    ):
        raise ValueError(
            f"{len(wrapped_rad)} phases need as many periods, at least two, all above zero, "
            "and a range"
        )
    turns = np.asarray(wrapped_rad, float) / (2 * math.pi)
    fine, pitch = int(np.argmin(periods)), float(periods.min())
    first = np.mod(turns[fine] - low / pitch, 1.0) * pitch + low
    rates = (1 / periods).reshape(-1, *[1] * first.ndim)
    best, second = np.full((2, *first.shape), np.inf)
    place = np.full(first.shape, np.nan)
    for order in range(math.ceil((high - low) / pitch)):
        tried = first + order * pitch
        left = turns - tried * rates
        left -= np.rint(left)
        tried = tried + np.sum(left * rates, axis=0) / np.sum(rates**2)
        left = turns - tried * rates
        left -= np.rint(left)
        cost = np.where((tried >= low) & (tried <= high), np.sum(left**2, axis=0), np.inf)
        second = np.minimum(second, np.maximum(cost, best))
        place = np.where(cost < best, tried, place)
        best = np.minimum(cost, best)
    scale = (2 * math.pi / sigma_rad) ** 2
    sure = (scale * best < periods.size - 1 + _FIVE_SIGMA) & (scale * (second - best) > _FIVE_SIGMA)
    return Places(np.where(sure, place, np.nan), scale * best)


_FIVE_SIGMA = 25.0


def crossed_phasors(
    frames: ArrayLike, shifts_x_rad: ArrayLike, shifts_y_rad: ArrayLike
) -> ComplexArray:
    """Phasors (2, ...) of the x and of the y fringes in frames (N, ...) that show both.

    I = A + B_x cos(phi_x + d_x) + B_y cos(phi_y + d_y), least squares. Raises ValueError if the N
    pairs of steps do not separate the two (fewer than five, or steps that go together).
    """
    stack, x, y = (np.asarray(a, float) for a in (frames, shifts_x_rad, shifts_y_rad))
    design = np.stack([np.ones_like(x), np.cos(x), -np.sin(x), np.cos(y), -np.sin(y)], axis=1)
    if len(design) < 5 or np.linalg.cond(design) > 100:
        raise ValueError(
            f"{len(design)} pairs of phase steps do not determine the phases of crossed fringes"
        )
    _, *parts = np.tensordot(np.linalg.pinv(design), stack, axes=1)
    return np.stack([parts[0] + 1j * parts[1], parts[2] + 1j * parts[3]])


def centre_phase_rad(pattern: PatternConfig) -> float:
    """Absolute phase at O': there s is half the region, where phi = 2 pi s / T - pi gives pi
    (periods - 1).
    """
    return math.pi * (pattern.periods - 1)


def mm_per_rad(pattern: PatternConfig) -> float:
    """T / (2 pi)."""
    return pattern.period_mm / (2 * math.pi)


def screen_mm(absolute_rad: FloatArray, pattern: PatternConfig) -> FloatArray:
    """Distance from O' on the screen, the paper's O'A = T phi / (2 pi) with phi relative to O'."""
    return (absolute_rad - centre_phase_rad(pattern)) * mm_per_rad(pattern)


def inside_pattern(
    absolute_rad: FloatArray, pattern: PatternConfig, margin_rad: float = 0.0
) -> BoolArray:
    """Whether the phase lies in the pattern; one from a wrong Gray bit at its rim does not."""
    return np.asarray(
        np.abs(absolute_rad - centre_phase_rad(pattern)) <= math.pi * pattern.periods - margin_rad
    )


# The images of a measurement cycle, in their order on the screen and in the memory.
#
# A full cycle is, for x and then for y, N sinusoids and 4 Gray-code bits, then white and black: 18
# images for N = 4. A fringes-only cycle is the 2 N sinusoids, x first.

GRAY_BITS = 4  # 16 half periods: enough for the 8 periods a configuration may ask for
AXES = ("x", "y")


def sinusoids(axis: str, steps: int) -> tuple[Pattern, ...]:
    """The N phase steps of one axis: I = A + B cos(phi + 2 pi k / N), k = 0..N-1 (N = 4: the
    paper's eq. 1).
    """
    return tuple(Pattern("sin", axis, k, 2 * math.pi * k / steps) for k in range(steps))


def gray_codes(axis: str) -> tuple[Pattern, ...]:
    """The Gray-code bits of one axis, most significant first; bits count from 1."""
    return tuple(Pattern("gray", axis, bit) for bit in range(1, GRAY_BITS + 1))


def full_sequence(pattern: PatternConfig) -> tuple[Pattern, ...]:
    """All images of a full cycle: 2 (N + 4) + 2."""
    by_axis = (
        image for axis in AXES for image in (*sinusoids(axis, pattern.steps), *gray_codes(axis))
    )
    return (*by_axis, Pattern("white"), Pattern("black"))


def fringe_sequence(pattern: PatternConfig) -> tuple[Pattern, ...]:
    """The images of a fringes-only cycle: 2 N."""
    return tuple(image for axis in AXES for image in sinusoids(axis, pattern.steps))


# A pixel sees the screen in the mirror if white differs from black by this share of what the bright
# pixels show; the rest of the room differs by stray light only.
CONTRAST_SHARE = 0.2
# ... and if the fringes swing by this share of it: less is a blurred edge, dust or a mixture of two
# places.
FRINGE_SHARE = 0.1


class FullSlots:
    """Positions of the images in the sequence of a full cycle."""

    def __init__(self, steps: int) -> None:
        second = steps + GRAY_BITS
        self.steps, self.count = steps, 2 * second + 2
        self.sinusoids = slice(0, steps), slice(second, second + steps)  # of x and y
        self.gray = slice(steps, second), slice(second + steps, 2 * second)
        self.white, self.black = 2 * second, 2 * second + 1  # highest and lowest level


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
        z = phasors(images[sinusoids], shifts)
        k1, k2 = gray_orders(images[gray], white, black)
        phases.append(absolute_phase(np.angle(z), k1, k2))
        valid &= (np.abs(z) > FRINGE_SHARE * contrast) & inside_pattern(phases[-1], pattern)
    return np.where(valid, np.stack(phases), np.nan)
