"""What the fitted reflections of a front film leave, against reflections with planted errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from membrane_ctrl.metrology.figure.reflection_fit import (
    ReflectionFit,
    fit_reflections,
    remove_reflections,
)
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.ray_tracing import Tracer
from membrane_ctrl.metrology.rays.surface import PARAMETERS, Surface
from membrane_ctrl.metrology.uncertainty.reflection_error import (
    ReflectionError,
    _PartGrid,
    _SlopesOfScreen,
    find_reflection_error,
)
from membrane_ctrl.sim.optics.front_film import make_front_film
from tests.worlds.cushion_phases import OPTICS, SAG_MM, CushionPhases, trace_phases

GEOMETRY = Geometry.from_config(OPTICS)
BOWL = Surface.hencky_bowl(SAG_MM, 500.0)
COLUMNS, ROWS = np.arange(255.0, 357.0, 2), np.arange(215.0, 297.0, 2)
PIXEL_MM = 2.3
NOISE_MM = 0.03


def fit_of(seen: CushionPhases) -> ReflectionFit:
    fit = fit_reflections(
        GEOMETRY,
        BOWL,
        0.0,
        OPTICS.pattern,
        1.0,
        seen.position_mm,
        seen.seen_mm,
        seen.main_mm + 0.05,
        PIXEL_MM,
    )
    assert fit is not None
    return fit


def error_of(fit: ReflectionFit) -> ReflectionError:
    error = find_reflection_error(fit, Tracer(GEOMETRY, 500.0), BOWL, 1e-9 * np.eye(PARAMETERS))
    assert error is not None
    return error


def caused_zero_um(seen: CushionPhases, fit: ReflectionFit) -> float:
    """Error of the zero by the screen points that the removal leaves, without their noise."""
    clean_mm = seen.seen_mm.copy()
    remove_reflections(
        fit, OPTICS.pattern, seen.position_mm, clean_mm, seen.main_mm + 0.05, PIXEL_MM
    )
    assert fit.left is not None
    part = fit.map.shows_pattern(seen.position_mm)
    whole = replace(fit.left, position_mm=seen.position_mm[:, part])
    slopes = _SlopesOfScreen(Tracer(GEOMETRY, 500.0), BOWL, whole.position_mm)
    left_mm = (clean_mm - seen.main_mm)[:, part]
    return 1e3 * _PartGrid(whole).compute_zero_mm(slopes.change(left_mm))


@pytest.mark.campaign
def test_the_stated_zero_agrees_with_the_caused_one() -> None:
    """Random films of the twin, whose form is not one that the fit knows."""
    caused, stated = [], []
    for seed in range(1, 13):
        front = make_front_film(OPTICS.mirror, SAG_MM, seed)
        assert front is not None
        seen = trace_phases(front, np.arange(255.0, 357.0), np.arange(215.0, 297.0))
        fit = fit_of(seen)
        caused.append(caused_zero_um(seen, fit))
        stated.append(error_of(fit).zero_um)
    ratio = np.sqrt(np.mean(np.square(caused)) / np.mean(np.square(stated)))
    print("caused over stated:", ratio, np.round(caused, 4), np.round(stated, 4))
    assert 1 / 1.5 < ratio < 1.5


def test_the_shares_of_light_are_known_with_their_sigma() -> None:
    """Noise of the phases, 4 times: the shares scatter as stated."""
    front = make_front_film(OPTICS.mirror, SAG_MM, 1)
    assert front is not None
    exact = trace_phases(front, COLUMNS, ROWS)
    shares, stated = [], []
    for seed in range(4):
        noise = np.random.default_rng(seed).normal(0.0, NOISE_MM, exact.seen_mm.shape)
        fit = fit_of(replace(exact, seen_mm=exact.seen_mm + noise))
        assert fit.left is not None
        shares.append(fit.shares)
        stated.append(fit.left.share_sigmas)
    scatter = np.sqrt(np.mean(np.var(shares, axis=0, ddof=1)))
    assert 1 / 1.5 < scatter / np.sqrt(np.mean(np.square(stated))) < 1.5


def test_a_planted_share_has_the_effect_of_the_row() -> None:
    """Light of both images 1 sigma brighter than fitted: the same error of zero and parameters."""
    front = make_front_film(OPTICS.mirror, SAG_MM, 1)
    assert front is not None
    seen = trace_phases(front, COLUMNS, ROWS)
    fit = fit_of(seen)
    assert fit.left is not None
    # All of the covariance in the share of the first image
    known = np.zeros_like(fit.left.covariance)
    planted = 0.005
    known[-2, -2] = planted**2
    alone = replace(fit, left=replace(fit.left, covariance=known))
    stated = error_of(alone)
    brighter = replace(fit, shares=fit.shares + np.array([planted, 0.0]))
    caused_um = caused_zero_um(seen, brighter) - caused_zero_um(seen, fit)
    assert stated.source.sigma == pytest.approx(planted)
    assert abs(caused_um) > 0.001
    assert 1 / 1.5 < stated.by_fit_um / abs(caused_um) < 1.5
    assert np.count_nonzero(np.abs(stated.source.effects_mm).sum(axis=0) > 1e-15) == 1
