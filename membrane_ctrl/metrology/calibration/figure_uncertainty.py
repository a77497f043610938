"""A figure's uncertainty after the calibration: height, sag, Zernike terms, with and without a
tilt.

With a wrong geometry the fit gives a wrong surface: dq = -(J_q^T W J_q)^-1 J_q^T W J_g dg, whose
blocks are known. The laser sets the vertex, with its own error.
"""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.calibration.solver import Solution
from membrane_ctrl.metrology.rays import bench_poses, forward_model
from membrane_ctrl.metrology.rays.disc_heights import heights_over_disc, remove_plane
from membrane_ctrl.metrology.rays.surface import (
    PARAMETERS,
    parameter_to_coeffs,
    sag_gradient,
)
from membrane_ctrl.model.arrays import FloatArray


@dataclass(frozen=True)
class Propagated:
    """Standard deviations that come from the geometry and the laser.

    Attributes
    ----------
    height_rms_um, figure_rms_um : float
        Over the analysed disc; the figure is the height without its best plane.
    sag_um : float
        Of the rim above the vertex.
    zernike_um : (terms,) array
        In Noll's order; 2 and 3 are the tilt.
    """

    height_rms_um: float
    figure_rms_um: float
    sag_um: float
    zernike_um: FloatArray


def surface_response(solution: Solution, index: int) -> FloatArray:
    """Change of the surface that a fit gives, by a change of the bench.

    Parameters
    ----------
    solution : Solution
        The calibration.
    index : int
        Number of the set.

    Returns
    -------
    (parameters, OPTICAL + 1) array
        dq / dg = -(J_q^T W J_q)^-1 J_q^T W J_g, with g the optical parameters and the height of the
        vertex; mm per unit of the parameter.
    """
    sums = solution.equations[index].sums
    first = forward_model.LOCAL
    columns = [*range(first, first + bench_poses.OPTICAL), PARAMETERS]
    own = sums[:PARAMETERS, :PARAMETERS]
    mixed = sums[:PARAMETERS, columns]
    return np.asarray(-np.linalg.solve(own, mixed))


def surface_covariance(solution: Solution, index: int) -> FloatArray:
    """Covariance of the surface's parameters that a figure like that of one set has.

    Parameters
    ----------
    solution : Solution
        The calibration.
    index : int
        Number of the set.

    Returns
    -------
    (parameters, parameters) array
        In mm^2, of the geometry's and the laser's errors.
    """
    response = surface_response(solution, index)
    by_geometry = response[:, :-1]
    geometry = solution.covariance[: bench_poses.OPTICAL, : bench_poses.OPTICAL]
    vertex = response[:, -1] * solution.problem.references.laser_sigma_um * 1e-3
    return np.asarray(by_geometry @ geometry @ by_geometry.T + np.outer(vertex, vertex))


def propagate_to_figure(solution: Solution, index: int, analysis_radius_mm: float) -> Propagated:
    """Propagate to the quantities of a figure like that of one set.

    Parameters
    ----------
    solution : Solution
        The calibration.
    index : int
        Number of the set.
    analysis_radius_mm : float
        Radius of the disc over which heights are averaged.

    Returns
    -------
    Propagated
    """
    covariance = surface_covariance(solution, index)
    heights, plane = heights_over_disc(analysis_radius_mm / solution.problem.radius_mm)
    flat = remove_plane(heights, plane)
    to_coeffs = parameter_to_coeffs()
    return Propagated(
        height_rms_um=_rms_um(heights, covariance),
        figure_rms_um=_rms_um(flat, covariance),
        sag_um=sag_um(covariance),
        zernike_um=1e3 * np.sqrt(np.diag(to_coeffs @ covariance @ to_coeffs.T)),
    )


def seat_sigmas(solution: Solution, index: int) -> FloatArray:
    """Standard deviations of a turned mirror's seat.

    Parameters
    ----------
    solution : Solution
    index : int
        Number of the set.

    Returns
    -------
    (3,) array
        Place of the mirror's axis along x and y, mm, and turn about it, rad.
    """
    # The set's own share of the error, and that of the common unknowns.
    local = forward_model.LOCAL
    sums = solution.equations[index].sums
    own = np.linalg.inv(sums[:local, :local])
    by_common = (own @ sums[:local, local:-1])[forward_model.SEAT]
    covariance = own[forward_model.SEAT, forward_model.SEAT]
    covariance = covariance + by_common @ solution.covariance @ by_common.T
    return np.asarray(np.sqrt(np.diag(covariance)))


def sag_um(covariance: FloatArray) -> float:
    """Standard deviation of the sag from a covariance (parameters, parameters) in mm^2 of a
    surface's parameters.
    """
    return 1e3 * float(np.sqrt(sag_gradient() @ covariance @ sag_gradient()))


def _rms_um(heights: FloatArray, covariance: FloatArray) -> float:
    """RMS over the points of the standard deviation of heights (n, parameters)."""
    variances_mm2 = np.einsum("ij,jk,ik->i", heights, covariance, heights)
    return 1e3 * float(np.sqrt(np.mean(variances_mm2)))
