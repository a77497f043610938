"""`measure` on cushions of the second world: a film of another law, traced by other code."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from membrane_ctrl.measure.measurement import measure_set
from membrane_ctrl.metrology.figure.reflection_fit import ReflectionState
from tests.worlds.second_optics import Bench, ClearFilm, Effects, Mirror, Sensor, Stated, World
from tests.worlds.second_optics.clear_film import trace_cushion
from tests.worlds.second_optics.rays import trace

EFFECTS = Effects(sensor=Sensor(bits=12))
EIGHTH = Bench.paper(0.125)


def test_a_film_that_does_nothing_changes_no_ray() -> None:
    mirror = Mirror()
    column, row = np.random.default_rng(1).uniform([80, 60], [220, 190], (100, 2)).T
    alone = trace(EIGHTH, mirror, column, row, 0.0)
    nothing = ClearFilm(thickness_mm=0.0, gas_excess=0.0)
    through = trace_cushion(EIGHTH, mirror, nothing, column, row, 0.0)
    assert through.screen_mm == pytest.approx(alone.screen_mm, abs=1e-8)


def test_a_film_that_is_not_stated_is_named(tmp_path: Path) -> None:
    World(Mirror(), EIGHTH, EFFECTS, seed=1, clear_film=ClearFilm()).write_set(tmp_path / "s")
    measurement = measure_set(tmp_path / "s")
    assert measurement.verdict == "degraded"
    assert "a second reflection of the screen at" in measurement.reason


@pytest.mark.campaign
def test_a_stated_film_leaves_the_figure_of_a_single_one(tmp_path: Path) -> None:
    """Sag and zero of the map within 0.05 um of those of the same mirror without a film."""
    bench = Bench.paper(0.25)
    stated = Stated(sigma_share=0.01, front_film={"bulge_mm": 63.4})
    alone = Stated(sigma_share=0.01)
    World(Mirror(), bench, EFFECTS, alone, seed=1).write_set(tmp_path / "single")
    clear = World(Mirror(), bench, EFFECTS, stated, seed=1, clear_film=ClearFilm(tilt=(1e-3, 0)))
    clear.write_set(tmp_path / "cushion")
    single = measure_set(tmp_path / "single").full
    cushion = measure_set(tmp_path / "cushion")
    assert cushion.verdict == "ok"
    assert single is not None
    assert cushion.full is not None
    assert cushion.full.reflections is not None
    assert cushion.full.reflections.state is ReflectionState.FITTED
    sag_um = 1e3 * (cushion.full.surface.sag_mm - single.surface.sag_mm)
    assert abs(sag_um) < 0.05
    change_um = 1e3 * (cushion.full.height_mm() - single.height_mm())
    assert abs(float(np.nanmedian(change_um))) < 0.05
    assert float(np.nanmax(np.abs(change_um))) < 0.3


def test_reflections_of_a_path_traced_film_are_fitted() -> None:
    """What is left is the renderer's noise; the film's law differs from Hencky's as here."""
    full = measure_set(Path("tests/data/path_traced/front-film")).full
    assert full is not None
    fit = full.reflections
    assert fit is not None
    assert fit.state is ReflectionState.FITTED
    assert fit.after_rad < 0.4 * fit.before_rad  # noise of 144 paths a pixel
    assert fit.errors == pytest.approx([-1.2, 0, 0, 0, 0, 1.3], abs=0.3)
