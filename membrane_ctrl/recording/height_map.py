"""Maps of a shape estimate for the timeline: height, difference to the first map, 1-sigma uncertainty."""

from __future__ import annotations

from functools import lru_cache
from math import factorial, sqrt

import numpy as np
from numpy.typing import NDArray

Map = NDArray[np.float32]

# 128 x 128 shows every one of the 36 terms (radial order 7) and is 66 kB a map.
MAP_PX = 128


def height_map_mm(coeffs_um: NDArray[np.float64], n_px: int = MAP_PX) -> Map:
    """Height over the disc, from the vertex.

    Parameters
    ----------
    coeffs_um : (36,) array
        Noll j = 1..36 over the mirror's radius.

    Returns
    -------
    (n_px, n_px) float32
        mm; row 0 on top (+y), NaN outside the disc.
    """
    return _spread(_basis(n_px) @ coeffs_um * 1e-3, n_px)


def difference_map_um(coeffs_um: NDArray[np.float64], reference_um: NDArray[np.float64], n_px: int = MAP_PX) -> Map:
    """Height now minus height of the reference, both from their vertex; um, as `height_map_mm`."""
    return _spread(_basis(n_px) @ (coeffs_um - reference_um), n_px)


def uncertainty_map_um(covariance_um2: NDArray[np.float64], n_px: int = MAP_PX) -> Map:
    """One standard deviation of the height: sqrt of z C z' for each point's row z of basis values; um."""
    basis = _basis(n_px)
    variance = np.einsum("ij,ij->i", basis @ covariance_um2, basis)
    return _spread(np.sqrt(np.maximum(variance, 0.0)), n_px)


def outside_disc(n_px: int = MAP_PX) -> NDArray[np.uint8]:
    """1 where a map has no value, (n_px, n_px)."""
    return (~_inside(n_px)).astype(np.uint8)


def _spread(values: NDArray[np.float64], n_px: int) -> Map:
    picture = np.full((n_px, n_px), np.nan, dtype=np.float32)
    picture[_inside(n_px)] = values
    return picture


@lru_cache(maxsize=2)
def _axis(n_px: int) -> NDArray[np.float64]:
    return (np.arange(n_px) + 0.5) * 2 / n_px - 1


@lru_cache(maxsize=2)
def _inside(n_px: int) -> NDArray[np.bool_]:
    x = _axis(n_px)
    return np.asarray(np.hypot(x[np.newaxis, :], x[::-1, np.newaxis]) <= 1.0)


@lru_cache(maxsize=2)
def _basis(n_px: int) -> NDArray[np.float64]:
    """(points inside, 36) values of Noll j = 1..36."""
    axis = _axis(n_px)
    x, y = np.meshgrid(axis, axis[::-1])
    inside = _inside(n_px)
    rho, theta = np.hypot(x, y)[inside], np.arctan2(y, x)[inside]
    return np.stack([_noll(j, rho, theta) for j in range(1, 37)], axis=1)


def _noll(j: int, rho: NDArray[np.float64], theta: NDArray[np.float64]) -> NDArray[np.float64]:
    n = 0
    while (n + 1) * (n + 2) // 2 < j:
        n += 1
    rest = j - n * (n + 1) // 2 - 1
    m = 2 * ((rest + 1) // 2) if n % 2 == 0 else 2 * (rest // 2) + 1
    radial = sum(
        (-1) ** k
        * factorial(n - k)
        / (factorial(k) * factorial((n + m) // 2 - k) * factorial((n - m) // 2 - k))
        * rho ** (n - 2 * k)
        for k in range((n - m) // 2 + 1)
    )
    angular = 1.0 if m == 0 else sqrt(2) * (np.cos(m * theta) if j % 2 == 0 else np.sin(m * theta))
    return np.asarray(sqrt(n + 1) * radial * angular)
