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
from membrane_ctrl.sim.optics.pixel_noise import GOLDEN, LOW_16, MIX_1, random_64_bits

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
    dark, white, leak, full = scale
    column_loss, row_loss = loss
    quantiles, sigma, seed = noise
    low_column, low_row, pitch_mm = places
    more, first_row, first_column = added
    lines = np.empty((nodes.shape[0], nodes.shape[2]))
    for row in range(start, stop):
        # The random numbers do not depend on how rows are shared between threads.
        state = np.uint64(seed) * MIX_1 + np.uint64(row) * np.uint64(out.shape[1]) * GOLDEN

        # The quantities at the row, in the columns of the nodes.
        for k in range(nodes.shape[0]):
            interpolate_row(nodes, k, row // step, weights[row % step], lines[k])
        for column in range(out.shape[1]):
            cell = column // step
            k = column % step
            counts = dark
            if (
                interpolate_cubic(lines[2], cell, weights, k) <= radius_mm * radius_mm
            ):  # on the film
                # Light of the panel's pixels where the ray meets them.
                s_x_mm = interpolate_cubic(lines[0], cell, weights, k)
                s_y_mm = interpolate_cubic(lines[1], cell, weights, k)
                panel_column = low_column + s_x_mm / pitch_mm
                panel_row = low_row - s_y_mm / pitch_mm
                light = _pixel_light(picture, panel_column, panel_row, leak)

                # What a disturbed bench does to it, and the lens' vignetting.
                if nodes.shape[0] > 3:
                    light *= interpolate_cubic(lines[3], cell, weights, k)
                    counts += interpolate_cubic(lines[4], cell, weights, k)
                counts += white * light * (1.0 - column_loss[column] - row_loss[row])

            # Light of further images of the screen.
            i = row - first_row
            j = column - first_column
            if 0 <= i < more.shape[0] and 0 <= j < more.shape[1]:
                counts += more[i, j]

            # Noise; then the converter rounds, and clips at both ends.
            if sigma > 0.0:
                state += GOLDEN
                counts += sigma * quantiles[random_64_bits(state) & LOW_16]
            out[row, column] = min(max(counts + 0.5, 0.0), full)


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
