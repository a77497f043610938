"""Light of the further images of the screen that a clear front film makes.

Only a small part of the picture sees the pattern by them: it is shaded here pixel by pixel, and the
painters add it to the light of the mirror.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from firmware_iface.optical_roles import Pattern
from membrane_ctrl.config.schema import PatternConfig
from membrane_ctrl.model.arrays import BoolArray, FloatArray, IntArray, Singles
from membrane_ctrl.sim.optics.pattern_levels import Light, level_table, screen_light
from membrane_ctrl.sim.optics.shade_panel import PanelPicture

# s_x and s_y in mm from the low edges of the pattern's region -> share of a white screen's light
ScreenLight = Callable[[FloatArray, FloatArray], FloatArray]


class AddedLight(NamedTuple):
    """Counts that are added to a part of a picture, from a row and a column on; of no size where
    there are none.
    """

    counts: Singles
    first_row: int
    first_column: int


NO_ADDED_LIGHT = AddedLight(np.zeros((0, 0), np.float32), 0, 0)


def light_of_pattern(shown: Pattern, config: PatternConfig, light: Light) -> ScreenLight:
    """Return the light of a pattern inside its region, a square with its low edges at 0.

    Parameters
    ----------
    shown : Pattern
        The pattern.
    config : PatternConfig
        Its period and size.
    light : Light
        Gamma of the panel, and the light of a black screen.

    Returns
    -------
    ScreenLight
        A function of places (s_x, s_y) in mm.
    """
    side_mm = config.periods * config.period_mm
    if shown.role == "crossed":

        def crossed(s_x_mm: FloatArray, s_y_mm: FloatArray) -> FloatArray:
            """Fringes of both axes."""
            # Level (1 + (cos phi_x + cos phi_y) / 2) / 2, phi = 2 pi s / T - pi + shift.
            turns_x = 2 * np.pi * shown.index * s_x_mm / side_mm
            turns_y = 2 * np.pi * shown.index * s_y_mm / side_mm
            along_x = np.cos(turns_x + shown.shift_rad - np.pi)
            along_y = np.cos(turns_y + shown.shift_y_rad - np.pi)
            return screen_light(0.5 + 0.25 * (along_x + along_y), light)

        return crossed
    # Patterns along one axis are a table: interpolated for sinusoids, in steps for the others.
    table = level_table(shown, config, light)
    place = np.arange(table.values.size) * table.cell_mm

    def stripes(s_x_mm: FloatArray, s_y_mm: FloatArray) -> FloatArray:
        """A pattern along one axis."""
        s_mm = s_x_mm
        if shown.axis == "y":
            s_mm = s_y_mm
        if table.smooth:
            return np.asarray(np.interp(s_mm % place[-1], place, table.values))
        cell = (s_mm / table.cell_mm).astype(int)
        return np.asarray(table.values[np.clip(cell, 0, table.values.size - 1)])

    return stripes


def light_of_panel(panel: PanelPicture, light: Light) -> ScreenLight:
    """Return the light of a panel's pixels; a place has that of the nearest one.

    Parameters
    ----------
    panel : PanelPicture
        What the panel shows, and where its pixels are.
    light : Light
        Gamma of the panel, and the light of a black screen.

    Returns
    -------
    ScreenLight
        A function of places (s_x, s_y) in mm from the low edges of the pattern's region; 0 beside
        the panel.
    """
    pixels = panel.light_of_pixels(light)
    low_column, low_row, pitch_mm = panel.places

    def nearest(s_x_mm: FloatArray, s_y_mm: FloatArray) -> FloatArray:
        """Light at places that may be beside the panel."""
        # Columns grow with s_x; rows count down while s_y is up.
        column = np.rint(low_column + s_x_mm / pitch_mm).astype(int)
        row = np.rint(low_row - s_y_mm / pitch_mm).astype(int)
        rows, columns = pixels.shape
        on_panel = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        found = pixels[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)]
        return np.where(on_panel, found, 0.0)

    return nearest


def shade_images(
    images_mm: FloatArray,
    shares: tuple[float, float],
    side_mm: float,
    light_at: ScreenLight,
    weights: FloatArray,
    white_adu: float,
    loss: tuple[FloatArray, FloatArray],
) -> AddedLight:
    """Shade the further images of the screen.

    Parameters
    ----------
    images_mm : (2, 2, rows, columns) array
        At the nodes, s_x and s_y of each image from the region's low edges; NaN without one.
    shares : (float, float)
        Light of each image over that of the screen in a mirror without a front film.
    side_mm : float
        Side of the pattern's region: beyond it an image is dark.
    light_at : ScreenLight
        Light of the screen.
    weights : (step, 4) array
        Of `node_interpolation.cubic_weights`.
    white_adu : float
        Counts of a white screen.
    loss : (W,) and (H,) arrays
        Vignetting, by column and by row.

    Returns
    -------
    AddedLight
    """
    step = weights.shape[0]
    column_loss, row_loss = loss

    # The part of the picture between nodes of which one sees the region.
    seen = np.zeros(images_mm.shape[2:], bool)
    for image in images_mm:
        seen |= _is_near_region(image, side_mm)
    rows = np.flatnonzero(seen.any(axis=1))
    columns = np.flatnonzero(seen.any(axis=0))
    if not rows.size:
        return NO_ADDED_LIGHT
    row = _pixels_between(rows, step, row_loss.size)
    column = _pixels_between(columns, step, column_loss.size)
    if not row.size or not column.size:
        return NO_ADDED_LIGHT

    # Light of each image where it is on the region.
    counts = np.zeros((row.size, column.size))
    for share, image in zip(shares, images_mm, strict=True):
        s_x_mm, s_y_mm = (_interpolate(of_axis, row, column, weights) for of_axis in image)
        on_region = (s_x_mm >= 0) & (s_x_mm < side_mm) & (s_y_mm >= 0) & (s_y_mm < side_mm)
        counts[on_region] += share * light_at(s_x_mm[on_region], s_y_mm[on_region])
    counts *= white_adu * (1.0 - column_loss[column] - row_loss[row][:, None])
    return AddedLight(counts.astype(np.float32), int(row[0]), int(column[0]))


def _is_near_region(image_mm: FloatArray, side_mm: float) -> BoolArray:
    """Nodes (rows, columns) that see a square of three times the region's side, and those beside
    them.
    """
    near = np.all(np.abs(image_mm - side_mm / 2) < 1.5 * side_mm, axis=0)
    grown = near.copy()
    grown[1:] |= near[:-1]
    grown[:-1] |= near[1:]
    grown[:, 1:] |= near[:, :-1]
    grown[:, :-1] |= near[:, 1:]
    return np.asarray(grown)


def _pixels_between(nodes: IntArray, step: int, count: int) -> IntArray:
    """Pixels between the first and the last of these nodes; node k is at pixel (k - 1) step."""
    first = max(0, (int(nodes[0]) - 1) * step)
    last = min(count, (int(nodes[-1]) - 1) * step + 1)
    return np.arange(first, last)


def _interpolate(
    values: FloatArray, row: IntArray, column: IntArray, weights: FloatArray
) -> FloatArray:
    """A map at the nodes as seen by pixels, by the cubics of `node_interpolation`."""
    step = weights.shape[0]
    by_row = np.zeros((row.size, values.shape[1]))
    for k in range(4):
        by_row += weights[row % step, k][:, None] * values[row // step + k]
    out = np.zeros((row.size, column.size))
    for k in range(4):
        out += weights[column % step, k] * by_row[:, column // step + k]
    return out
