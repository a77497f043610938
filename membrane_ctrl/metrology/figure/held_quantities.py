"""The scalars of a figure that a loop can hold: depth of the vertex, focus, and distance from a
reference figure.

A small change dc of the Zernike terms changes each scalar by a weight vector times dc. All are
expressed as the sag that a Hencky bowl of that change would gain: with s the change of the terms
per unit of sag, every weight vector w has w s = 1, so one number of the loop serves them all.

    vertex     height of the rim above the vertex
    focus      radius R of the best sphere:         w = (dR/dc) / (dR/dsag)
    best_fit   least RMS against a reference:       w = M s / (s' M s)

M is the mean over the used aperture of the products of the terms, each without its piston and tilt:
where the bowl sits and how it is tilted is no figure. With one actuator, which moves the terms
along s, the least RMS of a change dc is what remains beside s:

    rms^2 = dc' M dc - (w dc)^2 (s' M s)

The used aperture is `optics.mirror.analysis_radius_mm`.
"""

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from membrane_ctrl.config.schema import Config
from membrane_ctrl.metrology.figure.best_sphere import best_sphere
from membrane_ctrl.metrology.film import hencky_bowl
from membrane_ctrl.metrology.numerics import zernike
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.held_weights import HeldWeights
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS

# Points of equal area: rings with a number of points that grows with the radius. They integrate the
# products of all terms to 1e-3 of their size.
_RINGS = 24
_FIRST_RING_POINTS = 6
_STEP_UM = 10.0  # of the derivatives of the radius; their error is below 1e-6
_CHANGES_ONLY = slice(1, None)  # a change of piston moves no scalar


@dataclass(frozen=True)
class HeldScalars:
    """Weights of the three scalars on one aperture of one mirror.

    Attributes
    ----------
    vertex, focus, best_fit : (terms,) array
        Change of the scalar per change of each term, as µm of sag per µm.
    radius_per_term : (terms,) array
        Change of the radius of the best sphere per change of each term, mm/µm.
    radius_per_sag : float
        The same per change of the sag, mm/µm.
    points_mm : (2, n) array
        Points of equal area on the used aperture.
    height_basis : (n, terms + 1) array
        Height there per unit of each term, and of the Hencky excess (as the sag of that bowl).
    figure_basis : (n, terms) array
        The terms' heights there without piston and tilt.
    figure_sag : (n,) array
        Change of the height per change of the sag, without piston and tilt.
    """

    vertex: FloatArray
    focus: FloatArray
    best_fit: FloatArray
    radius_per_term: FloatArray
    radius_per_sag: float
    points_mm: FloatArray
    height_basis: FloatArray
    figure_basis: FloatArray
    figure_sag: FloatArray

    def weights_of(self, name: str) -> FloatArray:
        """Weights (terms,) of the scalar that `loop.holds` names."""
        return {"vertex": self.vertex, "focus": self.focus, "best_fit": self.best_fit}[name]


@dataclass(frozen=True, slots=True)
class MeasuredScalars:
    """The three scalars of a figure, with their standard deviations.

    Attributes
    ----------
    vertex_um, vertex_sigma_um : float
        Change of the sag since the reference.
    focus_mm, focus_sigma_mm : float
        Half the radius of the best sphere; the deviation is that of its changes.
    rms_um, rms_sigma_um : float
        RMS of the change since the reference over the used aperture, without piston and tilt, and
        without what the noise adds.
    least_rms_um : float
        What would remain of it at the best sag: the limit of one actuator.
    """

    vertex_um: float
    vertex_sigma_um: float
    focus_mm: float
    focus_sigma_mm: float
    rms_um: float
    rms_sigma_um: float
    least_rms_um: float


@cache
def make_held_scalars(radius_mm: float, aperture_mm: float, sag_mm: float) -> HeldScalars:
    """Return the weights for a mirror.

    Parameters
    ----------
    radius_mm, aperture_mm : float
        Of the ring, by which the terms are counted, and of the used aperture.
    sag_mm : float
        Of the bowl at which the radius of the best sphere is linearised.

    Returns
    -------
    HeldScalars
    """
    points_mm = _make_points(aperture_mm)
    x, y = points_mm / radius_mm
    basis = np.column_stack((zernike_heights(x, y), _excess_heights(x, y)))
    sensitivity = hencky_bowl.zernike_projection()
    # 1. Height of the rim above the vertex; on the rim the mean over azimuth of the round terms
    vertex = np.zeros(ZERNIKE_TERMS)
    for degree, noll in enumerate(hencky_bowl.ROUND_NOLL):
        # sqrt(2k + 1) P_k(2 v - 1): at the rim P_k = 1, at the vertex (-1)^k
        vertex[noll - 1] = math.sqrt(2 * degree + 1) * (1 - (-1) ** degree)
    # 2. Derivatives of the best sphere's radius, at a Hencky bowl
    bowl_um = 1e3 * sag_mm * np.append(sensitivity, 1.0)
    steps = _STEP_UM * np.eye(ZERNIKE_TERMS + 1)[_CHANGES_ONLY, :]
    gradient = np.zeros(ZERNIKE_TERMS + 1)
    gradient[_CHANGES_ONLY] = [
        (
            _find_radius_mm(points_mm, basis @ (bowl_um + step))
            - _find_radius_mm(points_mm, basis @ (bowl_um - step))
        )
        / (2 * _STEP_UM)
        for step in steps
    ]
    radius_per_term = gradient[:-1]
    radius_per_sag = float(gradient @ np.append(sensitivity, 1.0))
    # 3. Heights without piston and tilt, and the least squares along the sag
    frame = np.linalg.qr(np.column_stack((np.ones_like(x), x, y)))[0]
    figure = basis - frame @ (frame.T @ basis)
    figure_sag = figure @ np.append(sensitivity, 1.0)
    best_fit = figure[:, :-1].T @ figure_sag
    return HeldScalars(
        vertex=vertex / (vertex @ sensitivity),
        focus=radius_per_term / (radius_per_term @ sensitivity),
        best_fit=best_fit / (best_fit @ sensitivity),
        radius_per_term=radius_per_term,
        radius_per_sag=radius_per_sag,
        points_mm=points_mm,
        height_basis=basis,
        figure_basis=figure[:, :-1],
        figure_sag=figure_sag,
    )


def find_held_weights(config: Config) -> HeldWeights | None:
    """Return the weights of what a configuration holds; None for the vertex."""
    if config.loop.holds == "vertex":
        return None
    scalars = find_held_scalars(config)
    return HeldWeights(scalars.vertex, scalars.weights_of(config.loop.holds))


def find_held_scalars(config: Config) -> HeldScalars:
    """Return the weights of the three scalars of a configured mirror."""
    mirror = config.optics.mirror
    return make_held_scalars(mirror.radius_mm, mirror.analysis_radius_mm, mirror.sag_mm)


def measure_scalars(
    scalars: HeldScalars,
    coeffs_um: FloatArray,
    hencky_um: float,
    covariance_um2: FloatArray,
    reference_um: FloatArray,
) -> MeasuredScalars:
    """Return the three scalars of a figure.

    Parameters
    ----------
    scalars : HeldScalars
    coeffs_um : (terms,) array
        Of the figure.
    hencky_um : float
        Its excess.
    covariance_um2 : (terms, terms) array
        Of changes of the terms; NaN where it is not known, as are then the deviations.
    reference_um : (terms,) array
        Terms of the figure from which changes are counted. It is constant: its own error is no
        error of a change.

    Returns
    -------
    MeasuredScalars
    """
    change_um = coeffs_um - reference_um
    heights_um = scalars.height_basis @ np.append(coeffs_um, hencky_um)
    radius_mm = _find_radius_mm(scalars.points_mm, heights_um)
    # The RMS, its expectation for noise alone, and its variance (of a quadratic form of Gaussians)
    points = len(heights_um)
    squares = scalars.figure_basis.T @ scalars.figure_basis / points
    square_um2 = float(change_um @ squares @ change_um)
    by_noise = squares @ covariance_um2
    noise_um2 = float(np.trace(by_noise))
    weighted = squares @ change_um
    # The noise in the change adds 4 tr to its first part: it is 4 w' C w - 2 tr, at least 2 tr
    of_noise_um4 = 2 * float(np.trace(by_noise @ by_noise))
    variance_um4 = 4 * float(weighted @ covariance_um2 @ weighted) - of_noise_um4
    variance_um4 = max(variance_um4, of_noise_um4)
    rms_um = math.sqrt(max(0.0, square_um2 - noise_um2))
    # Near 0 a root is not linear in its square: there the deviation of the square's own root
    # counts
    spread_um2 = math.sqrt(max(0.0, variance_um4))
    rms_sigma_um = spread_um2 / max(2 * rms_um, math.sqrt(spread_um2), 1e-12)
    # What the best sag leaves
    per_sag = float(scalars.figure_sag @ scalars.figure_sag) / points
    taken_um2 = float(scalars.best_fit @ change_um) ** 2 * per_sag
    return MeasuredScalars(
        vertex_um=float(scalars.vertex @ change_um),
        vertex_sigma_um=_find_sigma(scalars.vertex, covariance_um2),
        focus_mm=radius_mm / 2,
        focus_sigma_mm=_find_sigma(scalars.radius_per_term, covariance_um2) / 2,
        rms_um=rms_um,
        rms_sigma_um=rms_sigma_um,
        least_rms_um=math.sqrt(max(0.0, square_um2 - taken_um2 - noise_um2)),
    )


def zernike_heights(x: FloatArray, y: FloatArray) -> FloatArray:
    """Evaluate all Zernike terms at points of the unit disc.

    Parameters
    ----------
    x, y : (n,) array
        The points.

    Returns
    -------
    (n, terms) array
        Noll order, RMS 1 each.
    """
    powers = range(zernike.monomial_table().shape[1])
    x_powers = np.stack([x**power for power in powers])
    y_powers = np.stack([y**power for power in powers])
    return np.asarray(
        np.einsum("jpq,pn,qn->nj", zernike.monomial_table(), x_powers, y_powers, optimize=True)
    )


def _excess_heights(x: FloatArray, y: FloatArray) -> FloatArray:
    """Excess (n,) of a Hencky bowl of unit sag at points of the unit disc, 0 at the vertex."""
    excess = np.polynomial.Polynomial(hencky_bowl.excess_series())
    values = excess(x * x + y * y) - excess(0.0)
    return np.asarray(values)


def _make_points(aperture_mm: float) -> FloatArray:
    """Points (2, n) of equal area on a disc: ring k of n has (2 k + 1) times as many points as the
    first one.
    """
    rings = []
    for ring in range(_RINGS):
        # The radius that halves the ring's area
        inner = (ring / _RINGS) ** 2
        outer = ((ring + 1) / _RINGS) ** 2
        radius_mm = aperture_mm * math.sqrt((inner + outer) / 2)
        count = _FIRST_RING_POINTS * (2 * ring + 1)
        # Each ring begins at another angle
        angle = 2 * np.pi * (np.arange(count) + 0.5 * (ring % 2)) / count
        rings.append(radius_mm * np.stack((np.cos(angle), np.sin(angle))))
    return np.concatenate(rings, axis=1)


def _find_radius_mm(points_mm: FloatArray, heights_um: FloatArray) -> float:
    """Radius of the best sphere through points (2, n) with heights (n,)."""
    cloud = np.vstack((points_mm, 1e-3 * heights_um))
    curvature_per_mm = best_sphere(cloud).curvature_per_mm
    if curvature_per_mm == 0:
        return math.nan
    return 1 / curvature_per_mm


def _find_sigma(weights: FloatArray, covariance_um2: FloatArray) -> float:
    return math.sqrt(max(0.0, float(weights @ covariance_um2 @ weights)))
