"""Reflections of a front film, as the simulator traces them, are fitted and removed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from membrane_ctrl.metrology.figure.reflection_fit import (
    ReflectionFit,
    ReflectionState,
    fit_reflections,
    remove_reflections,
)
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.sim.optics.film_shape import FilmShape
from membrane_ctrl.sim.optics.front_film import FrontFilm, make_front_film
from tests.worlds.cushion_phases import OPTICS, SAG_MM, CushionPhases, trace_phases

GEOMETRY = Geometry.from_config(OPTICS)
MIDDLE = np.arange(255.0, 357.0), np.arange(215.0, 297.0)
PIXEL_MM = 2.3
MM_TO_SLOPE = 1 / (2 * 2871.0)


def front_of(seed: int | None) -> FrontFilm:
    found = make_front_film(OPTICS.mirror, SAG_MM, seed)
    assert found is not None
    return found


def expected_of(seen: CushionPhases) -> np.ndarray:
    """The surface of the bins is not exact."""
    return seen.main_mm + 0.05


def fit_of(seen: CushionPhases) -> ReflectionFit:
    fit = fit_reflections(
        GEOMETRY,
        Surface.hencky_bowl(SAG_MM, 500.0),
        0.0,
        OPTICS.pattern,
        1.0,
        seen.position_mm,
        seen.seen_mm,
        expected_of(seen),
        PIXEL_MM,
    )
    assert fit is not None
    return fit


@pytest.mark.fast_cases("None", "1")
@pytest.mark.parametrize("seed", [None, 1, 2, 3, 4])
def test_reflections_of_a_mounted_film_are_removed(seed: int | None) -> None:
    """What is left is a hundredth of a micrometre: 1 mm on the screen before, 0.02 mm after."""
    seen = trace_phases(front_of(seed), *MIDDLE)
    before_mm = np.abs(seen.seen_mm - seen.main_mm).max()
    fit = fit_of(seen)
    assert fit.state is ReflectionState.FITTED
    clean_mm = seen.seen_mm.copy()
    lost = remove_reflections(
        fit, OPTICS.pattern, seen.position_mm, clean_mm, expected_of(seen), PIXEL_MM
    )
    left_mm = np.abs(clean_mm - seen.main_mm)[:, ~lost]
    assert before_mm > 1.0
    assert np.sqrt(np.mean(left_mm**2)) < 0.02
    assert left_mm.max() < 0.3
    assert not lost.any()


def test_the_fit_measures_the_bulge() -> None:
    front = front_of(None)
    other = replace(front, shape=FilmShape(64.9))
    fit = fit_of(trace_phases(other, *MIDDLE))
    assert fit.errors[0] == pytest.approx(1.5, abs=0.15)
    assert fit.errors[1:5] == pytest.approx(np.zeros(4), abs=0.1)
    expected = np.array(front.image_shares) / front.transmittance**2
    assert fit.shares == pytest.approx(expected, rel=0.03)


def test_a_stated_film_that_is_not_there_is_named() -> None:
    seen = trace_phases(front_of(None), *MIDDLE)
    noise = np.random.default_rng(1).normal(0.0, 0.01, seen.main_mm.shape)
    fit = fit_of(replace(seen, seen_mm=seen.main_mm + noise))
    assert fit.state is ReflectionState.ABSENT
    assert "not seen" in fit.doubt


def test_reflections_elsewhere_are_left_out() -> None:
    """A film that leans by 1 degree: the predicted part of the mirror does not show them."""
    seen = trace_phases(front_of(None), *MIDDLE)
    rng = np.random.default_rng(1)
    ripples = rng.normal(0.0, 1.0, seen.main_mm.shape)
    fit = fit_of(replace(seen, seen_mm=seen.main_mm + ripples))
    assert fit.state is not ReflectionState.FITTED
    if fit.state is ReflectionState.UNEXPLAINED:
        clean_mm = seen.seen_mm.copy()
        lost = remove_reflections(
            fit, OPTICS.pattern, seen.position_mm, clean_mm, expected_of(seen), PIXEL_MM
        )
        assert lost.any()
