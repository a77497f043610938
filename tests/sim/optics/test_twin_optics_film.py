"""Shape of the film: Hencky's bowl, slopes, vertex, rim,
and the coefficients of the fitted terms.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable

import numpy as np
import pytest
from numpy.polynomial.polynomial import polyder, polyval
from scipy.integrate import quad
from scipy.special import jn_zeros, jv

from membrane_ctrl.metrology.film.film_law import FilmLaw
from membrane_ctrl.metrology.film.finite_slopes import finite_rise_mm
from membrane_ctrl.model.zernike_terms import ZERNIKE_DEGREE, ZERNIKE_TERMS
from membrane_ctrl.sim import hencky, stretched_film
from membrane_ctrl.sim.optics.drum_modes import DrumMode, drum_modes
from membrane_ctrl.sim.optics.film_shape import (
    MAX_FILM_TERMS,
    Bump,
    FilmShape,
    Ripple,
    Wrinkle,
    bowl_series,
    typical_film,
)
from membrane_ctrl.sim.optics.film_terms import film_heights, height_and_slopes
from membrane_ctrl.sim.optics.zernike_polynomials import noll_orders

RICH = FilmShape(
    37.1,
    zernike_um=tuple(float(v) for v in np.random.default_rng(3).normal(0.0, 200.0, 66)),
    ripples=(Ripple(5.0, 60.0, 30.0, 0.4), Ripple(2.0, 25.0)),
    wrinkles=(Wrinkle(80.0, 24, 1.0),),
    bumps=(Bump(30.0, 100.0, -50.0, 40.0),),
)


def _slope_over_rho(u: float) -> float:
    """dW/drho / rho of the unit bowl as a function of u = rho^2."""
    return float(2.0 * polyval(u, polyder(bowl_series("hencky", 37.0, 500.0))))


def test_the_series_solves_henckys_equation() -> None:
    # n = c / g with g = (dW/drho)/rho; c follows from the equation itself at the centre, then must
    # hold everywhere
    def n_over_c(rho: float) -> float:
        return 1.0 / _slope_over_rho(rho * rho)

    step = 1e-3

    def operator(rho: float) -> float:
        second = (n_over_c(rho + step) - 2 * n_over_c(rho) + n_over_c(rho - step)) / step**2
        first = (n_over_c(rho + step) - n_over_c(rho - step)) / (2 * step)
        return second + 3 * first / rho

    c3 = [-1.0 / (8.0 * operator(rho) * n_over_c(rho) ** 2) for rho in (0.1, 0.3, 0.5, 0.7, 0.9)]
    np.testing.assert_allclose(c3, c3[0], rtol=1e-5)


def test_the_series_keeps_the_rims_condition() -> None:
    g, step = _slope_over_rho, 1e-4
    slope = (1.0 / g((1 + step) ** 2) - 1.0 / g((1 - step) ** 2)) / (2 * step)
    assert slope + 0.7 / g(1.0) == pytest.approx(0.0, abs=1e-7)


def test_the_bowl_holds_the_volume_that_the_gas_sees() -> None:
    # volume between the film and the plane of the rim, over pi a^2 w0
    volume = quad(
        lambda rho: 2.0 * rho * (1.0 - polyval(rho * rho, bowl_series("hencky", 37.0, 500.0))),
        0.0,
        1.0,
    )[0]
    assert volume == pytest.approx(hencky.solve_hencky().volume, rel=1e-9)


@pytest.mark.parametrize(
    ("prestrain", "poisson"), [(0.0, 0.3), (8e-4, 0.38), (-3e-4, 0.2), (2e-2, 0.3)]
)
def test_a_stretched_film_is_the_laws(prestrain: float, poisson: float) -> None:
    """The least energy against the balance of forces of the metrology:
    neither knows of the other.
    """
    load, profile = stretched_film.solve_stretched_film(0.074, prestrain, poisson)
    law = FilmLaw(prestrain, poisson, 1.0, 1.0)
    rho = np.linspace(0.02, 1, 21)
    rises = 0.074 * 2 * rho * polyval(rho**2, polyder(profile))
    assert rises == pytest.approx(finite_rise_mm(law, load, rho), abs=3e-11)
    # with small slopes both are Foeppl's
    load, profile = stretched_film.solve_stretched_film(1e-3, max(prestrain, 0.0), poisson)
    bowl = FilmLaw(max(prestrain, 0.0), poisson, 1.0, 1.0).with_sag(1e-3)
    assert load == pytest.approx(float(bowl.load), rel=1e-6)
    assert 1e-3 * polyval(rho**2, profile) == pytest.approx(bowl.height_mm(rho), abs=1e-9)


def test_a_stretched_film_keeps_its_ring_and_changes_its_profile() -> None:
    film = FilmShape(37.1, prestrain=1e-3, poisson=0.36)
    rim, half = (film.height_mm(np.array([r]), np.zeros(1), -4000.0)[0] for r in (500.0, 250.0))
    assert rim == pytest.approx(33.1, abs=1e-9)
    assert half / rim != pytest.approx(
        film.height_mm(np.array([250.0]), np.zeros(1))[0] / 37.1, abs=1e-4
    )
    with pytest.raises(ValueError, match=r"poisson = 0.6 is outside 0 .. 0.5"):
        FilmShape(37.1, poisson=0.6)
    with pytest.raises(ValueError, match="slack at its ring"):
        FilmShape(37.1, prestrain=-6e-3).height_mm(np.zeros(1), np.zeros(1))


STRETCHED = FilmShape(37.1, prestrain=1e-3, poisson=0.36)


@pytest.mark.parametrize(
    "film", [RICH, FilmShape(37.1, bowl="paraboloid"), FilmShape(37.1), STRETCHED]
)
def test_slopes_are_the_derivatives_of_the_height(film: FilmShape) -> None:
    step = 1e-3
    for x, y in ((0.0, 0.0), (120.0, -60.0), (-300.0, 350.0), (0.0, 499.0)):
        _, hx, hy = height_and_slopes(film.terms_at(-100.0), 37.0, x, y)
        grid = film.height_mm(
            np.array([x + step, x - step, x, x]), np.array([y, y, y + step, y - step]), -100.0
        )
        assert hx == pytest.approx((grid[0] - grid[1]) / (2 * step), abs=1e-9)
        assert hy == pytest.approx((grid[2] - grid[3]) / (2 * step), abs=1e-9)


def test_the_vertex_is_zero_at_any_displacement() -> None:
    for displacement_um in (-500.0, 0.0, 300.0):
        assert RICH.height_mm(np.zeros(1), np.zeros(1), displacement_um)[0] == pytest.approx(
            0.0, abs=1e-12
        )


def test_the_rim_stays_where_it_is() -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 13)
    x, y = 500.0 * np.cos(angle), 500.0 * np.sin(angle)
    # the vertex falls by the displacement, so heights above it grow by as much
    np.testing.assert_allclose(
        RICH.height_mm(x, y, 250.0) - RICH.height_mm(x, y), 0.250, atol=1e-11
    )


def test_coefficients_of_a_shape_of_the_fitted_terms_give_its_heights() -> None:
    film = FilmShape(37.1, bowl="paraboloid", zernike_um=RICH.zernike_um[:ZERNIKE_TERMS])
    coeffs_um = film.coeffs_um(400.0)
    assert coeffs_um is not None
    flat = FilmShape(0.0, bowl="paraboloid", zernike_um=tuple(coeffs_um))
    x, y = np.random.default_rng(5).uniform(-350.0, 350.0, (2, 40))
    np.testing.assert_allclose(flat.height_mm(x, y), film.height_mm(x, y, 400.0), atol=1e-11)
    # piston included: the sum of the terms is 0 at the vertex, where only the rotationally
    # symmetric ones are not
    at_vertex = {n: (-1) ** (n // 2) * np.sqrt(n + 1.0) for n in range(0, ZERNIKE_DEGREE + 1, 2)}
    total = sum(
        c * at_vertex[noll_orders(j)[0]]
        for j, c in enumerate(coeffs_um, 1)
        if noll_orders(j)[1] == 0
    )
    assert total == pytest.approx(0.0, abs=1e-9)


def test_what_the_fitted_terms_cannot_represent_has_no_coefficients() -> None:
    assert FilmShape(37.1).coeffs_um() is None
    finer_um = (*[0.0] * ZERNIKE_TERMS, 1.0)[:MAX_FILM_TERMS]
    assert (FilmShape(37.1, bowl="paraboloid", zernike_um=finer_um).coeffs_um() is None) == any(
        finer_um
    )
    assert FilmShape(37.1, bowl="paraboloid", ripples=(Ripple(1.0, 50.0),)).coeffs_um() is None


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: FilmShape(37.1, zernike_um=(0.0,) * 106),
            "zernike_um holds 106 terms; at most 105",
        ),
        (lambda: FilmShape(37.1, zernike_um=(float("nan"),)), "zernike_um: every value"),
        (lambda: FilmShape(float("inf")), "sag_mm = inf"),
        (lambda: FilmShape(37.1, radius_mm=0.0), "radius_mm = 0"),
        (
            lambda: FilmShape(37.1, bowl="cone"),
            "bowl = 'cone' must be one of hencky, paraboloid, sphere",
        ),  # type: ignore[arg-type]
        (lambda: Ripple(1.0, 0.0), "wavelength_mm = 0"),
        (lambda: Wrinkle(1.0, 0), "lobes = 0"),
        (lambda: Bump(1.0, 0.0, 0.0, -1.0), "sigma_mm = -1"),
    ],
)
def test_films_that_cannot_be_are_refused_by_their_field(
    make: Callable[[], object], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_a_typical_film_is_drawn_from_its_seed() -> None:
    one, again, other = (typical_film(37.1, 500.0, seed) for seed in (1, 1, 2))
    assert one == again
    assert one != other
    astigmatism = np.hypot(one.zernike_um[4], one.zernike_um[5])
    assert astigmatism == pytest.approx(300.0)


def test_films_cross_to_another_process() -> None:
    there = pickle.loads(pickle.dumps(RICH))
    x, y = np.array([200.0]), np.array([-100.0])
    assert there == RICH
    assert there.height_mm(x, y) == RICH.height_mm(x, y)


@pytest.mark.parametrize("mode", drum_modes(1.0))
def test_a_drum_mode_moves_the_film_inside_its_ring(mode: DrumMode) -> None:
    film = FilmShape(37.1, zernike_um=(0.0, 0.0, 0.0, 2.0, 1.0))
    x, y = (side.ravel() for side in np.meshgrid(*2 * [np.linspace(-500.0, 500.0, 141)]))
    inside = np.hypot(x, y) < 500.0
    x, y = x[inside], y[inside]
    moved_um = 1e3 * (
        film_heights(mode.displace_film(film), 37.1, x, y) - film_heights(film.terms, 37.1, x, y)
    )
    wanted = jv(mode.lobes, jn_zeros(mode.lobes, mode.circles)[-1] * np.hypot(x, y) / 500.0)
    wanted *= np.cos(mode.lobes * np.arctan2(y, x))
    assert moved_um == pytest.approx(wanted / np.sqrt(np.mean(wanted**2)), abs=0.02)
    angle = np.linspace(0, 2 * np.pi, 36)
    ring = 500.0 * np.cos(angle), 500.0 * np.sin(angle)
    assert (
        np.abs(
            film_heights(mode.displace_film(film), 37.1, *ring)
            - film_heights(film.terms, 37.1, *ring)
        ).max()
        < 1e-7
    )
