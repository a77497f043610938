"""How sharp the mirror's rim is in a picture: the measure by which a camera is focused.

The camera must be focused on the film. Its rim is the only edge at the film's distance; the screen
is further away by the way of the reflected light, and is blurred on purpose.
"""

import cv2
import numpy as np

from membrane_ctrl.acquisition.mirror_pictures import MirrorPictures
from membrane_ctrl.model.arrays import AnyArray

_SECTORS = 8
_SPOKES = 24  # of a sector: their mean has a tenth of a pixel
_STEP_PX = 0.25
_HALF_WINDOW_PX = 40.0  # of the profile about the edge
_LOW, _HIGH = 0.1, 0.9  # of the swing, between which the edge is measured
_BRIGHT_QUANTILE = 0.95
_LEAST_COUNTS = 10.0  # swing between white and black that shows a mirror


def measure_rim_edge_px(pictures: MirrorPictures) -> float:
    """Return the width of the rim's edge, from 10 to 90 % of its swing.

    Parameters
    ----------
    pictures : MirrorPictures
        Of the lit mirror, with the screen white and black, counts.

    Returns
    -------
    float
        In px, the median of the sectors that show the rim; NaN without one.
    """
    # The difference of both pictures contains the screen's light only: the mirror is bright, and
    # lamps and the room are gone. Its mean position is the centre from which the rim is searched.
    light = pictures.white.astype(np.float32) - pictures.black.astype(np.float32)
    bright = float(np.quantile(light, _BRIGHT_QUANTILE))
    if bright < _LEAST_COUNTS:
        return float("nan")
    rows, columns = np.nonzero(light > 0.5 * bright)
    centre = float(np.mean(columns)), float(np.mean(rows))
    widths = []
    for sector in range(_SECTORS):
        width_px = _measure_sector_px(light, centre, sector, 0.5 * bright)
        if np.isfinite(width_px):
            widths.append(width_px)
    return float(np.median(widths)) if widths else float("nan")


def _measure_sector_px(
    light: AnyArray, centre: tuple[float, float], sector: int, level: float
) -> float:
    """Width of the mean edge of a sector's spokes, each shifted to its own crossing of a level."""
    # Sample the picture along rays from the centre. Each profile is cut about its own outermost
    # crossing of the level, so that an elliptic rim does not smear the mean of the profiles.
    reach_px = float(np.hypot(*light.shape))
    along_px = np.arange(0.0, reach_px, _STEP_PX)
    half = round(_HALF_WINDOW_PX / _STEP_PX)
    angles = 2 * np.pi * (sector + np.arange(_SPOKES) / _SPOKES) / _SECTORS
    edges = []
    for angle in angles:
        columns = (centre[0] + along_px * np.cos(angle)).astype(np.float32)
        rows = (centre[1] + along_px * np.sin(angle)).astype(np.float32)
        profile = cv2.remap(light, columns[None], rows[None], cv2.INTER_LINEAR)[0]
        lit = np.nonzero(profile > level)[0]
        # the outermost lit point, with a whole window about it
        if lit.size and half <= lit[-1] < profile.size - half:
            edges.append(profile[lit[-1] - half : lit[-1] + half])
    if len(edges) < _SPOKES // 2:
        return float("nan")
    # Scale the mean profile to 1 inside the mirror and 0 outside: levels from the ends of the
    # window, by medians, because patterns and dust are near.
    mean = np.mean(edges, axis=0)
    inside = float(np.median(mean[: half // 2]))
    outside = float(np.median(mean[-half // 2 :]))
    share = (mean - outside) / max(inside - outside, 1e-6)
    # the last point above the high share, and the first below the low one after it
    begins = np.nonzero(share > _HIGH)[0]
    ends = np.nonzero(share < _LOW)[0]
    ends = ends[ends > begins[-1]] if begins.size else ends
    if not begins.size or not ends.size:
        return float("nan")
    return float(ends[0] - begins[-1]) * _STEP_PX
