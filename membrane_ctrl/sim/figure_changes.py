"""How the room's climate changes the simulated film's figure at equal sag, as polynomials."""

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.sim.climate import (
    FILM_PPM_PER_K,
    LAMP_PLACE_MM,
    LAMP_SHARE,
    LAMP_SIGMA_MM,
    compute_profile_change_per_ppm,
)
from membrane_ctrl.sim.optics.film_shape import FilmShape
from membrane_ctrl.sim.optics.film_terms import FilmTerms
from membrane_ctrl.sim.truth import Truth
from membrane_ctrl.sim.warm_patch import Patch, compute_patch_polynomial

LAMP_PATCH = Patch(*LAMP_PLACE_MM, LAMP_SIGMA_MM)


@dataclass(frozen=True)
class FigureChange:
    """A change of the film's height, for an amount of 1.

    Attributes
    ----------
    poly_um : tuple of rows
        Coefficients of x^i y^j on the unit disc; 0 at vertex and rim.
    """

    poly_um: tuple[tuple[float, ...], ...]

    @classmethod
    def from_polynomial(cls, poly_um: FloatArray) -> "FigureChange":
        """A change from coefficients (k, k)."""
        return cls(tuple(tuple(row) for row in poly_um.tolist()))

    def displace_film(self, film: FilmShape) -> FilmTerms:
        """The film with this change."""
        terms = film.terms_at(0.0)
        return terms._replace(poly_mm=_add(terms.poly_mm, 1e-3 * np.array(self.poly_um)))


@cache
def climate_change() -> FigureChange:
    """The change by 1e-6 of strain of the whole film over its ring."""
    return FigureChange.from_polynomial(_round_polynomial())


@cache
def lamp_change() -> FigureChange:
    """The change by a lamp's patch that is 1 K warmer, beside that of its mean strain."""
    patch_um = compute_patch_polynomial(LAMP_PATCH)
    change_um = _add(patch_um, -LAMP_SHARE * _round_polynomial())
    return FigureChange.from_polynomial(FILM_PPM_PER_K * change_um)


def list_figure_changes(truth: Truth) -> tuple[tuple[FigureChange, float], ...]:
    """Changes of the figure in a climate, each with its amount; none in a steady room."""
    changes: list[tuple[FigureChange, float]] = []
    if truth.excess_strain_ppm:
        changes.append((climate_change(), truth.excess_strain_ppm))
    if truth.patch_k:
        changes.append((lamp_change(), truth.patch_k))
    return tuple(changes)


def _round_polynomial() -> FloatArray:
    """The change for an excess of 1e-6, by powers of x and y: v^k = (x^2 + y^2)^k."""
    profile_um = compute_profile_change_per_ppm()
    poly_um = np.zeros((2 * profile_um.size - 1, 2 * profile_um.size - 1))
    for k, value in enumerate(profile_um.tolist()):
        for j in range(k + 1):
            poly_um[2 * (k - j), 2 * j] += value * math.comb(k, j)
    return poly_um


def _add(first: FloatArray, second: FloatArray) -> FloatArray:
    """Sum of two polynomials of different degrees."""
    size = max(len(first), len(second))
    total = np.zeros((size, size))
    total[: len(first), : len(first)] += first
    total[: len(second), : len(second)] += second
    return total
