"""Rows of the budget for a front film against the simulator's trace with that error planted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from membrane_ctrl.config.schema import MirrorConfig, OpticsConfig
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.ray_tracing import Points, Tracer
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.metrology.uncertainty.front_film_error import front_film_sources
from membrane_ctrl.metrology.uncertainty.trial_bench import TrialBench
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.sim.optics.film_shape import FilmShape
from membrane_ctrl.sim.optics.front_film import FrontFilm, make_front_film
from tests.worlds.cushion_phases import OPTICS, SAG_MM, CushionPhases, trace_phases

BOWL = Surface.hencky_bowl(SAG_MM, 500.0)
COLUMNS = np.arange(90.0, 530.0, 9.0)
ROWS = np.arange(30.0, 480.0, 9.0)


def front() -> FrontFilm:
    found = make_front_film(OPTICS.mirror, SAG_MM, None)
    assert found is not None
    return found


@pytest.fixture(scope="module")
def nominal() -> CushionPhases:
    return trace_phases(front(), COLUMNS, ROWS)


@pytest.fixture(scope="module")
def bench(nominal: CushionPhases) -> TrialBench:
    return bench_of(OPTICS, nominal)


def bench_of(optics: OpticsConfig, seen: CushionPhases) -> TrialBench:
    tracer = Tracer(Geometry.from_config(optics), 500.0)
    points = Points.from_rays(seen.rays, np.zeros((2, seen.column.size)))
    tracer.place_on_shape(points, BOWL.height)
    tracer.intersect(points, BOWL, newton=3)
    points.screen_mm[:] = tracer.predict_screen(points, BOWL)
    places_px = np.stack([seen.column, seen.row])
    exact = np.zeros(points.screen_mm.shape)
    return TrialBench.from_points(optics, tracer, BOWL, points, places_px, exact, 10_000)


def planted_mm(bench: TrialBench, nominal: CushionPhases, other: FrontFilm) -> FloatArray:
    """Error of the parameters by another front film than the nominal one."""
    off_mm = trace_phases(other, COLUMNS, ROWS).main_mm - nominal.main_mm
    return bench.solve(bench.geometry(), off_mm, linear=True) - BOWL.parameters


def row_mm(bench: TrialBench, name: str, column: int) -> FloatArray:
    rows = {source.name: source for source in front_film_sources(bench)}
    return rows[name].effects_mm[:, column]


@pytest.mark.parametrize(
    ("name", "column", "other"),
    [
        ("front_film_bulge_mm", 0, replace(front(), shape=FilmShape(64.4))),
        ("front_film_gas", 0, replace(front(), gas_excess=1.1 * front().gas_excess)),
        ("front_film_thickness_um", 0, replace(front(), thickness_mm=0.0103)),
    ],
)
def test_a_row_is_the_error_of_a_planted_film(
    bench: TrialBench, nominal: CushionPhases, name: str, column: int, other: FrontFilm
) -> None:
    found = row_mm(bench, name, column)
    planted = planted_mm(bench, nominal, other)
    assert np.linalg.norm(planted) > 1e-7
    assert np.linalg.norm(found - planted) < 0.05 * np.linalg.norm(planted) + 3e-8


def test_a_saddle_of_the_film_has_the_planted_effect(
    bench: TrialBench, nominal: CushionPhases
) -> None:
    """Noll's term 6, sqrt(6) (x^2 - y^2): 0.7 mm on the rim are 286 um of it."""
    saddle_um = (0.0,) * 5 + (1e3 * 0.7 / np.sqrt(6),)
    lower = front()
    other = replace(lower, shape=FilmShape(63.4, zernike_um=saddle_um), thickness_mm=0.0)
    smooth = replace(lower, thickness_mm=0.0)
    off_mm = (
        trace_phases(other, COLUMNS, ROWS).main_mm - trace_phases(smooth, COLUMNS, ROWS).main_mm
    )
    planted = bench.solve(bench.geometry(), off_mm, linear=True) - BOWL.parameters
    found = row_mm(bench, "front_film_form_mm", 0)
    # The film's depth is given, so that its height is of the other sign.
    same = min(np.linalg.norm(found - planted), np.linalg.norm(found + planted))
    assert same < 0.2 * np.linalg.norm(planted)


def test_all_rows_together_are_hundredths_of_a_micrometre(bench: TrialBench) -> None:
    sources = front_film_sources(bench)
    assert len(sources) == 4
    for source in sources:
        rms_um = 1e3 * np.sqrt(np.sum(source.effects_mm**2))
        assert 1e-4 < rms_um < 0.5


def test_a_single_film_has_no_rows(nominal: CushionPhases) -> None:
    alone = OPTICS.model_copy(update={"mirror": MirrorConfig()})
    assert front_film_sources(bench_of(alone, nominal)) == []
