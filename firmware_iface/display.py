"""The screen's patterns, and measurements of the screen,
as pure functions of images and numbers.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from firmware_iface.roles import Pattern, Pixels

FloatArray = NDArray[np.float64]

# The display's response, measured with a grey ramp, and the levels that make its light linear.

RAMP_LEVELS = tuple(
    round(255 * step / 16) for step in range(17)
)  # a cubic between 17 points is off by < 0.2 %
# Least share of the light between the end levels; less means that the ramp was not seen
_LEAST_SWING_ADU = 10.0
# A step back by more than this share is not noise: something moved, or the display adapts its light
_LARGEST_STEP_BACK = 0.02


@dataclass(frozen=True, slots=True)
class DisplayResponse:
    """Light against level."""

    levels: FloatArray  # (K,), rising, first 0 and last 255
    light: FloatArray  # (K,), 0..1, strictly rising

    @property
    def gamma(self) -> float:
        """Exponent of the power law that best fits the middle half of the ramp; for people."""
        middle = (self.light > 0.1) & (self.light < 0.9)
        x, y = np.log(self.levels[middle] / 255.0), np.log(self.light[middle])
        return float(np.sum(x * y) / np.sum(x * x))

    def levels_of(self, light: ArrayLike) -> NDArray[np.uint8]:
        """Levels that give this light (0..1), to the nearest of 256."""
        from scipy.interpolate import PchipInterpolator

        level = np.arange(256.0)
        curve = PchipInterpolator(self.levels, self.light)(level)  # monotone where the ramp is
        wanted = np.clip(np.asarray(light, np.float64), 0.0, 1.0)
        return np.asarray(np.rint(np.interp(wanted, curve, level)), np.uint8)


def linear_response() -> DisplayResponse:
    """A display whose light is proportional to its level."""
    return DisplayResponse(np.array([0.0, 255.0]), np.array([0.0, 1.0]))


def measured_response(levels: ArrayLike, seen_adu: ArrayLike) -> DisplayResponse:
    """The response from a ramp: `levels` (K,) rising from 0 to 255, and `seen_adu` (K,),
    unsaturated.

    Raises ValueError if the camera saw no ramp, with the remedy.
    """
    shown, seen = np.asarray(levels, np.float64), np.asarray(seen_adu, np.float64)
    if (
        shown.shape != seen.shape
        or shown.size < 3
        or shown[0] != 0
        or shown[-1] != 255
        or np.any(np.diff(shown) <= 0)
    ):
        raise ValueError("a ramp has rising levels from 0 to 255, and one reading each")
    swing_adu = seen[-1] - seen[0]
    if not np.isfinite(seen).all() or swing_adu < _LEAST_SWING_ADU:
        raise ValueError(
            f"the camera sees no ramp ({swing_adu:.1f} counts from black to white); exposure, aim?"
        )
    light = (seen - seen[0]) / swing_adu
    if np.min(np.diff(light)) < -_LARGEST_STEP_BACK:
        raise ValueError(
            "the light falls where the level rises: switch off the display's dynamic contrast"
        )
    if np.count_nonzero(light > 0.995) > 2:
        raise ValueError("the ramp saturates; lower the camera's exposure_ms")
    rising = np.maximum.accumulate(light) + 1e-9 * np.arange(light.size)
    return DisplayResponse(shown, (rising - rising[0]) / (rising[-1] - rising[0]))


# Patterns as the pixels of a screen (docs/reference/interfaces.md section 2).

_GRAY_BITS = 4


@dataclass(frozen=True, slots=True)
class ScreenRaster:
    """The screen's pixels, and the pattern region on them: a square centred on O'.

    Raises ValueError if the region does not fit on the screen.
    """

    width_px: int
    height_px: int
    pixel_mm: float  # pitch
    periods: int
    period_mm: float
    # (column, row) of O'; None: the middle of the screen
    centre_px: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        (column, row), half_px = self.centre, self.half_side_mm / self.pixel_mm
        room_px = min(
            column + 0.5, row + 0.5, self.width_px - 0.5 - column, self.height_px - 0.5 - row
        )
        if half_px > room_px:
            raise ValueError(
                f"the pattern of {self.periods} x {self.period_mm:g} mm needs "
                f"{2 * half_px:.0f} pixels of "
                f"{self.pixel_mm:g} mm, the screen has {2 * room_px:.0f}; lower period_mm or "
                "periods"
            )

    @property
    def centre(self) -> tuple[float, float]:
        """O' as (column, row); pixel centres are at integers."""
        return self.centre_px or ((self.width_px - 1) / 2, (self.height_px - 1) / 2)

    @property
    def half_side_mm(self) -> float:
        """Half the side of the pattern region."""
        return self.periods * self.period_mm / 2

    def from_low_edge_mm(self, axis: str) -> FloatArray:
        """Distance s from the low edge of the region, of each column ("x") or row ("y": s grows
        upward).
        """
        column, row = self.centre
        if axis == "x":
            pixels = np.arange(self.width_px, dtype=np.float64) - column
        else:
            pixels = row - np.arange(self.height_px, dtype=np.float64)
        return np.asarray(pixels * self.pixel_mm + self.half_side_mm, np.float64)


def pattern_light(pattern: Pattern, raster: ScreenRaster) -> NDArray[np.float32]:
    """Light (0..1) of every pixel, (height, width); dark outside the region.

    Raises ValueError for a role or Gray bit that is unknown.
    """
    inside = {
        axis: _inside(raster.from_low_edge_mm(axis), 2 * raster.half_side_mm) for axis in "xy"
    }
    lit = {axis: inside[axis].astype(np.float32) for axis in "xy"}
    if pattern.role in ("white", "black"):
        return np.outer(lit["y"], lit["x"]) * np.float32(pattern.role == "white")
    if pattern.role == "crossed":
        period_mm = 2 * raster.half_side_mm / pattern.index
        for axis, shift_rad in (("x", pattern.shift_rad), ("y", pattern.shift_y_rad)):
            wave = _profile(
                Pattern("sin", axis, shift_rad=shift_rad), raster.from_low_edge_mm(axis), period_mm
            )
            lit[axis] = 0.5 * wave.astype(np.float32)
        return np.add.outer(lit["y"], lit["x"]) * np.outer(inside["y"], inside["x"])
    profile = _profile(pattern, raster.from_low_edge_mm(pattern.axis), raster.period_mm)
    lit[pattern.axis] *= profile.astype(np.float32)
    return np.outer(lit["y"], lit["x"])


def checkerboard(width_px: int, height_px: int) -> NDArray[np.uint8]:
    """Black and white pixel by pixel, which no scaler reproduces."""
    return np.asarray(np.indices((height_px, width_px)).sum(axis=0) % 2 * 255, np.uint8)


def _inside(s_mm: FloatArray, side_mm: float) -> NDArray[np.bool_]:
    return (s_mm >= 0) & (s_mm < side_mm)


def _profile(pattern: Pattern, s_mm: FloatArray, period_mm: float) -> FloatArray:
    if pattern.role == "sin":  # phi = 2 pi s / T - pi
        phi = 2 * math.pi * s_mm / period_mm - math.pi
        return np.asarray(0.5 + 0.5 * np.cos(phi + pattern.shift_rad))
    if pattern.role == "gray" and 1 <= pattern.index <= _GRAY_BITS:
        v2 = np.floor(2 * s_mm / period_mm).astype(np.int64)
        return np.asarray((v2 ^ (v2 >> 1)) >> (_GRAY_BITS - pattern.index) & 1, np.float64)
    raise ValueError(
        f"pattern {pattern.name!r}: role must be sin, gray (bit 1..{_GRAY_BITS}), white or black"
    )


# The time a display needs from the command until a frame may be exposed.
#
# After a step a panel's light stays constant for a latency L (queue, refresh, scan) and then
# approaches its end as exp(-(t - L) / tau). Frames exposed at known times after the step give both;
# the wait ends when less than one of 256 levels remains: L + tau ln 256. Doubling an observed
# settle time would double
# the latency too.

_LEFT = 1.0 / 256.0  # of the step: one level
_FIT_FROM, _FIT_TO = 0.6, 1.0 / 32.0  # of the step; below, noise bends the logarithm
_NOISE_SIGMAS = 4.0
_LEAST_POINTS = 3
_BLOCK_PX = 16  # the mean of 256 pixels has a sixteenth of their noise


@dataclass(frozen=True, slots=True)
class Settling:
    """Result of the measurement."""

    settle_s: float  # from the command to the start of an exposure
    latency_s: (
        float  # of the model; NaN if the display was too fast for the camera to see the transition
    )
    tau_s: float


def share_left(frame: ArrayLike, before: ArrayLike, after: ArrayLike) -> float:
    """Remaining share of a step in a frame: the worst block's difference from the end, over the
    largest step.

    Each picture is (H, W); `before` is from before the step, `after` from long after it.
    """
    end = block_means(after)
    step = np.abs(block_means(before) - end)
    # the worst block except a thousandth, to exclude glints and dead pixels
    return float(
        np.quantile(np.abs(block_means(frame) - end), 0.999)
        / max(float(np.quantile(step, 0.999)), 1e-9)
    )


def settling(delay_s: ArrayLike, left: ArrayLike, noise: float = 0.0) -> Settling:
    """Latency, time constant and the time to wait.

    `delay_s` (K,) are the starts of the exposures after the command, from any number of steps;
    `left` (K,) the remaining shares of the step (`share_left`), `noise` the value of `left` at the
    end. Raises ValueError if the display never settles.
    """
    delays, shares = np.asarray(delay_s, np.float64), np.asarray(left, np.float64)
    order = np.argsort(delays)
    delays, shares = delays[order], shares[order]
    floor = max(_FIT_TO, _NOISE_SIGMAS * noise)
    unsettled = np.flatnonzero(shares > floor)
    if unsettled.size == 0:  # faster than the first frame; its remainder decays at least as fast
        still = max(float(shares[0]), _LEFT)
        return Settling(float(delays[0]) * math.log(_LEFT) / math.log(still), math.nan, math.nan)
    if unsettled[-1] == len(delays) - 1:
        raise ValueError(
            f"{100 * shares[-1]:.0f} % of a step is left after {delays[-1]:.2f} s: does the "
            "camera see the screen, "
            "and is its light steady (dynamic backlight, another lamp)?"
        )
    seen_s = float(delays[unsettled[-1] + 1])  # the first of the good frames
    falling = (shares < _FIT_FROM) & (shares > floor)
    if np.count_nonzero(falling) < _LEAST_POINTS or np.ptp(delays[falling]) <= 0:
        # too fast to fit: at most this long from _FIT_FROM to the floor, and no slower afterwards
        before = np.flatnonzero(shares[: unsettled[-1] + 1] >= _FIT_FROM)
        fell_s = seen_s - (float(delays[before[-1]]) if before.size else 0.0)
        rest_s = fell_s * max(0.0, math.log(floor / _LEFT)) / math.log(_FIT_FROM / floor)
        return Settling(seen_s + rest_s, math.nan, math.nan)
    slope, offset = np.polyfit(delays[falling], np.log(shares[falling]), 1)
    if slope >= 0:
        return Settling(2 * seen_s, math.nan, math.nan)
    tau_s, latency_s = -1.0 / slope, offset / -slope
    # accept a display whose tail is slower than its start
    return Settling(
        max(latency_s - tau_s * math.log(_LEFT), seen_s), float(latency_s), float(tau_s)
    )


def block_means(image: ArrayLike) -> FloatArray:
    """Means of square blocks without incomplete ones at the edges; for small images the pixels
    themselves.
    """
    pixels = np.asarray(image, np.float64)
    side = max(1, min(_BLOCK_PX, min(pixels.shape) // 8))
    rows, columns = (length // side for length in pixels.shape)
    blocks = pixels[: rows * side, : columns * side].reshape(rows, side, columns, side)
    return np.asarray(blocks.mean(axis=(1, 3)))


# Checks the camera's exposure of the screen, from one frame of white and one of black.

_SATURATED_SHARE = 0.001  # of the pixels: dust and glints
_TARGET = 0.8  # of full scale, for the 99th percentile
_LEAST = 0.25  # below, noise and converter steps are three times larger than necessary
_LEAST_CONTRAST = 3.0


def exposure_problem(white: Pixels, black: Pixels, full_scale_adu: int, exposure_ms: float) -> str:
    """The problem and its remedy, from frames (H, W) of a white and a black screen;
    empty if none.
    """
    saturated = float(np.mean(white >= full_scale_adu))
    bright, dark = float(np.quantile(white, 0.99)), float(np.quantile(black, 0.99))
    if saturated > _SATURATED_SHARE:
        return (
            f"{100 * saturated:.1f} % of the pixels are saturated on white; lower "
            f"exposure_ms = {exposure_ms:g} "
            f"to about {_two_digits(exposure_ms / 2)}, or the gain"
        )
    if bright < _LEAST * full_scale_adu:
        wanted_ms = exposure_ms * _TARGET * full_scale_adu / max(bright, 1.0)
        return (
            f"white gives only {bright:.0f} of {full_scale_adu} counts; raise exposure_ms = "
            f"{exposure_ms:g} to about "
            f"{_two_digits(wanted_ms)}, open the lens, or is the mirror covered?"
        )
    if bright < _LEAST_CONTRAST * dark:
        return (
            f"black gives {dark:.0f} counts where white gives {bright:.0f}: other light "
            "reaches the camera; darken "
            "the room"
        )
    return ""


def _two_digits(number: float) -> str:
    return f"{float(f'{number:.2g}'):g}"


# Checks whether the screen shows every pixel as sent, with a one-pixel checkerboard that the camera
# does not resolve.
#
# Shown as sent, half of the pixels are lit, and a camera that cannot tell them apart sees half of
# the white screen's light everywhere. A scaler in between mixes neighbours before the display's
# gamma: 0 and 255 become 127, which is a quarter of the light (gamma 2.2: 0.22); where its grid and
# the panel's agree again the half comes back. So a panel that announces 1360 and has 1366 columns
# shows six
# bands.

_LIT_SHARE = 0.3  # of the brightest block: where the mirror shows the screen
_LEAST_LIT = 0.02  # of all blocks
# A panel's own crosstalk between neighbours takes up to a tenth of the half
_HALF_RANGE = (0.40, 0.60)
_LARGEST_BAND = 0.10


def checkerboard_problem(seen: ArrayLike, white: ArrayLike, black: ArrayLike) -> str:
    """The problem and its remedy, from frames (H, W) of checkerboard, white and black; empty if
    none.
    """
    dark = block_means(black)
    full = block_means(white) - dark
    lit = full > _LIT_SHARE * float(np.max(full))
    if float(np.max(full)) <= 0 or np.mean(lit) < _LEAST_LIT:
        return "the camera does not see the screen: no block is brighter on white than on black"
    share = (block_means(seen) - dark)[lit] / full[lit]
    low, middle, high = (float(value) for value in np.percentile(share, (2, 50, 98)))
    if high - low > _LARGEST_BAND:
        return (
            f"a one-pixel checkerboard shows bands ({100 * low:.0f} .. {100 * high:.0f} % of "
            "white): the screen "
            "rescales; set the panel's own resolution and switch off overscan and scaling"
        )
    if not _HALF_RANGE[0] < middle < _HALF_RANGE[1]:
        return (
            f"a one-pixel checkerboard gives {100 * middle:.0f} % of white instead of 50: "
            "the screen sharpens or "
            "mixes pixels; set the panel's own resolution and switch off picture improvements"
        )
    return ""
