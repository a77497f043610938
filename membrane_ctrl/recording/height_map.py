"""Maps of a shape estimate for the timeline: height, difference to the first, 1-sigma uncertainty."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.estimate import ShapeEstimate
from membrane_ctrl.metrology import zernike
from membrane_ctrl.metrology.surface import Surface

Map = NDArray[np.float32]

# 128 x 128 shows every one of the 36 terms (radial order 7) and is 66 kB a map.
MAP_PX = 128


def height_map_mm(estimate: ShapeEstimate) -> Map:
    """Height over the mirror's disc, from the vertex.

    Returns
    -------
    (MAP_PX, MAP_PX) float32
        mm; row 0 on top (+y), NaN outside the disc.
    """
    return _spread(_surface(estimate).height(*_points()))


def difference_map_um(estimate: ShapeEstimate, reference: ShapeEstimate) -> Map:
    """Height now minus height of the reference, each from its own vertex; um, as `height_map_mm`."""
    now, before = _surface(estimate), _surface(reference)
    change = Surface(now.coeffs_mm - before.coeffs_mm, now.hencky_mm - before.hencky_mm, 1.0)
    return _spread(change.height(*_points()) * 1e3)


def uncertainty_map_um(covariance_um2: NDArray[np.float64]) -> Map:
    """One standard deviation of the height, um: sqrt of z C z' with the row z of the 36 terms at each point."""
    terms = zernike.values(*_points())
    variance = np.einsum("jp,jp->p", terms, covariance_um2 @ terms)
    return _spread(np.sqrt(np.maximum(variance, 0.0)))


def outside_disc() -> NDArray[np.uint8]:
    """1 where a map has no value, (MAP_PX, MAP_PX)."""
    return (~_inside()).astype(np.uint8)


def _surface(estimate: ShapeEstimate) -> Surface:
    """Over the unit disc: a map does not ask how large the mirror is."""
    return Surface(estimate.coeffs_um * 1e-3, estimate.hencky_um * 1e-3, 1.0)


def _spread(values: NDArray[np.float64]) -> Map:
    picture = np.full((MAP_PX, MAP_PX), np.nan, dtype=np.float32)
    picture[_inside()] = values
    return picture


@cache
def _inside() -> NDArray[np.bool_]:
    x, y = _grid()
    return np.asarray(np.hypot(x, y) <= 1.0)


@cache
def _points() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    x, y = _grid()
    return x[_inside()], y[_inside()]


def _grid() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pixel centres on the unit disc's square."""
    axis = (np.arange(MAP_PX) + 0.5) * 2 / MAP_PX - 1
    x, y = np.meshgrid(axis, -axis)
    return x, y
