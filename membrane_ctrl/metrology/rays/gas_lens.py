"""The gas lens of a cushion: how far its front film moves the screen points of the mirror.

The shift is of some 10 um on the screen and smooth: it is traced once for a bench at places of the
mirror, for two depths of it, and kept as polynomials. To trace each ray instead would change a
height by less than a nanometre.
"""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import polynomial as series

from membrane_ctrl.metrology.numerics.compiled import compile_kernel
from membrane_ctrl.metrology.rays.cushion import Cushion, CushionBench
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.model.arrays import FloatArray

_DEGREE = 10  # of the polynomials: they leave less than 1e-5 of the shift
_PLACES = 1200  # on the mirror, a sunflower
_DEEPER_MM = 1.0  # for the change with the mirror's depth


@dataclass(frozen=True)
class GasLens:
    """Shift of the screen points by the front film.

    Attributes
    ----------
    shift_mm : (2, degree + 1, degree + 1) array
        Shift along s_x and s_y as polynomials in x and y over the radius.
    by_sag : (2, degree + 1, degree + 1) array
        Its change per mm of the mirror's depth.
    sag_mm : float
        Depth that `shift_mm` belongs to.
    radius_mm : float
        Radius of the mirror.
    """

    shift_mm: FloatArray
    by_sag: FloatArray
    sag_mm: float
    radius_mm: float

    def find_shift_mm(self, x_mm: FloatArray, y_mm: FloatArray, sag_mm: float) -> FloatArray:
        """Shift of the screen points at places of the mirror.

        Parameters
        ----------
        x_mm, y_mm : (n,) arrays
            The places, from the vertex.
        sag_mm : float
            Depth of the mirror.

        Returns
        -------
        (2, n) array
            Along s_x and s_y, mm.
        """
        table = self.shift_mm + (sag_mm - self.sag_mm) * self.by_sag
        out = np.empty((2, x_mm.size))
        evaluate_tables(x_mm / self.radius_mm, y_mm / self.radius_mm, table, out)
        return out


@compile_kernel
def evaluate_tables(x, y, table, out):  # type: ignore[no-untyped-def]
    """Evaluate polynomials by Horner's rule.

    Parameters
    ----------
    x, y : (n,) arrays
        Points, in radii.
    table : (k, degree + 1, degree + 1) array
        Coefficients of x^i y^j; those of i + j above the degree are not used.
    out : (k, n) array
        Takes the values.
    """
    degree = table.shape[1] - 1
    for axis in range(table.shape[0]):
        for p in range(x.size):
            total = 0.0
            for i in range(degree, -1, -1):
                row = 0.0
                for j in range(degree - i, -1, -1):
                    row = row * y[p] + table[axis, i, j]
                total = total * x[p] + row
            out[axis, p] = total


def trace_gas_lens(
    cushion: Cushion, pinhole_mm: FloatArray, screen_origin_mm: FloatArray, screen_axes: FloatArray
) -> GasLens:
    """Trace the front film of a bench.

    Parameters
    ----------
    cushion : Cushion
        The front film.
    pinhole_mm : (3,) array
        F in world.
    screen_origin_mm : (3,) array
        O' in world.
    screen_axes : (3, 3) array
        s_x, s_y and normal of the screen, as rows.

    Returns
    -------
    GasLens
    """
    # Places spread evenly over the disc: a sunflower, whose angle grows by the golden one.
    k = np.arange(_PLACES)
    rho = np.sqrt((k + 0.5) / (_PLACES - 0.5))
    theta = k * np.pi * (3 - np.sqrt(5))
    x = rho * np.cos(theta)
    y = rho * np.sin(theta)

    # The shift of the screen points: the rays of these places with the film, less those without.
    # For two depths, as the shift changes linearly with the depth.
    tables = []
    for sag_mm in (cushion.sag_mm, cushion.sag_mm + _DEEPER_MM):
        bowl = Surface.hencky_bowl(sag_mm, cushion.radius_mm)
        bench = CushionBench(cushion, bowl, 0.0, screen_origin_mm, screen_axes)
        x_mm = cushion.radius_mm * x
        y_mm = cushion.radius_mm * y
        point = np.stack([x_mm, y_mm, bowl.height(x_mm, y_mm)])
        rays = point - pinhole_mm[:, None]
        rays /= np.linalg.norm(rays, axis=0)
        start = np.repeat(pinhole_mm[:, None], _PLACES, axis=1)
        shift_mm = bench.trace_through(start, rays) - bench.trace_alone(start, rays)
        tables.append(_fit_polynomials(x, y, shift_mm))
    return GasLens(
        tables[0], (tables[1] - tables[0]) / _DEEPER_MM, cushion.sag_mm, cushion.radius_mm
    )


def _fit_polynomials(x: FloatArray, y: FloatArray, values: FloatArray) -> FloatArray:
    """Polynomials (2, degree + 1, degree + 1) through values (2, n), by least squares."""
    # Columns x^i y^j with i + j up to the degree.
    chosen = [(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]
    powers = series.polyvander2d(x, y, [_DEGREE, _DEGREE]).reshape(x.size, _DEGREE + 1, -1)
    design = np.stack([powers[:, i, j] for i, j in chosen], axis=1)
    solved = np.linalg.lstsq(design, values.T, rcond=None)[0]
    out = np.zeros((2, _DEGREE + 1, _DEGREE + 1))
    for row, (i, j) in zip(solved, chosen, strict=True):
        out[:, i, j] = row
    return out
