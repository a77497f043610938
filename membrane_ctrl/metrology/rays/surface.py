"""The fitted surface: Zernike terms plus the part of a Hencky bowl that they cannot represent.

The excess is orthogonal to the terms over the disc, so the coefficients are those of the whole
surface whatever its amplitude: a shape made of the terms has amplitude 0, a true Hencky bowl has
its own sag.
"""

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from numpy.polynomial import polynomial as series

from membrane_ctrl.metrology.film import hencky_bowl, terms_beyond_fit
from membrane_ctrl.metrology.numerics import zernike
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS

PARAMETERS = ZERNIKE_TERMS  # all but piston, which follows from h(0) = 0, and the excess


@dataclass(frozen=True)
class Surface:
    """Height above the vertex, h(0, 0) = 0, over a disc.

    Attributes
    ----------
    coeffs_mm : (terms,) array
        Orthonormal Zernike terms in Noll's order; piston makes h(0, 0) = 0.
    hencky_mm : float
        Amplitude of the excess, as the sag of the Hencky bowl it belongs to.
    radius_mm : float
        Radius of the Zernike disc.
    beyond_mm : tuple of float
        The `BEYOND_TERMS` terms of `terms_beyond_fit`, of a calibration; a measurement has none.
    """

    coeffs_mm: FloatArray
    hencky_mm: float
    radius_mm: float
    beyond_mm: tuple[float, ...] = ()

    @classmethod
    def from_parameters(cls, parameters: FloatArray, radius_mm: float) -> "Surface":
        """Return the surface of the fit's parameters; piston makes h(0, 0) = 0.

        Parameters
        ----------
        parameters : (parameters,) array
            [a_2, a_3, ..., excess with unit RMS] in mm.
        radius_mm : float
            Radius of the Zernike disc.
        """
        hencky_mm = float(parameters[-1]) / hencky_bowl.excess_rms()
        return cls(parameter_to_coeffs() @ parameters, hencky_mm, radius_mm)

    @classmethod
    def hencky_bowl(cls, sag_mm: float, radius_mm: float) -> "Surface":
        """Return a Hencky bowl.

        Parameters
        ----------
        sag_mm, radius_mm : float
        """
        return cls(sag_mm * hencky_bowl.zernike_projection(), sag_mm, radius_mm)

    @cached_property
    def parameters(self) -> FloatArray:
        """[a_2, a_3, ..., excess with unit RMS] in mm; read only."""
        values = np.append(self.coeffs_mm[1:], self.hencky_mm * hencky_bowl.excess_rms())
        values.setflags(write=False)
        return values

    @cached_property
    def polynomial(self) -> FloatArray:
        """The Zernike part as a polynomial (degree + 1, degree + 1) in x / R, y / R."""
        return zernike.sum_polynomial(self.coeffs_mm)

    @cached_property
    def excess(self) -> FloatArray:
        """The excess as a power series in (r / R)^2, in mm."""
        own = self.hencky_mm * hencky_bowl.excess_series()
        if not self.beyond_mm:
            return own
        round_mm = np.array(self.beyond_mm[terms_beyond_fit.ROUND])
        return np.asarray(own + round_mm @ terms_beyond_fit.round_series())

    @cached_property
    def waves(self) -> FloatArray:
        """The waves beyond the fit's as a polynomial in x / R, y / R, in mm; (1, 1) without any."""
        if not self.beyond_mm:
            return np.zeros((1, 1))
        waves_mm = np.array(self.beyond_mm[terms_beyond_fit.WAVE])
        return np.asarray(np.tensordot(waves_mm, terms_beyond_fit.wave_polynomials(), axes=1))

    @cached_property
    def _whole(self) -> FloatArray:
        """The Zernike part and the waves as one polynomial in x / R, y / R."""
        if not self.beyond_mm:
            return self.polynomial
        out = self.waves.copy()
        rows, columns = self.polynomial.shape
        out[:rows, :columns] += self.polynomial
        return out

    @property
    def sag_mm(self) -> float:
        """Height on the rim of the disc, mean over azimuth."""
        return float(sag_gradient() @ self.parameters)

    def height(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Height at points (paper, eq. 15, with the excess).

        Parameters
        ----------
        x_mm, y_mm : (...) arrays

        Returns
        -------
        (...) array
            In mm.
        """
        x = np.asarray(x_mm) / self.radius_mm
        y = np.asarray(y_mm) / self.radius_mm
        terms = series.polyval2d(x, y, self._whole)
        excess = series.polyval(x * x + y * y, self.excess)
        return np.asarray(terms + excess)

    def slopes(self, x_mm: FloatArray, y_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Slopes at points (paper, eqs. 16 and 17, with the excess).

        Parameters
        ----------
        x_mm, y_mm : (...) arrays

        Returns
        -------
        slope_x, slope_y : (...) arrays
            dh/dx and dh/dy.
        """
        x = x_mm / self.radius_mm
        y = y_mm / self.radius_mm
        # The excess e(v), v = x^2 + y^2, has the slopes 2 e'(v) x and 2 e'(v) y.
        v = x * x + y * y
        excess_slope = 2 * series.polyval(v, series.polyder(self.excess))
        terms_x = series.polyval2d(x, y, series.polyder(self._whole, axis=0))
        terms_y = series.polyval2d(x, y, series.polyder(self._whole, axis=1))
        slope_x = (terms_x + excess_slope * x) / self.radius_mm
        slope_y = (terms_y + excess_slope * y) / self.radius_mm
        return slope_x, slope_y

    def curvatures(
        self, x_mm: FloatArray, y_mm: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Second derivatives at points.

        Parameters
        ----------
        x_mm, y_mm : (...) arrays

        Returns
        -------
        h_xx, h_xy, h_yy : (...) arrays
            In 1/mm.
        """
        # Of the terms.
        x = x_mm / self.radius_mm
        y = y_mm / self.radius_mm
        by_x = series.polyder(self._whole, axis=0)
        by_y = series.polyder(self._whole, axis=1)
        terms_xx = series.polyval2d(x, y, series.polyder(by_x, axis=0))
        terms_xy = series.polyval2d(x, y, series.polyder(by_x, axis=1))
        terms_yy = series.polyval2d(x, y, series.polyder(by_y, axis=1))

        # Of the excess e(v): e_xx = 2 e'(v) + 4 e''(v) x^2, e_xy = 4 e''(v) x y.
        v = x * x + y * y
        first = 2 * series.polyval(v, series.polyder(self.excess))
        second = 4 * series.polyval(v, series.polyder(self.excess, 2))
        hxx = terms_xx + first + second * x * x
        hxy = terms_xy + second * x * y
        hyy = terms_yy + first + second * y * y

        # From radii to mm.
        square_mm2 = self.radius_mm**2
        return hxx / square_mm2, hxy / square_mm2, hyy / square_mm2

    def on_grid(self, axis_mm: FloatArray) -> FloatArray:
        """Height in mm and its slopes along x and y, (3, n, n), on a square grid; rows along y."""
        axis = axis_mm / self.radius_mm
        # The terms: rows are powers of y.
        terms = self._whole.T
        terms_x = series.polyder(terms, axis=1)
        terms_y = series.polyder(terms, axis=0)
        polynomials = (terms, terms_x, terms_y)
        out = np.stack([series.polygrid2d(axis, axis, polynomial) for polynomial in polynomials])

        # The excess e(v), with the slopes 2 e'(v) x and 2 e'(v) y.
        if self.excess.any():
            v = axis**2 + axis[:, None] ** 2
            excess = series.polyval(v, self.excess)
            excess_slope = 2 * series.polyval(v, series.polyder(self.excess))
            out += np.stack([excess, excess_slope * axis, excess_slope * axis[:, None]])
        out[1:] /= self.radius_mm
        return np.asarray(out)


@cache
def parameter_to_coeffs() -> FloatArray:
    """Matrix (terms, parameters) from parameters to Noll coefficients.

    Row 1 is the piston that puts the vertex at 0: a_1 = -(sum over j >= 2 of a_j Z_j(0) +
    excess(0)).
    """
    out = np.zeros((ZERNIKE_TERMS, PARAMETERS))
    out[1:, :-1] = np.eye(ZERNIKE_TERMS - 1)
    out[0, :-1] = -zernike.at_vertex()[1:]
    out[0, -1] = -hencky_bowl.excess_series()[0] / hencky_bowl.excess_rms()
    return out


@cache
def sag_gradient() -> FloatArray:
    """d sag / d parameters (parameters,): mean over the rim minus the vertex, term by term."""
    by_terms = zernike.at_rim() - zernike.at_vertex()
    # On the rim v = 1: the power series is the sum of its coefficients.
    excess = hencky_bowl.excess_series()
    by_excess = (excess.sum() - excess[0]) / hencky_bowl.excess_rms()
    return np.append(by_terms[1:], by_excess)


@cache
def height_probe() -> FloatArray:
    """Matrix from parameters to heights at 512 points spread evenly over the disc (a sunflower),
    vertex at 0.

    Enough to see the largest height of such a surface to a few per cent.
    """
    # Equal areas along the radius, the golden angle around.
    k = np.arange(512)
    rho = np.sqrt((k + 0.5) / 511.5)
    theta = k * np.pi * (3 - np.sqrt(5))
    x = rho * np.cos(theta)
    y = rho * np.sin(theta)

    # Heights of the Zernike terms, and of the excess, which is the last parameter.
    terms = zernike.evaluate_terms(x, y)
    excess = series.polyval(rho**2, hencky_bowl.excess_series()) / hencky_bowl.excess_rms()
    by_excess = np.outer(excess, np.eye(PARAMETERS)[-1])
    return np.asarray(terms.T @ parameter_to_coeffs() + by_excess)
