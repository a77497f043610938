"""A film whose figure changes at a constant vertex, on the twin in virtual time: its figures, and
the true scalars by another integration than the product's.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from membrane_ctrl.config.schema import Config
from membrane_ctrl.hold.virtual_run import TruthShape
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from membrane_ctrl.sim.virtual_bench import VirtualBench

RADIUS_MM, APERTURE_MM = 500.0, 475.0
_POINTS = 4000  # on a radius: the changes here are round
TERM_SIGMA_UM = 0.01


def figure_change(spherical_um: float) -> FloatArray:
    """Terms of a change whose height is 0 at vertex and rim: spherical aberration, with what keeps
    the vertex."""
    change_um = np.zeros(ZERNIKE_TERMS)
    change_um[10] = spherical_um
    change_um[0] = -math.sqrt(5) * spherical_um
    return change_um


@dataclass
class ChangingFilm:
    """A source of figures: those of the twin's true sag, with a change that grows with time.

    Attributes
    ----------
    bench, config, seed
        As for `TruthShape`.
    change_um : callable
        Amplitude of the spherical term, µm, at a time.
    alter : callable, optional
        Makes another figure of one, at a time, or None; a fault of the optics.
    """

    bench: VirtualBench
    config: Config
    seed: int
    change_um: Callable[[float], float]
    alter: Callable[[float, ShapeEstimate], ShapeEstimate | None] | None = None

    def __post_init__(self) -> None:
        self._source = TruthShape(self.bench, self.config, self.seed)
        self._rng = np.random.default_rng(self.seed)

    def __call__(self, now_s: float) -> ShapeEstimate | None:
        """One cycle."""
        figure = self._source(now_s)
        if figure is None:
            return None
        noise_um = TERM_SIGMA_UM * self._rng.normal(size=ZERNIKE_TERMS)
        noise_um[0] = 0.0
        figure = replace(
            figure,
            coeffs_um=figure.coeffs_um + figure_change(self.change_um(now_s)) + noise_um,
            covariance_um2=figure.covariance_um2 + TERM_SIGMA_UM**2 * np.eye(ZERNIKE_TERMS),
        )
        return figure if self.alter is None else self.alter(now_s, figure)


def true_focus_mm(sag_um: float, spherical_um: float) -> float:
    """Half the radius of the best sphere of a bowl with such a change."""
    rho2 = radii_mm() ** 2 / RADIUS_MM**2
    spherical = math.sqrt(5) * (6 * rho2**2 - 6 * rho2)
    return best_sphere_focus_mm(1e-3 * (sag_um * hencky_profile(rho2) + spherical_um * spherical))


def radii_mm() -> FloatArray:
    """Radii (n,) of rings over the used aperture, for `best_sphere_focus_mm`."""
    return np.asarray(APERTURE_MM * (np.arange(_POINTS) + 0.5) / _POINTS)


def best_sphere_focus_mm(z: FloatArray) -> float:
    """Half the radius of the best sphere of heights (n,) in mm at `radii_mm`.

    By a search on the mean square of the distance from the sphere's centre, over the radius with
    weights of area: no code and no linearisation of the product.
    """
    r = radii_mm()

    def residuals(centre_mm: float) -> tuple[FloatArray, float]:
        distance = np.hypot(r, z - centre_mm)
        radius = float(np.average(distance, weights=r))
        return distance - radius, radius

    # Golden-section search of the centre's height
    low, high = 3000.0, 4000.0
    ratio = (math.sqrt(5) - 1) / 2
    for _ in range(80):
        left, right = high - ratio * (high - low), low + ratio * (high - low)
        squares = [float(np.sum(r * residuals(each)[0] ** 2)) for each in (left, right)]
        if squares[0] < squares[1]:
            high = right
        else:
            low = left
    return residuals((low + high) / 2)[1] / 2


def hencky_profile(rho2: FloatArray) -> FloatArray:
    """Depth of Hencky's bowl of unit sag by its power series, for a Poisson ratio of 0.3."""
    # Campbell 1956: w/w0 = sum a_2n (1 - rho^(2n + 2)) with b0 = 1.7244 for nu 0.3
    b0 = 1.7244
    a = [
        1 / b0,
        1 / (2 * b0**4),
        5 / (9 * b0**7),
        55 / (72 * b0**10),
        7 / (6 * b0**13),
        205 / (108 * b0**16),
        17051 / (5292 * b0**19),
    ]
    depth = sum(a_n * rho2 ** (n + 1) for n, a_n in enumerate(a))
    return np.asarray(depth / sum(a))
