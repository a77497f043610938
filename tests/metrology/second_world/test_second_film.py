"""The film of the second world against Hencky's solution and against finer ones of itself."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.metrology_truth import hencky_depth
from tests.worlds.second_optics import Material, Mirror, Ring, drawn_mirror
from tests.worlds.second_optics.film import FilmSolver

HENCKY_CENTRE = 0.65344  # of radius times load^(1/3), Poisson ratio 0.3
ORTHOTROPIC = Material(0.9, 0.35, None, 0.4, (1e-4, 2e-4, 5e-5), (0.01, -0.02))
RING = Ring({2: (3e-4, 1e-4), 3: (1e-4, 0.0)}, {2: (1e-4, 2e-4)})


def test_a_shallow_isotropic_film_is_henckys() -> None:
    depth = 0.002  # radii; finite strains change the form by depth^2
    shape, _ = FilmSolver(Material()).solve(depth)
    radius = np.linspace(0, 1, 21)
    profile = 1 + shape.w.values(radius, 0 * radius)[0] / depth
    assert shape.load == pytest.approx((depth / HENCKY_CENTRE) ** 3, rel=1e-4)
    assert profile == pytest.approx(hencky_depth(radius), abs=1e-6)


def test_finite_strains_change_a_deep_film_by_micrometres() -> None:
    """37 mm of 500 mm: at the same sag tens of micrometres beside Hencky's form."""
    mirror = Mirror()
    radius_mm = np.linspace(0, 500, 51)
    height_mm = mirror.height_mm(radius_mm, 0 * radius_mm, 0.0)
    beside_um = 1e3 * (height_mm - height_mm[-1] * hencky_depth(radius_mm / 500))
    assert 10 < np.abs(beside_um).max() < 100


def test_a_finer_basis_gives_the_same_orthotropic_film() -> None:
    place = np.random.default_rng(1).uniform(-0.7, 0.7, (2, 50))
    heights = []
    for degree in (14, 18):
        shape, _ = FilmSolver(ORTHOTROPIC, RING, degree).solve(0.0742)
        heights.append(shape.w.values(*place)[0])
    assert 500e3 * np.abs(heights[1] - heights[0]).max() < 0.02  # um


def test_an_orthotropic_film_has_twofold_symmetry_about_its_direction() -> None:
    mirror = Mirror(material=Material(ratio=0.9, direction_rad=0.5))
    angle = np.array([0.5, 0.5 + np.pi, 0.5 + np.pi / 2, 0.5 + 0.3, 0.5 - 0.3])
    along, opposite, across, left, right = mirror.height_mm(
        300 * np.cos(angle), 300 * np.sin(angle), 0.0
    )
    assert along == pytest.approx(opposite, abs=1e-9)
    assert left == pytest.approx(right, abs=1e-9)
    assert abs(along - across) > 0.01  # mm


def test_the_ring_is_where_it_is_prescribed() -> None:
    shape, _ = FilmSolver(ORTHOTROPIC, RING).solve(0.05)
    angle = np.linspace(0, 6, 13)
    x, y = np.cos(angle), np.sin(angle)
    u, v, w = (part.values(x, y)[0] for part in (shape.u, shape.v, shape.w))
    wider = 1e-4 * np.cos(2 * angle) + 2e-4 * np.sin(2 * angle)
    height = 3e-4 * np.cos(2 * angle) + 1e-4 * np.sin(2 * angle) + 1e-4 * np.cos(3 * angle)
    assert u * x + v * y == pytest.approx(wider, abs=1e-12)
    assert v * x - u * y == pytest.approx(0 * angle, abs=1e-12)
    assert w == pytest.approx(height, abs=1e-12)


def test_between_solved_displacements_a_parabola_is_enough() -> None:
    mirror = drawn_mirror(np.random.default_rng(2), orthotropic=True)
    solver = FilmSolver(mirror.material, mirror.ring)
    solved, _ = solver.solve((mirror.sag_mm + 0.137) / mirror.radius_mm)
    place = np.linspace(-0.6, 0.6, 9)
    between, _, _ = mirror.position_mm(place, place, 137.0)
    exact_mm = mirror.sag_mm + mirror.radius_mm * solved.w.values(place, place)[0]
    assert between[2] == pytest.approx(exact_mm, abs=1e-7)
