"""Elastic constants from the invariants of a stiffness matrix that other algebra made."""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.measure.film import _describe_together
from membrane_ctrl.metrology.film.film_law import FilmLaw
from membrane_ctrl.metrology.film.orthotropy import OrthotropicFilm, find_orthotropy
from membrane_ctrl.metrology.film.ring_waves import RingWave, _find_causes_together

E1, E2, NU12, G12 = 210e3, 190e3, 0.38, 70e3  # N/m
COVARIANCE = np.diag([1e-12, 1e-6, 1e-6])
SIGMAS = np.full(2, 1e-3)


def film_of(direction_rad: float, four_rad: float, e2: float = E2) -> OrthotropicFilm | None:
    """The constants found in an exact film, whose four waves lie along `four_rad`."""
    compliance = np.array([[1 / E1, -NU12 / E1, 0], [-NU12 / E1, 1 / e2, 0], [0, 0, 1 / G12]])
    q = np.linalg.inv(compliance)
    # Tsai and Pagano's invariants
    u1 = (3 * q[0, 0] + 3 * q[1, 1] + 2 * q[0, 1] + 4 * q[2, 2]) / 8
    u2 = (q[0, 0] - q[1, 1]) / 2
    u3 = (q[0, 0] + q[1, 1] - 2 * q[0, 1] - 4 * q[2, 2]) / 8
    u4 = (q[0, 0] + q[1, 1] + 6 * q[0, 1] - 4 * q[2, 2]) / 8
    nu = u4 / u1
    law = FilmLaw(5e-4, float(nu), float(u1 * (1 - nu**2)), 500.0)
    apart, shear = 2 * u2 / u1, -4 * (1 + nu) * u3 / (u1 * (1 - nu**2))
    two = apart * np.array([np.cos(2 * direction_rad), np.sin(2 * direction_rad)])
    four = shear * np.array([np.cos(4 * four_rad), np.sin(4 * four_rad)])
    waves = (
        RingWave("modulus", 2, two, SIGMAS, True),
        RingWave("shear", 4, four, SIGMAS, True),
    )
    return find_orthotropy(law, COVARIANCE, waves)


def test_the_constants_of_an_exact_film_return() -> None:
    film = film_of(2.5, 2.5)
    assert film is not None
    assert film.values == pytest.approx([E1, E2, G12, NU12, E1 / E2, G12 / E1], rel=1e-9)
    assert film.direction_rad == pytest.approx(2.5)
    assert not film.has_other_axes
    # 1e-3 of the moduli's difference is 1e-3 of their ratio
    assert film.sigmas[4] == pytest.approx(1e-3 * E1 / E2, rel=0.1)


def test_equal_moduli_have_the_axes_of_a_soft_shear() -> None:
    film = film_of(0.0, 0.3, e2=E1)
    assert film is not None
    assert film.values[:3] == pytest.approx([E1, E1, G12], rel=1e-9)
    assert film.direction_rad == pytest.approx(0.3)


def test_four_waves_along_other_axes_are_no_orthotropic_film() -> None:
    film = film_of(0.4, 0.8)
    assert film is not None
    assert film.has_other_axes


def test_waves_of_another_cause_give_no_constants() -> None:
    unknown = RingWave("modulus", 2, np.zeros(2), SIGMAS, False)
    shear = RingWave("shear", 4, np.zeros(2), SIGMAS, True)
    law = FilmLaw(0.0, 0.35, 2e5, 500.0)
    assert find_orthotropy(law, COVARIANCE, (unknown, shear)) is None


def test_causes_that_are_known_only_together_are_stated_with_their_combination() -> None:
    """Strain and roundness whose difference is known a hundred times better than either."""
    # The common part (1e-4, 1 mm), and a strain of its own of 1e-6
    covariance = np.array([[1e-8 + 1e-12, 1e-4], [1e-4, 1.0]])
    (pair,) = _find_causes_together(3, ("prestrain", "round"), covariance)
    assert pair.correlation > 0.999
    assert pair.factor == pytest.approx(1e-4)
    assert pair.sigma == pytest.approx(1e-6, rel=0.01)
    text = _describe_together(pair)
    assert "pre-strain varies and ring not round, 3 waves, are known only together" in text
    assert "the first - 100 µm/m per mm of the second is known to 1 µm/m" in text
    assert _find_causes_together(3, ("prestrain", "round"), np.diag([1e-8, 1.0])) == []
