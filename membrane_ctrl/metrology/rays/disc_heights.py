"""Heights of the surface's parameters over a disc, with and without their best plane."""

import numpy as np

from membrane_ctrl.metrology.rays import surface_basis
from membrane_ctrl.model.arrays import FloatArray

_GRID = 41  # points along the diameter


def heights_over_disc(radius: float) -> tuple[FloatArray, FloatArray]:
    """Heights of the surface's parameters at points of a disc.

    Parameters
    ----------
    radius : float
        Radius of the disc, in radii of the terms.

    Returns
    -------
    heights : (n, parameters) array
        Height of each parameter at n points of a square grid inside the disc.
    plane : (n, 3) array
        1, x and y there.
    """
    axis = np.linspace(-radius, radius, _GRID)
    x, y = (a.ravel() for a in np.meshgrid(axis, axis))
    inside = np.hypot(x, y) <= radius
    x = x[inside]
    y = y[inside]
    return np.asarray(surface_basis.evaluate_basis(x, y)[0].T), np.stack(
        [np.ones_like(x), x, y], axis=1
    )


def remove_plane(heights: FloatArray, plane: FloatArray) -> FloatArray:
    """Return heights less their best plane.

    Parameters
    ----------
    heights : (n, ...) array
        At n points.
    plane : (n, 3) array
        1, x and y there.
    """
    return np.asarray(heights - plane @ np.linalg.lstsq(plane, heights, rcond=None)[0])
