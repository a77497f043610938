"""Turns traced nodes into a picture of a panel that shows what a screen driver has sent."""

from dataclasses import dataclass

import cv2
import numpy as np

from firmware_iface.display_patterns import ScreenRaster
from firmware_iface.roles import Levels, Pixels
from membrane_ctrl.model.arrays import FloatArray, Singles
from membrane_ctrl.model.kernel_cache import compile_loop
from membrane_ctrl.sim.optics.node_interpolation import interpolate_cubic, interpolate_row
from membrane_ctrl.sim.optics.pattern_levels import Light, screen_light
from membrane_ctrl.sim.optics.pixel_noise import GOLDEN, LOW_16, MIX_1, random_64_bits

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
        sharp = screen_light(np.arange(256) / 255.0, light).astype(np.float32)[self.levels]
        return np.asarray(
            cv2.GaussianBlur(sharp, (0, 0), _BLUR_PX, borderType=cv2.BORDER_REFLECT), np.float32
        )


@compile_loop(nogil=True)
def shade_panel_rows(
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
        state = np.uint64(seed) * MIX_1 + np.uint64(row) * np.uint64(out.shape[1]) * GOLDEN
        for k in range(nodes.shape[0]):
            interpolate_row(nodes, k, row // step, weights[row % step], lines[k])
        for column in range(out.shape[1]):
            cell, k = column // step, column % step
            counts = dark
            if interpolate_cubic(lines[2], cell, weights, k) <= radius_mm * radius_mm:
                panel_column = low_column + interpolate_cubic(lines[0], cell, weights, k) / pitch_mm
                panel_row = low_row - interpolate_cubic(lines[1], cell, weights, k) / pitch_mm
                light = _pixel_light(picture, panel_column, panel_row, leak)
                if nodes.shape[0] > 3:
                    light *= interpolate_cubic(lines[3], cell, weights, k)
                    counts += interpolate_cubic(lines[4], cell, weights, k)
                counts += white * light * (1.0 - column_loss[column] - row_loss[row])
            if sigma > 0.0:
                state += GOLDEN
                counts += sigma * quantiles[random_64_bits(state) & LOW_16]
            out[row, column] = min(max(counts + 0.5, 0.0), full)


@compile_loop()
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
