"""Turns traced nodes into counts: one compiled pass over the picture, about ten nanoseconds per
pixel.

Nodes are `step` pixels apart, one before the first pixel and two after the last. Between them a
cubic through four nodes (Lagrange) in each direction; with step 1 every pixel is a node and nothing
is interpolated.
"""

from dataclasses import dataclass, replace
from functools import cache
from statistics import NormalDist

import cv2
import numpy as np
from numba import njit

from firmware_iface.display import ScreenRaster
from firmware_iface.roles import Levels, Pattern, Pixels
from membrane_ctrl.config.schema import PatternConfig
from membrane_ctrl.model.arrays import FloatArray, Singles

_GOLDEN, _MIX_1, _MIX_2 = (
    np.uint64(0x9E3779B97F4A7C15),
    np.uint64(0xBF58476D1CE4E5B9),
    np.uint64(0x94D049BB133111EB),
)
_LOW_16 = np.uint64(0xFFFF)


def node_positions(pixels: int, step: int) -> FloatArray:
    """Pixel positions of the nodes along one side of the picture."""
    return np.asarray(np.arange(-1, -(-pixels // step) + 2) * step, dtype=np.float64)


def cubic_weights(step: int) -> FloatArray:
    """Weights (step, 4) of the nodes at -1, 0, 1, 2 for the places k / step, k = 0..step-1
    (Lagrange).
    """
    f = np.arange(step) / step
    return np.stack(
        [
            -f * (f - 1) * (f - 2) / 6,
            (f + 1) * (f - 1) * (f - 2) / 2,
            -(f + 1) * f * (f - 2) / 2,
            (f + 1) * f * (f - 1) / 6,
        ],
        axis=1,
    )


def vignetting(width_px: int, height_px: int, corner_loss: float) -> tuple[FloatArray, FloatArray]:
    """Loss by column and by row; their sum is corner_loss (distance from the middle / distance of
    the corner)^2.
    """
    columns, rows = (
        np.arange(width_px) - (width_px - 1) / 2.0,
        np.arange(height_px) - (height_px - 1) / 2.0,
    )
    per_px2 = corner_loss / (columns[0] ** 2 + rows[0] ** 2)
    return per_px2 * columns**2, per_px2 * rows**2


@cache
def normal_quantiles() -> Singles:
    """65536 equally likely values of a unit normal distribution: 16 random bits pick one."""
    half = [NormalDist().inv_cdf((k + 0.5) / 65536) for k in range(32768)]
    values = np.concatenate([half, -np.array(half[::-1])])
    return np.asarray(values / values.std(), dtype=np.float32)


@njit(cache=True)
def _random_64(state: np.uint64) -> np.uint64:
    """SplitMix64's output for a state that grows by `_GOLDEN` (Steele et al., 2014): four 16-bit
    numbers.
    """
    z = (state ^ (state >> np.uint64(30))) * _MIX_1
    z = (z ^ (z >> np.uint64(27))) * _MIX_2
    return z ^ (z >> np.uint64(31))


@njit(cache=True)
def _level(s_mm: float, values: FloatArray, cell_mm: float, smooth: bool) -> float:
    """Value of the table at s from the region's low edge; the caller ensures 0 <= s < side."""
    place = s_mm / cell_mm
    cell = int(place)
    if not smooth:
        return float(values[min(cell, values.size - 1)])
    fraction = place - cell
    cell %= values.size - 1
    return float(values[cell] + fraction * (values[cell + 1] - values[cell]))


@njit(cache=True)
def _between(line: FloatArray, cell: int, w: FloatArray, k: int) -> float:
    """Value of a cubic through the nodes cell .. cell + 3, at the k-th of the places between."""
    return float(
        w[k, 0] * line[cell]
        + w[k, 1] * line[cell + 1]
        + w[k, 2] * line[cell + 2]
        + w[k, 3] * line[cell + 3]
    )


@njit(cache=True)
def _row_of_nodes(
    nodes: FloatArray, k: int, node: int, w: FloatArray | Singles, line: FloatArray | Singles
) -> None:
    """Map k at one row of the picture, at the nodes' columns."""
    for c in range(nodes.shape[2]):
        line[c] = (
            w[0] * nodes[k, node, c]
            + w[1] * nodes[k, node + 1, c]
            + w[2] * nodes[k, node + 2, c]
            + w[3] * nodes[k, node + 3, c]
        )


@njit(cache=True, nogil=True)
def shade(
    # (3, rows, columns): s_x, s_y (from the low edges of the region, mm), squared distance from the
    # vertex (mm^2); a disturbed bench has two more: factor of the screen's light, and counts of the
    # room's
    nodes: FloatArray,
    weights: FloatArray,  # (step, 4) of `cubic_weights`
    axis: int,  # 0: the pattern runs along s_x, 1: along s_y
    radius_mm: float,  # of the film's rim
    side_mm: float,  # of the pattern region
    table: tuple[FloatArray, float, bool],  # the fields of a `LevelTable`
    scale: FloatArray,  # (4,): counts without light, counts of white above that, leak, full scale
    loss: tuple[FloatArray, FloatArray],  # vignetting (W,), (H,): a column's part and a row's
    noise: tuple[
        Singles, float, int
    ],  # `normal_quantiles()`, standard deviation in counts, seed of this picture
    out: Pixels,
    start: int,
    stop: int,
) -> None:
    """Fill rows start to stop of `out` (H, W) with the picture of one pattern."""
    step = weights.shape[0]
    width = out.shape[1]
    values, cell_mm, smooth = table
    dark, white, leak, full = scale
    column_loss, row_loss = loss
    quantiles, sigma, seed = noise
    radius2_mm2 = radius_mm * radius_mm
    # three arrays, not rows of one: a view taken per pixel costs more than the pixel
    line_x, line_y, line_r2 = (
        np.empty(nodes.shape[2]),
        np.empty(nodes.shape[2]),
        np.empty(nodes.shape[2]),
    )
    line_factor, line_room = np.ones(nodes.shape[2]), np.zeros(nodes.shape[2])
    disturbed = nodes.shape[0] > 3
    bits = np.uint64(0)
    for row in range(start, stop):
        # as if all rows before it had been shaded by the same hand
        state = np.uint64(seed) * _MIX_1 + np.uint64(row) * np.uint64((width + 3) // 4) * _GOLDEN
        _row_of_nodes(nodes, 0, row // step, weights[row % step], line_x)
        _row_of_nodes(nodes, 1, row // step, weights[row % step], line_y)
        _row_of_nodes(nodes, 2, row // step, weights[row % step], line_r2)
        if disturbed:
            _row_of_nodes(nodes, 3, row // step, weights[row % step], line_factor)
            _row_of_nodes(nodes, 4, row // step, weights[row % step], line_room)
        for cell in range((width + step - 1) // step):
            for k in range(min(step, width - cell * step)):
                column = cell * step + k
                counts = dark
                if _between(line_r2, cell, weights, k) <= radius2_mm2:
                    s_x_mm = _between(line_x, cell, weights, k)
                    s_y_mm = _between(line_y, cell, weights, k)
                    light = leak
                    if 0.0 <= s_x_mm < side_mm and 0.0 <= s_y_mm < side_mm:
                        light = _level(s_y_mm if axis == 1 else s_x_mm, values, cell_mm, smooth)
                    if disturbed:
                        light *= _between(line_factor, cell, weights, k)
                        counts += _between(line_room, cell, weights, k)
                    counts += white * light * (1.0 - column_loss[column] - row_loss[row])
                if sigma > 0.0:
                    if column & 3 == 0:  # four 16-bit numbers from each 64-bit one
                        state += _GOLDEN
                        bits = _random_64(state)
                    counts += sigma * quantiles[bits & _LOW_16]
                    bits >>= np.uint64(16)
                out[row, column] = min(max(counts + 0.5, 0.0), full)


# Crossed fringes, in single precision and in an order that the processor does many at a time: first
# all pixels that are k beyond their node, then those at k + 1. A hold that tracks takes twenty such
# pictures a
# second.

_FLOAT = np.float32


@cache
def noise_bank() -> Singles:
    """A quarter of a million values of a unit normal distribution; each row of a picture takes its
    own part.
    """
    return np.random.default_rng(0).permutation(np.tile(normal_quantiles(), 4))


@njit(cache=True, fastmath=True)
def _cosine(turns: float) -> float:
    """Cosine of an angle in turns, to 2e-6."""
    t = turns - np.floor(turns + _FLOAT(0.5))
    u = t * t
    high = _FLOAT(60.1762543) + u * (_FLOAT(-26.0006905) + u * _FLOAT(6.57564783))
    middle = _FLOAT(64.9391632) + u * (_FLOAT(-85.4493332) + u * high)
    return _FLOAT(1.0) + u * (_FLOAT(-19.7392063) + u * middle)  # type: ignore[no-any-return]


@njit(cache=True, fastmath=True)
def _crossed_pixels(  # type: ignore[no-untyped-def]
    lines, weights, loss, noise, pattern, scale, levels, rooms, counts
):
    """Levels, room light and counts of the pixels (cells,) at one place between their nodes,
    `lines`, of a row.
    """
    w0, w1, w2, w3 = weights
    rate, first_x, first_y, half_mm, radius2_mm2 = pattern
    dark, white, leak, gamma, sigma, full, row_loss = scale
    one, none = _FLOAT(1.0), _FLOAT(0.0)
    for c in range(counts.size):
        x = w0 * lines[0, c] + w1 * lines[0, c + 1] + w2 * lines[0, c + 2] + w3 * lines[0, c + 3]
        y = w0 * lines[1, c] + w1 * lines[1, c + 1] + w2 * lines[1, c + 2] + w3 * lines[1, c + 3]
        r2 = w0 * lines[2, c] + w1 * lines[2, c + 1] + w2 * lines[2, c + 2] + w3 * lines[2, c + 3]
        level = _FLOAT(0.5) + _FLOAT(0.25) * (
            _cosine(x * rate + first_x) + _cosine(y * rate + first_y)
        )
        inside = (abs(x - half_mm) < half_mm) & (abs(y - half_mm) < half_mm)
        levels[c] = level if inside else none
        counts[c] = white if r2 <= radius2_mm2 else none
    if lines.shape[0] > 3:
        for c in range(counts.size):
            factor = (
                w0 * lines[3, c]
                + w1 * lines[3, c + 1]
                + w2 * lines[3, c + 2]
                + w3 * lines[3, c + 3]
            )
            room = (
                w0 * lines[4, c]
                + w1 * lines[4, c + 1]
                + w2 * lines[4, c + 2]
                + w3 * lines[4, c + 3]
            )
            rooms[c] = room if counts[c] > none else none
            counts[c] *= factor
    if gamma != one:  # a power costs ten times the rest, and does not go many at a time
        for c in range(counts.size):
            levels[c] = max(levels[c], none) ** gamma
    for c in range(counts.size):
        light = (leak + (one - leak) * levels[c]) * (one - loss[c] - row_loss)
        seen = dark + rooms[c] + counts[c] * light + sigma * noise[c] + _FLOAT(0.5)
        seen = seen if seen > none else none
        counts[c] = seen if seen < full else full


@njit(cache=True, nogil=True)
def shade_crossed(
    nodes: FloatArray,  # as in `shade`
    weights: Singles,  # (4, step): of `cubic_weights`, transposed
    # periods per mm, phases of x and y at the low edge in turns, half a side of the region (mm),
    # the rim's radius^2
    pattern: tuple[float, ...],
    # counts without light, of white above that, leak, gamma, sigma of the noise, full scale
    scale: tuple[float, ...],
    loss: tuple[
        Singles, Singles
    ],  # vignetting (step, cells) of columns k + step * cell, and (H,) of rows
    noise: tuple[Singles, int],  # `noise_bank()`, seed of this picture
    out: Pixels,
    start: int,
    stop: int,
) -> None:
    """Fill rows start to stop of `out` (H, W) with the picture of crossed fringes; its tuples hold
    single floats.
    """
    step, width = weights.shape[1], out.shape[1]
    column_loss, row_loss = loss
    cells = column_loss.shape[1]
    bank, seed = noise
    lines = np.empty((nodes.shape[0], nodes.shape[2]), np.float32)
    levels, rooms, counts = (
        np.empty(cells, np.float32),
        np.zeros(cells, np.float32),
        np.empty(cells, np.float32),
    )
    for row in range(start, stop):
        for k in range(nodes.shape[0]):
            _row_of_nodes(nodes, k, row // step, weights[:, row % step], lines[k])
        bits = _random_64(np.uint64(seed) * _MIX_1 + np.uint64(row) * _GOLDEN)
        first = int(bits % np.uint64(bank.size - step * cells))
        for k in range(step):
            own = weights[0, k], weights[1, k], weights[2, k], weights[3, k]
            some = bank[first + k * cells : first + (k + 1) * cells]
            _crossed_pixels(
                lines,
                own,
                column_loss[k],
                some,
                pattern,
                (*scale, row_loss[row]),
                levels,
                rooms,
                counts,
            )
            for cell in range((width - k + step - 1) // step):
                out[row, cell * step + k] = np.int32(counts[cell])


# A pattern's light level (0..1) at each place along one axis of the screen.
#
# s is measured from the low edge of the pattern region, a square centred on O'; outside it the
# screen is dark.

_GRAY_BITS = 4
# linear interpolation of a cosine in this many cells is 2e-8 off at most: below a thousandth of a
# 16-bit count
_SINE_CELLS = 16384


@dataclass(frozen=True, slots=True)
class Light:
    """Conversion of the pattern's level to the camera's counts.

    Raises ValueError naming the field and a valid value.
    """

    dark_fraction: float = 0.02  # counts without light, of full scale
    # counts of a white screen in the middle of the picture, of full scale
    white_fraction: float = 0.80
    leak: float = 0.02  # light of a black screen, of a white one
    gamma: float = 1.0  # the screen's light is level**gamma; 1 is a linear screen
    # loss of light at the picture's corner, growing with the square of the distance from its middle
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
    """
    phi = np.linspace(0.0, 2.0 * np.pi, _SINE_CELLS + 1) - np.pi
    if pattern.role == "sin":
        levels = 0.5 + 0.5 * np.cos(phi + pattern.shift_rad)
        period_mm = pattern.period_mm or config.period_mm
        return LevelTable(_lit(levels, light), period_mm / _SINE_CELLS, smooth=True)
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
    return LevelTable(_lit(levels, light), config.period_mm / 2.0, smooth=False)


def pattern_sequence(
    kind: str,
    config: PatternConfig,
    shifts_rad: tuple[float, ...] = (),
    coarser_mm: tuple[float, ...] = (),
) -> list[Pattern]:
    """The patterns of a set in the order they are shown: x and y sinusoids and Gray bits, white,
    black.

    The kind is "full", "fringes" (sinusoids alone) or "frequencies" (sinusoids, and those of the
    periods `coarser_mm`), else ValueError; `shifts_rad` one a step, empty: 2 pi k / N.
    """
    if kind not in ("full", "fringes", "frequencies"):
        raise ValueError(f"kind = {kind!r} must be full, fringes or frequencies")
    shifts = shifts_rad or tuple(2.0 * np.pi * k / config.steps for k in range(config.steps))
    patterns: list[Pattern] = []
    for axis in ("x", "y"):
        patterns += [Pattern("sin", axis, k, shift) for k, shift in enumerate(shifts)]
        if kind == "full":
            patterns += [Pattern("gray", axis, bit) for bit in range(1, _GRAY_BITS + 1)]
    patterns += [replace(p, period_mm=period) for period in coarser_mm for p in list(patterns)]
    return patterns + ([Pattern("white"), Pattern("black")] if kind == "full" else [])


def _lit(levels: FloatArray, light: Light) -> FloatArray:
    """Share of a white screen's light: gamma, and the leak of a black screen."""
    return np.asarray(light.leak + (1.0 - light.leak) * np.clip(levels, 0.0, 1.0) ** light.gamma)


# The pixels of a panel: what a screen driver has sent, instead of a pattern.

# of the lens, at the panel: it does not resolve a checkerboard, and takes 0.4 % of a fringe of 100
# px
_BLUR_PX = 1.5


@dataclass(frozen=True, slots=True)
class PanelPicture:
    """A picture on a panel as the camera sees it; its place on the screen is that of the pattern
    region.
    """

    levels: Levels  # (height, width)
    raster: ScreenRaster

    @property
    def places(self) -> FloatArray:
        """Column and row of the region's low edges, and the pitch in mm."""
        column_px, row_px = self.raster.centre
        half_px = self.raster.half_side_mm / self.raster.pixel_mm
        return np.array([column_px - half_px, row_px + half_px, self.raster.pixel_mm])

    def light_of_pixels(self, light: Light) -> Singles:
        """Share of a white screen's light, (height, width), not resolved further than the lens
        does.
        """
        sharp = _lit(np.arange(256) / 255.0, light).astype(np.float32)[self.levels]
        return np.asarray(
            cv2.GaussianBlur(sharp, (0, 0), _BLUR_PX, borderType=cv2.BORDER_REFLECT), np.float32
        )


@njit(cache=True, nogil=True)
def shade_panel(
    nodes: FloatArray,  # as in `shade`
    weights: FloatArray,  # (step, 4) of `cubic_weights`
    radius_mm: float,  # of the film's rim
    places: FloatArray,  # of a `PanelPicture`
    picture: Singles,  # (rows, columns) its light
    scale: FloatArray,  # (4,): as in `shade`
    loss: tuple[FloatArray, FloatArray],  # as in `shade`
    noise: tuple[Singles, float, int],  # as in `shade`
    out: Pixels,
    start: int,
    stop: int,
) -> None:
    """Fill rows start to stop of `out` (H, W) with what the camera sees of a panel in dark
    surroundings.
    """
    step = weights.shape[0]
    dark, white, leak, full = scale
    column_loss, row_loss = loss
    quantiles, sigma, seed = noise
    low_column, low_row, pitch_mm = places
    lines = np.empty((nodes.shape[0], nodes.shape[2]))
    for row in range(start, stop):
        state = np.uint64(seed) * _MIX_1 + np.uint64(row) * np.uint64(out.shape[1]) * _GOLDEN
        for k in range(nodes.shape[0]):
            _row_of_nodes(nodes, k, row // step, weights[row % step], lines[k])
        for column in range(out.shape[1]):
            cell, k = column // step, column % step
            counts = dark
            if _between(lines[2], cell, weights, k) <= radius_mm * radius_mm:
                panel_column = low_column + _between(lines[0], cell, weights, k) / pitch_mm
                panel_row = low_row - _between(lines[1], cell, weights, k) / pitch_mm
                light = _pixel_light(picture, panel_column, panel_row, leak)
                if nodes.shape[0] > 3:
                    light *= _between(lines[3], cell, weights, k)
                    counts += _between(lines[4], cell, weights, k)
                counts += white * light * (1.0 - column_loss[column] - row_loss[row])
            if sigma > 0.0:
                state += _GOLDEN
                counts += sigma * quantiles[_random_64(state) & _LOW_16]
            out[row, column] = min(max(counts + 0.5, 0.0), full)


@njit(cache=True)
def _pixel_light(picture: Singles, column: float, row: float, outside: float) -> float:
    """Light at a place of a picture, between its pixels by bilinear interpolation."""
    first_column, first_row = int(np.floor(column)), int(np.floor(row))
    if (
        first_column < 0
        or first_row < 0
        or first_column + 1 >= picture.shape[1]
        or first_row + 1 >= picture.shape[0]
    ):
        return outside
    right, down = column - first_column, row - first_row
    above = (1.0 - right) * picture[first_row, first_column] + right * picture[
        first_row, first_column + 1
    ]
    below = (1.0 - right) * picture[first_row + 1, first_column] + right * picture[
        first_row + 1, first_column + 1
    ]
    return float((1.0 - down) * above + down * below)
