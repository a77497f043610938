"""Turns traced nodes into a picture of a panel that shows what a screen driver has sent."""

from dataclasses import dataclass

import cv2
import numpy as np

from firmware_iface.display_patterns import ScreenRaster
from firmware_iface.optical_roles import Levels, Pixels
from membrane_ctrl.model.arrays import FloatArray, Singles
from membrane_ctrl.model.kernel_cache import compile_loop
from membrane_ctrl.sim.optics.node_interpolation import interpolate_cubic, interpolate_row
from membrane_ctrl.sim.optics.pattern_levels import Light, screen_light
from membrane_ctrl.sim.optics.row_exposure import BESIDE_FILM, expose_row

# Blur of the lens, in pixels of the panel: it does not resolve a checkerboard, and lowers the
# contrast of a fringe of 100 px by 0.4 %.
_BLUR_PX = 1.5


@dataclass(frozen=True, slots=True)
class PanelPicture:
    """A picture on a panel as the camera sees it, at the place of the pattern region.

    Attributes
    ----------
    levels : (height, width) array
        What the panel's pixels show.
    raster : ScreenRaster
        Place of the pixels on the screen.
    """

    levels: Levels
    raster: ScreenRaster

    @property
    def places(self) -> FloatArray:
        """Column and row of the region's low edges, and the pitch in mm."""
        column_px, row_px = self.raster.centre
        half_px = self.raster.half_side_mm / self.raster.pixel_mm
        return np.array([column_px - half_px, row_px + half_px, self.raster.pixel_mm])

    def light_of_pixels(self, light: Light) -> Singles:
        """Share of a white screen's light (height, width), blurred by the lens."""
        light_of_levels = screen_light(np.arange(256) / 255.0, light).astype(np.float32)
        sharp = light_of_levels[self.levels]
        blurred = cv2.GaussianBlur(sharp, (0, 0), _BLUR_PX, borderType=cv2.BORDER_REFLECT)
        return np.asarray(blurred, np.float32)


@compile_loop(nogil=True)
def shade_panel_rows(
    nodes: FloatArray,
    weights: FloatArray,
    radius_mm: float,
    places: FloatArray,
    picture: Singles,
    scale: FloatArray,
    loss: tuple[FloatArray, FloatArray],
    noise: tuple[Singles, float, int],
    added: tuple[Singles, int, int],
    out: Pixels,
    start: int,
    stop: int,
) -> None:
    """Fill rows of the picture of a panel in dark surroundings.

    Parameters
    ----------
    places : (3,) array
        `PanelPicture.places`.
    picture : (rows, columns) array
        `PanelPicture.light_of_pixels`.
    nodes, weights, radius_mm, scale, loss, noise, added, out, start, stop
        As in `shade.shade_rows`.
    """
    step = weights.shape[0]
    width = out.shape[1]
    leak = scale[2]
    low_column, low_row, pitch_mm = places
    radius2_mm2 = radius_mm * radius_mm
    line_x = np.empty(nodes.shape[2])
    line_y = np.empty(nodes.shape[2])
    line_r2 = np.empty(nodes.shape[2])
    light = np.empty(width)
    for row in range(start, stop):
        # Where the rays meet screen and film, in the columns of the nodes.
        interpolate_row(nodes, 0, row // step, weights[row % step], line_x)
        interpolate_row(nodes, 1, row // step, weights[row % step], line_y)
        interpolate_row(nodes, 2, row // step, weights[row % step], line_r2)
        for column in range(width):
            cell = column // step
            k = column % step
            light[column] = BESIDE_FILM
            if interpolate_cubic(line_r2, cell, weights, k) <= radius2_mm2:
                # Light of the panel's pixels where the ray meets them; y is up, rows count down.
                s_x_mm = interpolate_cubic(line_x, cell, weights, k)
                s_y_mm = interpolate_cubic(line_y, cell, weights, k)
                panel_column = low_column + s_x_mm / pitch_mm
                panel_row = low_row - s_y_mm / pitch_mm
                light[column] = _pixel_light(picture, panel_column, panel_row, leak)
        expose_row(nodes, weights, row, light, scale, loss, noise, added, out)


@compile_loop()
def _pixel_light(picture: Singles, column: float, row: float, outside: float) -> float:
    """Light at a place of a picture, between its pixels by bilinear interpolation."""
    left = int(np.floor(column))
    top = int(np.floor(row))
    if left < 0 or top < 0 or left + 1 >= picture.shape[1] or top + 1 >= picture.shape[0]:
        return outside
    right_share = column - left
    lower_share = row - top
    upper = (1.0 - right_share) * picture[top, left] + right_share * picture[top, left + 1]
    lower = (1.0 - right_share) * picture[top + 1, left] + right_share * picture[top + 1, left + 1]
    return float((1.0 - lower_share) * upper + lower_share * lower)
