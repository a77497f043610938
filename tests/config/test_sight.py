"""Is a stated geometry plausible? Benches that are not, each with the key to check; and odd ones
that are sound.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from membrane_ctrl.config.schema import Config, GeometryConfig, OpticsConfig, PatternConfig
from membrane_ctrl.config.sight import compute_poses, find_doubt, find_lens_fold_px, trace_view
from membrane_ctrl.config.toml_file import parse_tables
from membrane_ctrl.controller.cross_check import cross_check
from membrane_ctrl.sim.optics.bench_poses import camera_pose, screen_pose
from membrane_ctrl.sim.optics.film_shape import FilmShape
from membrane_ctrl.sim.optics.trace import trace_rays

SHORT = {"a_mm": 2672.0, "b_mm": 2871.0, "alpha_deg": 80.9}


def optics_of(geometry: dict[str, Any] | None = None, **tables: dict[str, Any]) -> OpticsConfig:
    return parse_tables({"geometry": SHORT | (geometry or {}), **tables}, OpticsConfig, "test")


def turned(axis: int, degrees: float) -> np.ndarray[Any, Any]:
    """A rotation about a world axis."""
    cosine, sine = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    a, b = ((1, 2), (2, 0), (0, 1))[axis]
    matrix = np.eye(3)
    matrix[[a, b, a, b], [a, b, b, a]] = cosine, cosine, -sine, sine
    return matrix


def general(
    camera: np.ndarray[Any, Any] | None = None,
    screen: np.ndarray[Any, Any] | None = None,
    shift_mm: float = 0.0,
    everything: np.ndarray[Any, Any] | None = None,
    flip: float = 1.0,
) -> OpticsConfig:
    """The paper's bench in the general form, with parts of it turned
    in world or moved along s_x.
    """
    pinhole, rotation, origin, s_x, s_y = compute_poses(GeometryConfig(**SHORT))
    none = np.eye(3)
    camera, screen, everything = (
        none if turn is None else turn for turn in (camera, screen, everything)
    )
    rows = (rotation @ camera.T) @ everything.T
    s_x, s_y = everything @ screen @ s_x, flip * everything @ screen @ s_y
    table = {
        "camera": {"position_mm": tuple(everything @ pinhole), "rotation": tuple(map(tuple, rows))},
        "screen": {
            "origin_mm": tuple(everything @ origin + shift_mm * s_x),
            "s_x": tuple(s_x),
            "s_y": tuple(s_y),
        },
    }
    return parse_tables({"geometry": table}, OpticsConfig, "test")


# Below the film, with a pattern so large that its back would show it.
BEHIND = general(everything=turned(0, 180.0)).model_copy(
    update={"pattern": PatternConfig(period_mm=500.0)}
)


@pytest.mark.parametrize(
    ("optics", "key", "words"),
    [
        (optics_of({"alpha_deg": 30.0}), "alpha_deg", "28% of the mirror; measure alpha_deg"),
        (optics_of({"alpha_deg": 1.41}), "alpha_deg", "as radians it is 80.8 deg"),
        (optics_of({"alpha_deg": 9.1}), "alpha_deg", "from the mirror's axis it is 80.9 deg"),
        (optics_of({"alpha_deg": 150.0}), "alpha_deg", "28% of the mirror"),
        (optics_of({"b_mm": 287.1}), "alpha_deg", "check a_mm, b_mm"),
        (optics_of({"a_mm": 267.2}), "a_mm", "in the camera's image"),
        (optics_of({"a_mm": 1000.0}), "a_mm", "33% of the mirror is in the camera's image"),
        (optics_of(camera={"focal_mm": 50.0}), "a_mm", "in the camera's image"),
        (optics_of(camera={"principal_px": (0.0, 0.0)}), "a_mm", "in the camera's image"),
        (optics_of(pattern={"period_mm": 4.982}), "alpha_deg", "[pattern]"),
        (optics_of(mirror={"sag_mm": 3.71}), "alpha_deg", "mirror.sag_mm"),
        (general(camera=turned(1, 20.0)), "camera.position_mm", "in the camera's image"),
        (
            general(camera=turned(1, 180.0)),
            "camera.position_mm",
            "0% of the mirror is in the camera's image",
        ),
        (
            general(shift_mm=500.0),
            "screen.origin_mm",
            "the camera's ray by the vertex meets the screen 500 mm from O'",
        ),
        (general(screen=turned(1, 180.0)), "screen.origin_mm", "of the mirror"),
        (general(flip=-1.0), "screen.origin_mm", "never meets the screen"),
        (BEHIND, "screen.origin_mm", "is seen in 0% of the mirror"),
    ],
)
def test_a_bench_that_cannot_measure_names_the_reason_and_the_key(
    optics: OpticsConfig, key: str, words: str
) -> None:
    found = find_doubt(optics)
    assert found is not None
    assert (found.hopeless, found.key) == (True, key), found
    assert words in f"{found.why}; {found.remedy}"


WIDE = {"focal_mm": 8.0}


def scaled(factor: float) -> OpticsConfig:
    """The paper's bench, smaller or larger, with the same camera."""
    lengths = {"a_mm": 2672.0 * factor, "b_mm": 2871.0 * factor}
    mirror = {
        "radius_mm": 500.0 * factor,
        "analysis_radius_mm": 475.0 * factor,
        "sag_mm": 37.1 * factor,
    }
    return optics_of(lengths, pattern={"period_mm": 49.82 * factor}, mirror=mirror)


@pytest.mark.parametrize(
    "optics",
    [
        OpticsConfig(),
        scaled(0.2),
        scaled(3.0),
        *(optics_of({"alpha_deg": alpha_deg}) for alpha_deg in (70.0, 85.0, 90.0, 105.0)),
        optics_of({"a_mm": 3500.0}),
        optics_of({"a_mm": 5000.0}, camera={"focal_mm": 25.0}),
        optics_of({"b_mm": 6000.0}),
        optics_of({"alpha_deg": 60.0}, pattern={"period_mm": 90.0}),
        optics_of(mirror={"sag_mm": 45.0}),
        optics_of(
            {"a_mm": 1500.0, "b_mm": 1200.0},
            mirror={"sag_mm": 1},
            camera=WIDE,
            pattern={"period_mm": 250.0},
        ),
        optics_of(
            camera={
                "width_px": 640,
                "height_px": 512,
                "pixel_um": 13.8,
                "principal_px": (330.0, 250.0),
            }
        ),
        general(),
        general(everything=turned(2, 90.0)),
        general(everything=turned(2, 200.0)),
        general(screen=turned(1, 5.0), shift_mm=10.0),
    ],
)
def test_an_odd_bench_that_can_measure_is_not_doubted(optics: OpticsConfig) -> None:
    assert find_doubt(optics) is None


@pytest.mark.parametrize("alpha_deg", [80.9, 60.0, 45.0, 30.0])
def test_the_share_is_that_of_the_twin_s_exact_rays(alpha_deg: float) -> None:
    """By rays through every 25th pixel over the true film, which a bowl and equal areas only
    approximate.
    """
    optics = optics_of({"alpha_deg": alpha_deg})
    camera, screen = camera_pose(optics.geometry), screen_pose(optics.geometry)
    columns, rows = (
        axis.ravel() for axis in np.meshgrid(np.arange(0, 2448, 25), np.arange(0, 2048, 25))
    )
    focal_px = 16.0 / 3.45e-3
    rays = np.stack(
        [(columns - 1223.5) / focal_px, (rows - 1023.5) / focal_px, np.ones(columns.size)], axis=1
    )
    rays = rays / np.linalg.norm(rays, axis=1)[:, None] @ camera.rotation
    film = FilmShape(37.1, 500.0)
    hits = trace_rays(camera, rays, film.terms, film.sag_mm, 0.0, screen)
    lit = np.maximum(np.abs(hits.s_x_mm), np.abs(hits.s_y_mm)) <= 4 * 49.82
    true = lit[hits.on_film(475.0)].mean()
    assert trace_view(optics, 37.1).measured == pytest.approx(true, abs=0.04)


def test_a_film_of_unknown_depth_is_doubted_only_where_no_depth_fits() -> None:
    flatter = optics_of(mirror={"sag_mm": 3.71})
    assert find_doubt(flatter, depth_known=False) is None
    for alpha_deg in (30.0, 1.41):
        found = find_doubt(optics_of({"alpha_deg": alpha_deg}), depth_known=False)
        assert found is not None
        assert found.hopeless


def test_less_than_the_whole_mirror_is_a_warning_and_unused_optics_are_not_judged() -> None:
    def findings(alpha_deg: float, **tables: Any) -> list[tuple[str, str]]:
        config = parse_tables(
            {"optics": {"geometry": SHORT | {"alpha_deg": alpha_deg}}} | tables, Config, "test"
        )
        return [(found.severity, found.field) for found in cross_check(config)]

    field = "optics.geometry.alpha_deg"
    assert findings(60.0) == [("warning", field)]
    assert findings(30.0) == [("error", field)]
    assert findings(30.0, shape={"enabled": False}) == []
    screen = {"driver": "pygame", "width_px": 1920, "height_px": 1080, "pixel_mm": 0.4961}
    devices = {"board": "tcp://192.0.2.1", "camera": {"driver": "aravis"}, "screen": screen}
    assert ("error", field) in findings(30.0, shape={"enabled": False}, devices=devices)
    assert findings(80.9, twin={"geometry": SHORT | {"alpha_deg": 30.0}}) == [
        ("error", "twin.geometry.alpha_deg")
    ]


FOLDS = [
    ((-12.0, 0.0, 0.0, 0.0), True),
    ((0.0, -300.0, 0.0, 0.0), True),
    ((-0.01, 0.0, 0.0, 0.0, -5000.0), True),
    ((-3.5, 0.0, 0.0, 0.0), False),  # beside the mirror
]


@pytest.mark.parametrize(("distortion", "hopeless"), FOLDS)
def test_a_lens_that_folds_within_the_picture_is_named(
    distortion: tuple[float, ...], hopeless: bool
) -> None:
    found = find_doubt(optics_of(camera={"distortion": distortion}))
    assert found is not None
    assert (found.table, found.key, found.hopeless) == ("camera", "distortion", hopeless)
    assert "folds" in found.why


@pytest.mark.parametrize(
    "distortion",
    [
        (),
        (-0.3, 0.0, 0.0, 0.0),
        (0.5, 0.0, 1e-3, -1e-3),
        (-0.01, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0, 0.1),
        (-1.2, 0.0, 0.0, 0.0),  # folds beyond the corners
    ],
)
def test_a_lens_that_does_not_fold_within_the_picture_is_sound(
    distortion: tuple[float, ...],
) -> None:
    assert find_doubt(optics_of(camera={"distortion": distortion})) is None


def test_the_fold_is_where_the_radial_part_is_largest() -> None:
    """r (1 + k1 r^2) is largest at r^2 = -1 / (3 k1), and two thirds of that are pictured."""
    camera = optics_of(camera={"distortion": (-12.0, 0.0, 0.0, 0.0)}).camera
    radius = math.sqrt(1 / 36)
    expected_px = 2 / 3 * radius * camera.focal_mm / (1e-3 * camera.pixel_um)
    assert find_lens_fold_px(camera) == pytest.approx(expected_px, rel=1e-3)
