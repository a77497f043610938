"""What the calibration leaves uncertain of a figure: height, sag, Zernike terms, with and without a tilt.

A wrong geometry is answered by the fit with a wrong surface: dq = -(J_q^T W J_q)^-1 J_q^T W J_g dg, of which the
blocks are at hand. The vertex is put where the laser says, with the laser's own error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.metrology.calibrate.parameters import OPTICAL
from membrane_ctrl.metrology.calibrate.residuals import LOCAL, basis
from membrane_ctrl.metrology.calibrate.solve import Solution
from membrane_ctrl.metrology.surface import PARAMETERS, parameter_to_coeffs, sag_gradient

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Propagated:
    """Standard deviations that come from the geometry and the laser.

    Attributes
    ----------
    height_rms_um, figure_rms_um : float
        Over the analysed disc; the figure is the height without its best plane.
    sag_um : float
        Of the rim above the vertex.
    zernike_um : (36,) array
        Noll j = 1..36; 2 and 3 are the tilt.
    """

    height_rms_um: float
    figure_rms_um: float
    sag_um: float
    zernike_um: FloatArray


def surface_response(solution: Solution, index: int) -> FloatArray:
    """d surface / d (optical parameters, vertex' height), (36, OPTICAL + 1), of one set."""
    sums = solution.equations[index].sums
    mixed = np.hstack([sums[:PARAMETERS, LOCAL : LOCAL + OPTICAL], sums[:PARAMETERS, PARAMETERS : PARAMETERS + 1]])
    return np.asarray(-np.linalg.solve(sums[:PARAMETERS, :PARAMETERS], mixed))


def surface_covariance(solution: Solution, index: int) -> FloatArray:
    """Covariance (36, 36) in mm^2 of the parameters of one set's surface."""
    response = surface_response(solution, index)
    geometry = solution.covariance[:OPTICAL, :OPTICAL]
    vertex = response[:, -1] * solution.problem.witness.laser_sigma_um * 1e-3
    return np.asarray(response[:, :-1] @ geometry @ response[:, :-1].T + np.outer(vertex, vertex))


def propagate(solution: Solution, index: int, analysis_radius_mm: float) -> Propagated:
    """To what a person reads off a figure like that of one set."""
    covariance = surface_covariance(solution, index)
    heights, plane = disc(analysis_radius_mm / solution.problem.radius_mm)
    flat = heights - plane @ np.linalg.lstsq(plane, heights, rcond=None)[0]
    to_coeffs, sag = parameter_to_coeffs(), sag_gradient()
    return Propagated(
        height_rms_um=_rms_um(heights, covariance),
        figure_rms_um=_rms_um(flat, covariance),
        sag_um=1e3 * float(np.sqrt(sag @ covariance @ sag)),
        zernike_um=1e3 * np.sqrt(np.diag(to_coeffs @ covariance @ to_coeffs.T)),
    )


def disc(radius: float) -> tuple[FloatArray, FloatArray]:
    """Heights (n, 36) of the surface's parameters over a disc of some radii, and the plane's columns (n, 3)."""
    x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(-radius, radius, 41)] * 2))
    inside = np.hypot(x, y) <= radius
    x, y = x[inside], y[inside]
    return np.asarray(basis(x, y)[0].T), np.stack([np.ones_like(x), x, y], axis=1)


def _rms_um(heights: FloatArray, covariance: FloatArray) -> float:
    return 1e3 * float(np.sqrt(np.mean(np.einsum("ij,jk,ik->i", heights, covariance, heights))))
