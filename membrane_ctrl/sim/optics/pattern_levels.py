"""A pattern's light level (0..1) at each place along one axis of the screen.

s is measured from the low edge of the pattern region, a square centred on O'; outside it the screen
is dark.
"""

from dataclasses import dataclass, replace

import numpy as np

from firmware_iface.optical_roles import Pattern
from membrane_ctrl.config.schema import PatternConfig
from membrane_ctrl.model.arrays import FloatArray

_GRAY_BITS = 4
# linear interpolation of a cosine in this many cells is 2e-8 off at most: below a thousandth of a
# 16-bit count
_SINE_CELLS = 16384


@dataclass(frozen=True, slots=True)
class Light:
    """Conversion of the pattern's level to the camera's counts.

    Raises ValueError naming the field and a valid value.

    Attributes
    ----------
    dark_fraction : float
        Counts without light, of full scale.
    white_fraction : float
        Counts of a white screen in the middle of the picture, of full scale.
    leak : float
        Light of a black screen, of a white one.
    gamma : float
        The screen's light is level**gamma; 1 is a linear screen.
    vignetting : float
        Loss of light at the picture's corner, growing with the square of the distance from its
        middle.
    """

    dark_fraction: float = 0.02
    white_fraction: float = 0.80
    leak: float = 0.02
    gamma: float = 1.0
    vignetting: float = 0.15

    def __post_init__(self) -> None:
        if not 0 <= self.dark_fraction < self.white_fraction <= 1:
            raise ValueError(
                f"dark_fraction = {self.dark_fraction} and white_fraction = "
                f"{self.white_fraction} must be"
                " 0 or more, at most 1, and the white above the dark"
            )
        for name, value in (("leak", self.leak), ("vignetting", self.vignetting)):
            if not 0 <= value < 1:
                raise ValueError(f"{name} = {value} must be 0 or more and below 1")
        if not 0.1 <= self.gamma <= 10:
            raise ValueError(f"gamma = {self.gamma} must be 0.1 .. 10; 1 is a linear screen")


@dataclass(frozen=True, slots=True)
class LevelTable:
    """Light along an axis in cells `cell_mm` wide.

    A smooth table is one period, repeated and interpolated, with one value more than cells so that
    the last cell has an end; the other has one value per cell over the whole region.
    """

    values: FloatArray  # (cells,)
    cell_mm: float
    smooth: bool


def level_table(pattern: Pattern, config: PatternConfig, light: Light) -> LevelTable:
    """Light of a pattern along its axis.

    - "sin": (1 + cos(phi + shift)) / 2 with phi = 2 pi s / T - pi, over one period, to be repeated;
    - "gray": bit `index` (1 is the most significant of 4) of gray(V2), V2 = floor(2 s / T), over
      the region;
    - "white" and "black": 1 and 0 over the region.

    Crossed fringes have none (`shade_crossed`). Raises ValueError if the pattern's role or Gray bit
    is unknown.

    Parameters
    ----------
    pattern : Pattern
        Role, index and phase step.
    config : PatternConfig
        Period and number of periods.
    light : Light
        Gamma of the panel, and the light of a black screen.
    """
    # Sinusoids: cells of one period, which repeat.
    phi = np.linspace(0.0, 2.0 * np.pi, _SINE_CELLS + 1) - np.pi
    if pattern.role == "sin":
        levels = 0.5 + 0.5 * np.cos(phi + pattern.shift_rad)
        period_mm = pattern.period_mm or config.period_mm
        return LevelTable(screen_light(levels, light), period_mm / _SINE_CELLS, smooth=True)

    # The others change at half periods: Gray's code of the number of the half period.
    half_periods = np.arange(2 * config.periods)
    if pattern.role == "gray" and 1 <= pattern.index <= _GRAY_BITS:
        codes = half_periods ^ (half_periods >> 1)
        levels = ((codes >> (_GRAY_BITS - pattern.index)) & 1).astype(np.float64)
    elif pattern.role in ("white", "black"):
        levels = np.full(half_periods.shape, 1.0 if pattern.role == "white" else 0.0)
    else:
        raise ValueError(
            f"pattern {pattern.name!r}: role must be sin, crossed, gray (bit 1..4), white or black"
        )
    return LevelTable(screen_light(levels, light), config.period_mm / 2.0, smooth=False)


def pattern_sequence(
    kind: str,
    config: PatternConfig,
    shifts_rad: tuple[float, ...] = (),
    coarser_mm: tuple[float, ...] = (),
) -> list[Pattern]:
    """Return the patterns of a set in the order in which they are shown.

    Parameters
    ----------
    kind : str
        "full" (sinusoids and Gray bits of x, then of y, white, black), "fringes" (sinusoids
        alone) or "frequencies" (sinusoids, and those of the coarser periods).
    config : PatternConfig
    shifts_rad : tuple of float
        Phase shift of each step; empty: 2 pi k / N.
    coarser_mm : tuple of float
        Further periods.

    Raises
    ------
    ValueError
        The kind is unknown.
    """
    if kind not in ("full", "fringes", "frequencies"):
        raise ValueError(f"kind = {kind!r} must be full, fringes or frequencies")

    # Phase steps, and Gray bits in a full set, axis by axis.
    shifts = shifts_rad or tuple(2.0 * np.pi * k / config.steps for k in range(config.steps))
    patterns: list[Pattern] = []
    for axis in ("x", "y"):
        patterns += [Pattern("sin", axis, k, shift) for k, shift in enumerate(shifts)]
        if kind == "full":
            patterns += [Pattern("gray", axis, bit) for bit in range(1, _GRAY_BITS + 1)]

    # The same steps with each coarser period.
    finest = list(patterns)
    for period_mm in coarser_mm:
        patterns += [replace(pattern, period_mm=period_mm) for pattern in finest]
    if kind == "full":
        patterns += [Pattern("white"), Pattern("black")]
    return patterns


def screen_light(levels: FloatArray, light: Light) -> FloatArray:
    """Return the light that the screen emits at levels, as a share of a white screen's.

    Parameters
    ----------
    levels : array
        Grey levels from 0 to 1.
    light : Light
        Gamma of the panel, and the light of a black screen.

    Returns
    -------
    array
        Of the levels' shape.
    """
    return np.asarray(light.leak + (1.0 - light.leak) * np.clip(levels, 0.0, 1.0) ** light.gamma)
