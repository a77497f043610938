"""The gas lens against the simulator's trace, which follows each ray through both faces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from membrane_ctrl.config.front_film import FrontFilmConfig, GasName
from membrane_ctrl.config.optics import MirrorConfig, OpticsConfig
from membrane_ctrl.metrology.rays.artefacts import Artefact
from membrane_ctrl.metrology.rays.bench_poses import BenchGeometry
from membrane_ctrl.metrology.rays.cushion import Cushion, CushionBench
from membrane_ctrl.metrology.rays.film_reflections import find_reflecting_rays, map_reflections
from membrane_ctrl.metrology.rays.forward_model import residual_mm
from membrane_ctrl.metrology.rays.gas_index import compute_gas_excess
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.ray_tracing import Points, Tracer, make_parabola
from membrane_ctrl.metrology.rays.set_phases import SetPhases
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.sim.optics.front_film import FrontFilm, gas_excess_of, make_front_film
from tests.worlds.cushion_phases import OPTICS, SAG_MM, CushionPhases, trace_phases

GEOMETRY = Geometry.from_config(OPTICS)
COLUMNS = np.arange(90.0, 530.0, 11.0)
ROWS = np.arange(30.0, 480.0, 11.0)
BOWL = Surface.hencky_bowl(SAG_MM, 500.0)


def front_of(cushion: Cushion | None) -> FrontFilm:
    """The simulator's film with the gas that the metrology assumes."""
    found = make_front_film(OPTICS.mirror, SAG_MM, None)
    assert found is not None
    assert cushion is not None
    return replace(found, gas_excess=cushion.gas_excess)


@pytest.fixture(scope="module")
def seen() -> CushionPhases:
    return trace_phases(front_of(GEOMETRY.cushion), COLUMNS, ROWS)


def predicted_mm(geometry: Geometry, seen: CushionPhases) -> np.ndarray:
    tracer = Tracer(geometry, 500.0)
    points = Points.from_rays(seen.rays, np.zeros((2, seen.column.size)))
    tracer.place_on_shape(points, make_parabola(SAG_MM, 500.0))
    tracer.intersect(points, BOWL, newton=4)
    return tracer.predict_screen(points, BOWL)


def test_the_predicted_screen_points_are_the_traced_ones(seen: CushionPhases) -> None:
    """0.02 um on the screen are 1 nm of height; without the lens the points are 6 um off."""
    assert predicted_mm(GEOMETRY, seen) == pytest.approx(seen.main_mm, abs=2e-5)
    without = predicted_mm(GEOMETRY.without_front_film(), seen)
    assert np.abs(without - seen.main_mm).max() > 4e-3


def test_measured_slopes_are_those_of_the_film(seen: CushionPhases) -> None:
    tracer = Tracer(GEOMETRY, 500.0)
    points = Points.from_rays(seen.rays, seen.main_mm)
    tracer.place_on_shape(points, make_parabola(SAG_MM, 500.0))
    tracer.intersect(points, BOWL, newton=4)
    field = tracer.slope_field(points, BOWL)
    assert field[2:4] == pytest.approx(field[4:6], abs=1e-8)


def test_the_calibration_model_has_the_same_lens(seen: CushionPhases) -> None:
    phases = SetPhases(
        "set", seen.column, seen.row, seen.main_mm, np.full(seen.column.size, 0.01), 0.0
    )
    left = residual_mm(BenchGeometry(GEOMETRY, 1.0), phases, BOWL, 0.0)
    assert left == pytest.approx(np.zeros_like(left), abs=2e-5)

    # An artefact in the mirror's place stands before no film.
    sphere = Artefact(1 / 3400, 1e-7, 1e-4, 0.0, 0.1, 500.0)
    alone = replace(phases, artefact=sphere)
    left = residual_mm(BenchGeometry(GEOMETRY, 1.0), alone, BOWL, 0.0)
    assert np.abs(left).max() > 4e-3


def test_a_deeper_mirror_has_another_lens(seen: CushionPhases) -> None:
    assert GEOMETRY.gas_lens is not None
    x_mm, y_mm = (np.ascontiguousarray(row) for row in seen.position_mm)
    usual = GEOMETRY.gas_lens.find_shift_mm(x_mm, y_mm, SAG_MM)
    deeper = GEOMETRY.gas_lens.find_shift_mm(x_mm, y_mm, SAG_MM + 1.0)
    assert 1e-5 < np.abs(deeper - usual).max() < 1e-3


def test_the_images_of_the_screen_are_the_traced_ones() -> None:
    """Without refraction, which moves them by micrometres of 200 mm."""
    pattern = OPTICS.pattern
    images = map_reflections(GEOMETRY, BOWL, 0.0, pattern)
    assert images is not None
    middle = trace_phases(front_of(GEOMETRY.cushion), np.arange(255.0, 357, 4), ROWS[15:28])
    shows = images.shows_pattern(middle.position_mm)
    reflected = np.abs(middle.seen_mm - middle.main_mm).max(axis=0) > 1e-3
    assert not np.any(reflected & ~shows)
    assert np.mean(shows) < 0.9


def test_the_part_with_reflections_is_a_small_one_in_the_middle() -> None:
    hidden = find_reflecting_rays(GEOMETRY, OPTICS, np.ascontiguousarray(_everywhere().rays))
    assert 0.01 < np.mean(hidden) < 0.04
    alone = GEOMETRY.without_front_film()
    assert not find_reflecting_rays(alone, OPTICS, _everywhere().rays).any()


def _everywhere() -> CushionPhases:
    return trace_phases(
        front_of(GEOMETRY.cushion), np.arange(80.0, 535, 5), np.arange(20.0, 495, 5)
    )


@pytest.mark.parametrize("gas", ["air", "nitrogen", "argon", "carbon_dioxide", "helium"])
def test_dispersion_and_density_give_the_same_index(gas: GasName) -> None:
    front = FrontFilmConfig(gas=gas)
    by_dispersion = compute_gas_excess(front, 600.0)
    assert by_dispersion == pytest.approx(gas_excess_of(front, 600.0), rel=0.03)


def test_a_single_film_has_no_lens() -> None:
    geometry = Geometry.from_config(OpticsConfig(mirror=MirrorConfig()))
    assert geometry.gas_lens is None
    assert geometry.cushion is None


def test_both_faces_without_gas_bend_rays_like_a_shell() -> None:
    """Without gas the film alone moves the points by 14 um, against the gas."""
    cushion = GEOMETRY.cushion
    assert cushion is not None
    rays = _everywhere().rays[:, ::50]
    start = np.repeat(GEOMETRY.pinhole_mm[:, None], rays.shape[1], axis=1)

    def moved_mm(changed: Cushion) -> np.ndarray:
        bench = CushionBench(changed, BOWL, 0.0, GEOMETRY.screen_origin_mm, GEOMETRY.screen_axes)
        return bench.trace_through(start, rays) - bench.trace_alone(start, rays)

    film_alone = moved_mm(replace(cushion, gas_excess=0.0))
    gas_alone = moved_mm(replace(cushion, thickness_mm=0.0))
    both = moved_mm(cushion)
    assert film_alone + gas_alone == pytest.approx(both, abs=1e-6)
    assert np.sum(film_alone * gas_alone) < 0
