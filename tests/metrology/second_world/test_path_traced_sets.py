"""Sets that a path tracer rendered: a mirror as triangles, a panel with pixels, a lens of finite
aperture, a lit room. Their truth is the film's shape that was rendered.
"""

from __future__ import annotations

import shutil
import tomllib
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import tomli_w

from tests.studies.path_traced_benches import renderer_error, sphere_places_mm
from tests.studies.second_world_errors import MeasuredErrors, drawn_points_mm, measured_errors
from tests.worlds.path_traced.committed_sets import FOLDER, committed_sets
from tests.worlds.path_traced.meshes import RAY_OFFSET, disc_surface, sphere_surface
from tests.worlds.path_traced.offset_compensation import tilt_normals
from tests.worlds.path_traced.panel_texture import PIXELS, panel_texture
from tests.worlds.second_optics import Bench, Mirror
from tests.worlds.second_optics.patterns import full_set

PAIRS = (("sound", "sound-lifted"), ("front-film", "front-film-lifted"))
TERMS = slice(1, 9)  # Noll 4..11 in the measured quantities
POINTS_MM = drawn_points_mm(np.random.default_rng(5), 10)


@cache
def _measured(name: str) -> MeasuredErrors:
    recipe = committed_sets()[name]
    return measured_errors(FOLDER / name, recipe.bench.mirror, recipe.truth(), POINTS_MM)


@pytest.mark.parametrize("name", committed_sets())
def test_the_figure_of_a_rendered_set_is_within_its_bars(name: str) -> None:
    found = _measured(name)
    assert found.verdict == "ok", found.reason
    assert found.worst_sigmas < 3.5


@pytest.mark.parametrize(("earlier", "later"), PAIRS)
def test_a_change_between_rendered_sets_is_exact_to_30_nm(earlier: str, later: str) -> None:
    first, second = _measured(earlier), _measured(later)
    assert first.error_um is not None
    assert second.error_um is not None
    change_um = second.error_um - first.error_um
    assert np.sqrt(np.mean(change_um[TERMS] ** 2)) < 0.03
    bars_um = second.change_sigma_um(first)
    assert np.all(np.abs(change_um) < 3.5 * bars_um)


def test_a_stated_front_film_and_the_gas_behind_it_leave_the_sag_as_without_them() -> None:
    """Without the gas in the rays the sag is 0.75 µm off, without the film's thickness 0.4 µm."""
    single, behind_film = _measured("sound"), _measured("front-film")
    assert single.error_um is not None
    assert behind_film.error_um is not None
    assert abs(behind_film.error_um[0] - single.error_um[0]) < 0.05


def test_a_rendered_front_film_that_is_not_stated_is_named(tmp_path: Path) -> None:
    folder = tmp_path / "set"
    shutil.copytree(FOLDER / "front-film", folder)
    table = tomllib.loads((folder / "capture.toml").read_text(encoding="utf-8"))
    del table["mirror"]["front_film"]
    (folder / "capture.toml").write_text(tomli_w.dumps(table), encoding="utf-8")
    recipe = committed_sets()["front-film"]
    found = measured_errors(folder, recipe.bench.mirror, recipe.truth(), POINTS_MM)
    assert found.verdict == "degraded"
    assert "mirror.front_film" in found.reason


def test_the_normals_of_a_spherical_mesh_point_to_its_centre() -> None:
    surface = sphere_surface(3400.0, 500.0)
    towards_mm = np.array([0.0, 0.0, 3400.0]) - surface.vertices_mm
    expected = towards_mm / np.linalg.norm(towards_mm, axis=1, keepdims=True)
    assert np.abs(surface.normals - expected).max() < 1e-12
    corners = surface.vertices_mm[surface.faces]
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.all(facing[:, 2] > 0)


def test_a_ray_from_a_deeper_mesh_leaves_along_the_line_of_the_true_surface() -> None:
    """Reflected at half the offset below, started half of it above: no sideways motion."""
    mirror = Mirror()
    surface = disc_surface(lambda x, y: mirror.position_mm(x, y, 0.0))
    deeper = surface.deeper_by_half_the_offset()
    offset_mm = RAY_OFFSET * (1 + np.abs(surface.vertices_mm).max(axis=1))
    moved_mm = np.sum((surface.vertices_mm - deeper.vertices_mm) * surface.normals, axis=1)
    assert np.allclose(moved_mm, offset_mm / 2)


def test_tilted_normals_send_the_rays_where_they_are_wanted() -> None:
    surface = sphere_surface(3400.0, 500.0)
    bench = Bench.paper(0.125)
    wanted_mm = np.stack([0.05 * np.ones(len(surface.normals)), -0.03 * surface.normals[:, 0]])
    there = tilt_normals(surface, bench, wanted_mm)
    back = tilt_normals(there, bench, -wanted_mm)
    assert np.abs(there.normals - surface.normals).max() > 1e-6
    assert np.abs(back.normals - surface.normals).max() < 1e-8
    # a flat-on ray: the screen is 2871 mm away, a tilt counts twice
    tilt = np.linalg.norm(there.normals[0] - surface.normals[0])
    assert tilt == pytest.approx(0.05 / (2 * 2871.0), rel=0.05)


def test_the_panel_shows_each_pattern_pixel_by_pixel() -> None:
    pictures = full_set()
    texture = panel_texture(pictures[:3])
    assert texture.shape == (4 * PIXELS, 4 * PIXELS, 3)
    pixel = texture[40:44, 80:84, 0]
    assert np.all(pixel[:3, :3] == pixel[0, 0])
    assert np.allclose(pixel[3], 0.3 * pixel[0, 0])
    phase = np.arctan2(
        texture[::4, ::4, 1] - 0.5,
        texture[::4, ::4, 0] - 0.5,
    )  # steps 0 and 90 degrees
    turns = np.unwrap(phase[0]) / (2 * np.pi)
    assert abs(abs(turns[-1] - turns[0]) - 8 * (PIXELS - 1) / PIXELS) < 0.01


def test_mitsuba_renders_a_sphere_as_its_closed_form_gives_it() -> None:
    pytest.importorskip("mitsuba", reason="the extra `render` is not installed")
    found = renderer_error(samples=4)
    assert found.mean_um < 10
    assert found.blocks_um < 30
    places_mm, inside = sphere_places_mm(Bench.paper(0.125), 500.0)
    assert inside.mean() > 0.3
    assert np.ptp(places_mm[0][inside]) > 200
