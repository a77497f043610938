"""The figure's change by climate, against a film of this file's own equations, and expansions
learned from a night of that film.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from scipy.integrate import solve_bvp

from membrane_ctrl.control.climate import CHANGE_CENTRE, CHANGE_RMS, CHANGE_SPHERICAL
from membrane_ctrl.metrology.film.climate_figure import compute_climate_sensitivity
from membrane_ctrl.metrology.film.climate_fit import Expansion, fit_climate
from tests.worlds.climate_terms import ROUND_TERMS, compute_figure_change_per_ppm

RADIUS_MM = 500.0
SAG_MM = 37.1
NU = 0.38
SIDE = np.linspace(1e-6, 1.0, 200)


def _bowl(load: float, strain: float) -> np.ndarray:
    """Height over the radius at `SIDE` of a heated film, by collocation of Reissner's two equations
    for finite rotations of a film.

    With H the horizontal force, in E t, and beta the slope's angle: the vertical balance is
    H tan(beta) = q r / 2, and the hoop's strain (H' r - nu H / cos(beta)) + strain closes with the
    meridian's.
    """

    def slope_of(r: np.ndarray, h: np.ndarray) -> np.ndarray:
        return np.arctan(load * r / (2 * h))

    def equations(r: np.ndarray, y: np.ndarray) -> np.ndarray:
        h, u = y
        beta = slope_of(r, h)
        meridian_force = h / np.cos(beta)
        hoop_strain = u / r
        # Hooke: e_t = n_t - nu n_m + strain, e_m = n_m - nu n_t + strain
        n_t = hoop_strain - strain + NU * meridian_force
        meridian_strain = meridian_force - NU * n_t + strain
        # Balance along r: d(r H) / dr = n_t (1 + e_m); du/dr = (1 + e_m) cos(beta) - 1
        return np.array(
            [
                (n_t * (1 + meridian_strain) - h) / r,
                (1 + meridian_strain) * np.cos(beta) - 1,
            ]
        )

    def ends(left: np.ndarray, right: np.ndarray) -> np.ndarray:
        return np.array([left[1], right[1]])

    guess = np.array([np.full_like(SIDE, 0.3 * load ** (2 / 3)), 0 * SIDE])
    solved = solve_bvp(equations, ends, SIDE, guess, tol=1e-6, max_nodes=2000)
    assert solved.success
    h, u = solved.sol(SIDE)
    beta = slope_of(SIDE, h)
    n_t = u / SIDE - strain + NU * h / np.cos(beta)
    rise = (1 + h / np.cos(beta) - NU * n_t + strain) * np.sin(beta)
    height = np.concatenate([[0.0], np.cumsum((rise[1:] + rise[:-1]) / 2 * np.diff(SIDE))])
    # Over the radius at which the film is under its load
    return np.asarray(np.interp(SIDE, SIDE + u, height))


@cache
def _height_at_sag_mm(strain_ppm: float) -> np.ndarray:
    """Height in mm of the film at the held sag: the load is searched by secants."""
    loads = [3.6e-4, 3.7e-4]
    sags = [RADIUS_MM * _bowl(load, 1e-6 * strain_ppm)[-1] for load in loads]
    for _ in range(4):
        slope = (sags[-1] - sags[-2]) / (loads[-1] - loads[-2])
        if abs(sags[-1] - SAG_MM) < 1e-6 or slope == 0:
            break
        loads.append(loads[-1] + (SAG_MM - sags[-1]) / slope)
        sags.append(RADIUS_MM * _bowl(loads[-1], 1e-6 * strain_ppm)[-1])
    return np.asarray(RADIUS_MM * _bowl(loads[-1], 1e-6 * strain_ppm))


def _rms(values: np.ndarray) -> float:
    """Over the disc."""
    area = np.gradient(SIDE**2)
    return float(np.sqrt(np.sum(values**2 * area) / area.sum()))


def _predicted_um(excess_ppm: float) -> np.ndarray:
    terms = excess_ppm * compute_climate_sensitivity(RADIUS_MM, SAG_MM).terms_um
    x = 2 * SIDE**2 - 1
    basis = [np.polynomial.legendre.Legendre.basis(k)(x) for k in range(4)]
    return np.asarray(
        sum(terms[j - 1] * math.sqrt(2 * k + 1) * basis[k] for k, j in enumerate(ROUND_TERMS))
    )


@pytest.mark.parametrize("excess_ppm", [100.0, pytest.param(-90.0, marks=pytest.mark.campaign)])
def test_the_change_of_the_figure_is_predicted_within_a_micrometre(excess_ppm: float) -> None:
    """100 ppm are a day's 10 % of humidity and 2 K."""
    true_um = 1e3 * (_height_at_sag_mm(excess_ppm) - _height_at_sag_mm(0.0))
    assert _rms(true_um) > 5.0
    assert _rms(_predicted_um(excess_ppm) - true_um) < 1.0


def test_the_tick_predicts_by_the_constants_of_the_law() -> None:
    for radius_mm, sag_mm in ((500.0, 37.1), (300.0, 10.0)):
        sensitivity = compute_climate_sensitivity(radius_mm, sag_mm)
        unit_um = 1e-3 * radius_mm**2 / sag_mm
        assert sensitivity.change_rms_um / unit_um == pytest.approx(CHANGE_RMS, rel=1e-3)
        assert sensitivity.terms_um[10] / unit_um == pytest.approx(CHANGE_SPHERICAL, rel=1e-3)
        assert sensitivity.centre_um / unit_um == pytest.approx(CHANGE_CENTRE, rel=1e-3)


def test_the_twin_changes_its_figure_equally_by_another_law() -> None:
    terms_um = compute_climate_sensitivity(RADIUS_MM, SAG_MM).terms_um
    predicted = [terms_um[noll - 1] for noll in ROUND_TERMS]
    assert 100 * compute_figure_change_per_ppm() == pytest.approx(
        100 * np.array(predicted), abs=0.5
    )


def _night(seed: int, noise_um: float = 0.05) -> dict[str, np.ndarray]:
    """Ten hours, a value each minute: a room that cools, a heating that switches, humidity that
    people bring; the true expansions are 18.2, 22.6 and 7.4, the moisture's time constant 1500 s.
    """
    rng = np.random.default_rng(seed)
    time_s = 60.0 * np.arange(600)
    air = -1.5 * time_s / time_s[-1] + 0.3 * np.sign(np.sin(2 * np.pi * time_s / 5400.0))
    humidity = 45 + 5 * np.cos(2 * np.pi * time_s / 30_000.0) + 2 * np.sin(time_s / 4000.0)
    film, ring, moisture = np.zeros((3, 600))
    moisture[0] = humidity[0]
    for k in range(1, 600):
        film[k] = film[k - 1] + (air[k] - film[k - 1]) * (1 - math.exp(-60 / 90.0))
        ring[k] = ring[k - 1] + (air[k] - ring[k - 1]) * (1 - math.exp(-60 / 6000.0))
        step = humidity[k] - moisture[k - 1]
        moisture[k] = moisture[k - 1] + step * (1 - math.exp(-60 / 1500.0))
    excess = 18.2 * film - 22.6 * ring + 7.4 * (moisture - moisture[0])
    spherical_per_ppm = _own_spherical_um_per_ppm()
    creep_um = 0.2 * time_s / time_s[-1]
    return {
        "time_s": time_s,
        "spherical_um": spherical_per_ppm * excess + creep_um + noise_um * rng.standard_normal(600),
        "film_c": 21 + film + 0.0065 * rng.standard_normal(600),
        "ring_c": 21 + ring + 0.005 * rng.standard_normal(600),
        "humidity_percent": humidity + 0.02 * rng.standard_normal(600),
    }


@cache
def _own_spherical_um_per_ppm() -> float:
    """Noll 11 of this file's film."""
    change_um = 10 * (_height_at_sag_mm(50.0) - _height_at_sag_mm(-50.0))
    area = np.gradient(SIDE**2)
    basis = math.sqrt(5) * np.polynomial.legendre.Legendre.basis(2)(2 * SIDE**2 - 1)
    return float(np.sum(area * basis * change_um) / area.sum())


def test_a_night_gives_the_expansions_within_five_per_cent() -> None:
    sensitivity = compute_climate_sensitivity(RADIUS_MM, SAG_MM).terms_um[10]
    misses = []
    for seed in range(2):
        known_ring = Expansion(23.0, 0.7)  # of aluminium
        found = fit_climate(
            **_night(seed), sensitivity_um_per_ppm=sensitivity, known_ring=known_ring
        )
        pairs = ((found.film_per_k, 18.2), (found.ring_per_k, 22.6), (found.film_per_percent, 7.4))
        for expansion, true in pairs:
            assert expansion is not None
            assert expansion.value == pytest.approx(true, rel=0.05)
            misses.append((expansion.value - true) / expansion.sigma)
        assert found.follows_humidity_s == pytest.approx(1500.0, rel=0.2)
        assert found.explained > 0.95
    assert np.sqrt(np.mean(np.square(misses))) < 2.0


def test_an_air_conditioner_of_a_quarter_of_an_hour_shows_the_film() -> None:
    """Its waves are as long as the usual smoothing, which would average them away."""
    rng = np.random.default_rng(1)
    time_s = 60.0 * np.arange(300)
    film_c = 0.5 * np.cos(2 * np.pi * time_s / 900.0)
    sensitivity = compute_climate_sensitivity(RADIUS_MM, SAG_MM).terms_um[10]
    spherical_um = 18.5 * sensitivity * film_c + 0.01 * rng.standard_normal(300)
    none = np.full(300, np.nan)
    seen_c = 21.0 + film_c + 0.0065 * rng.standard_normal(300)
    found = fit_climate(time_s, spherical_um, seen_c, none, none, sensitivity)
    assert found.film_per_k is not None
    assert found.film_per_k.value == pytest.approx(18.5, rel=0.05)
    assert abs(found.film_per_k.value - 18.5) < 3 * found.film_per_k.sigma


def test_a_cause_that_does_not_change_is_not_fitted() -> None:
    night = _night(1)
    night["humidity_percent"] = np.full(600, np.nan)
    night["spherical_um"] = np.random.default_rng(1).standard_normal(600)
    found = fit_climate(**night, sensitivity_um_per_ppm=0.08)
    assert found.film_per_percent is None
    with pytest.raises(ValueError, match="hours"):
        fit_climate(
            **{name: values[:20] for name, values in night.items()}, sensitivity_um_per_ppm=1
        )
    still = {**night, "film_c": np.full(600, 21.0), "ring_c": np.full(600, 21.0)}
    with pytest.raises(ValueError, match="neither"):
        fit_climate(**still, sensitivity_um_per_ppm=0.08)


def test_noise_about_the_bowl_of_the_film_is_not_explained_by_the_climate() -> None:
    """The film's bowl alone has a spherical term of a hundred micrometres."""
    rng = np.random.default_rng(3)
    time_s = 60.0 * np.arange(600)
    none = np.full(600, np.nan)
    found = fit_climate(
        time_s,
        -150.0 + 0.05 * rng.standard_normal(600),
        21.0 + np.cos(2 * np.pi * time_s / 20_000.0),
        none,
        none,
        sensitivity_um_per_ppm=0.08,
    )
    assert abs(found.explained) < 0.1
