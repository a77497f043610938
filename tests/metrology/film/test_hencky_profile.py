"""The Hencky bowl against its differential equation and its published constants."""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.metrology.film import hencky_bowl
from membrane_ctrl.metrology.film.film_law import FilmLaw
from membrane_ctrl.metrology.numerics import zernike
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from tests.support.metrology_truth import hencky_depth

RHO = np.linspace(0, 1, 101)


def test_profile_solves_the_equation() -> None:
    assert hencky_bowl.bowl_profile(RHO) == pytest.approx(hencky_depth(RHO), abs=1e-11)


def test_published_constants() -> None:
    """Centre coefficient 0.65344 and volume factor 0.5214 for nu = 0.3 (Fichter, NASA TP-3658)."""
    v = np.linspace(0, 1, 20001)
    bowl = FilmLaw(0.0, 0.3, 1.0, 1.0).under_pressure(1e3)  # q = 1 for a radius of 1 mm
    assert float(bowl.sag_mm) == pytest.approx(0.65344, abs=1e-5)
    assert 1 - np.trapezoid(hencky_bowl.bowl_profile(np.sqrt(v)), v) == pytest.approx(
        0.5214, abs=1e-4
    )


def test_excess_is_orthogonal_to_all_terms() -> None:
    v = np.linspace(0, 1, 20001)
    excess = np.polynomial.polynomial.polyval(v, hencky_bowl.excess_series())
    terms = zernike.evaluate_terms(np.sqrt(v), np.zeros_like(v))[
        [j - 1 for j in hencky_bowl.ROUND_NOLL]
    ]
    assert np.trapezoid(terms * excess, v, axis=1) == pytest.approx(0, abs=1e-10)
    assert np.sqrt(np.trapezoid(excess**2, v)) == pytest.approx(hencky_bowl.excess_rms(), rel=1e-4)


def test_36_terms_alone_miss_micrometres_of_the_bowl() -> None:
    assert 1e3 * 37.1 * hencky_bowl.excess_rms() == pytest.approx(2.2, abs=0.1)


def test_surface_is_bowl_with_its_vertex_at_zero() -> None:
    bowl = Surface.hencky_bowl(37.1, 500.0)
    r = 500 * RHO
    assert bowl.height(r, 0 * r) == pytest.approx(37.1 * hencky_depth(RHO), abs=1e-9)
    assert bowl.sag_mm == pytest.approx(37.1, abs=1e-10)


def test_parameters_make_the_round_trip() -> None:
    parameters = np.random.default_rng(5).normal(size=ZERNIKE_TERMS)
    surface = Surface.from_parameters(parameters, 500.0)
    assert surface.parameters == pytest.approx(parameters, abs=1e-12)
    assert surface.height(np.zeros(1), np.zeros(1)) == pytest.approx(0, abs=1e-12)
    theta = 2 * np.pi * np.arange(64) / 64
    rim = surface.height(500 * np.cos(theta), 500 * np.sin(theta))
    assert surface.sag_mm == pytest.approx(rim.mean(), abs=1e-11)
