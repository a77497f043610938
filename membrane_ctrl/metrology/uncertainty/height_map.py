"""From the covariance of the parameters to the standard deviation of the height at every point.

The fitted height is linear in the parameters, h = P a, so that sigma^2 = diag(P C P^T) with their
covariance C. With C the sample covariance of the trials that is, to the last bit of rounding, the
standard deviation over the trials' heights: the paper's RMSE map.
"""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import polynomial as series

from membrane_ctrl.metrology.film import hencky_bowl
from membrane_ctrl.metrology.numerics import zernike
from membrane_ctrl.metrology.rays.surface import parameter_to_coeffs
from membrane_ctrl.model.arrays import BoolArray, FloatArray

MAP_SIDE = 101  # points across a map: 10 mm a cell, far below what the terms can change over


@dataclass(frozen=True)
class HeightMap:
    """Points of a square grid inside a radius, and the matrix from parameters to heights there.

    Attributes
    ----------
    axis_mm : (n,) array
        Coordinates of x and of y.
    inside : (n, n) bool array
        Points inside the radius; rows are along y.
    matrix : (points, parameters) array
        Heights of the points inside, 0 at the vertex.
    """

    axis_mm: FloatArray
    inside: BoolArray
    matrix: FloatArray

    @classmethod
    def over_disc(
        cls, analysis_radius_mm: float, radius_mm: float, side: int = MAP_SIDE
    ) -> "HeightMap":
        """Return a grid over the analysis radius.

        Parameters
        ----------
        analysis_radius_mm : float
            Radius of the disc that the grid covers.
        radius_mm : float
            Radius of the Zernike disc.
        side : int
            Points along a side.
        """
        axis = np.linspace(-analysis_radius_mm, analysis_radius_mm, side)
        x, y = np.meshgrid(axis, axis)
        inside = np.hypot(x, y) <= analysis_radius_mm
        return cls(axis, inside, height_matrix(x[inside], y[inside], radius_mm))

    def picture(self, heights: FloatArray) -> FloatArray:
        """A map (n, n) of values (points,) at the points inside; NaN outside."""
        out = np.full(self.inside.shape, np.nan)
        out[self.inside] = heights
        return out

    def sigma(self, covariance: FloatArray) -> FloatArray:
        """Standard deviation (points,) of the height, for a covariance (parameters, parameters) of
        the parameters.
        """
        variance = np.einsum("pi,pi->p", self.matrix @ covariance, self.matrix)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def height_matrix(x_mm: FloatArray, y_mm: FloatArray, radius_mm: float) -> FloatArray:
    """Matrix from parameters to heights: h = P a.

    Parameters
    ----------
    x_mm, y_mm : (points,) arrays
        Places on the mirror.
    radius_mm : float
        Radius of the Zernike disc.

    Returns
    -------
    (points, parameters) array
        Heights, 0 at the vertex, in mm per mm.
    """
    x = np.asarray(x_mm) / radius_mm
    y = np.asarray(y_mm) / radius_mm
    out = np.asarray(zernike.evaluate_terms(x, y).T @ parameter_to_coeffs())
    # The last parameter also has the excess of Hencky's bowl.
    excess = series.polyval(x * x + y * y, hencky_bowl.excess_series())
    out[:, -1] += excess / hencky_bowl.excess_rms()
    return out
