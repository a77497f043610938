"""The second world is independent, its maps are exact, and `measure` agrees with a sound bench."""

from __future__ import annotations

import ast
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from membrane_ctrl.measure.track import read_track
from tests.studies.second_world_errors import drawn_points_mm, measured_errors
from tests.worlds import second_optics
from tests.worlds.second_optics import (
    YAW,
    Bench,
    Effects,
    Ghost,
    Mirror,
    Panel,
    Sensor,
    Stated,
    World,
    drawn_errors,
    drawn_mirror,
    step_motion,
)
from tests.worlds.second_optics.patterns import Picture, full_set
from tests.worlds.second_optics.rays import trace

PACKAGE = Path(second_optics.__file__).parent
EIGHTH = Bench.paper(0.125)
SINE = Picture("sin", "x", 0)
NOISELESS = Sensor(bits=16, read_adu=0.0, full_well=0.0)


@pytest.fixture(scope="module")
def mirror() -> Mirror:
    """An orthotropic film."""
    return drawn_mirror(np.random.default_rng(1), orthotropic=True)


def test_the_package_shares_no_code_with_the_product() -> None:
    for path in PACKAGE.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
            for name in names:
                assert not name.startswith(("membrane_ctrl", "firmware_iface", "tuning"))
                assert not name.startswith("tests") or name.startswith(second_optics.__name__)


def test_splines_between_traced_rays_are_exact(mirror: Mirror) -> None:
    world = World(mirror, EIGHTH, samples=1)
    places_mm, film_mm = world.screen_map(30.0)
    maps = world._maps(30.0, time_s=0.0)
    seen = np.hypot(*film_mm) < 495
    assert np.abs(maps.screen - places_mm)[:, seen].max() < 2e-3  # mm: 3e-7 rad of slope


def test_a_ray_is_reflected_at_the_film_s_normal(mirror: Mirror) -> None:
    """The normal by differences of the explicit height halves the angle of the two rays."""
    bench = EIGHTH.changed(drawn_errors(np.random.default_rng(5)))
    bench = replace(bench, glass_mm=0.0, air_k_per_m=0.0, pitch=1.0)
    seen = trace(bench, mirror, np.array([150.0, 90.0]), np.array([120.0, 60.0]), 0.0)
    film, _, _ = mirror.position_mm(*seen.film, 0.0)
    rays = film - bench.camera.place_mm[:, None]
    s_x, s_y = seen.screen_mm
    local = np.stack([s_x, s_y, bench.face_mm(s_x, s_y)])
    screen = bench.screen.place_mm[:, None] + bench.screen.axes.T @ local
    leaving = screen - film
    half = leaving / np.linalg.norm(leaving, axis=0) - rays / np.linalg.norm(rays, axis=0)
    step_mm = 0.5
    x, y, _ = film
    by_x = mirror.height_mm(x + step_mm, y, 0.0) - mirror.height_mm(x - step_mm, y, 0.0)
    by_y = mirror.height_mm(x, y + step_mm, 0.0) - mirror.height_mm(x, y - step_mm, 0.0)
    assert -half[0] / half[2] == pytest.approx(by_x / (2 * step_mm), abs=1e-6)
    assert -half[1] / half[2] == pytest.approx(by_y / (2 * step_mm), abs=1e-6)


def test_a_sound_set_is_ok_and_inside_its_bars(mirror: Mirror, tmp_path: Path) -> None:
    world = World(mirror, EIGHTH, stated=Stated(sigma_share=0.01), seed=3)
    truth = world.write_set(tmp_path / "set", 12.0)
    points_mm = drawn_points_mm(np.random.default_rng(1), 30)
    found = measured_errors(tmp_path / "set", mirror, truth, points_mm)
    assert found.verdict == "ok", found.reason
    assert found.worst_sigmas < 3
    assert found.error_um is not None
    assert np.abs(found.error_um[1:9]).max() < 1.0  # um, and not only inside wide bars


def light_of(mirror: Mirror, effects: Effects, time_s: float = 0.0) -> np.ndarray:
    """One frame without noise, in counts of 16 bits."""
    sound = replace(effects, sensor=replace(effects.sensor, read_adu=0.0, full_well=0.0))
    return World(mirror, EIGHTH, sound, samples=1).frame(SINE, 0.0, time_s).astype(float)


PLANTED = {
    "ghost": Effects(sensor=NOISELESS, panel=Panel(ghost=Ghost(0.01))),
    "gamma": Effects(sensor=NOISELESS, panel=Panel(gamma=1.05)),
    "gamma by angle": Effects(sensor=NOISELESS, panel=Panel(gamma_by_angle=0.1)),
    "fall-off": Effects(sensor=NOISELESS, panel=Panel(falloff=0.1)),
    "slope": Effects(sensor=NOISELESS, panel=Panel(falloff_slope=0.1)),
    "contrast": Effects(sensor=NOISELESS, panel=Panel(contrast_falloff=0.1)),
    "previous": Effects(sensor=NOISELESS, panel=Panel(previous_share=0.01)),
    "camera": Effects(sensor=NOISELESS, camera_motion=step_motion(YAW, 1e-4, 0.0)),
    "screen": Effects(sensor=NOISELESS, screen_motion=step_motion(0, 0.1, 0.0)),
    "response": Effects(sensor=replace(NOISELESS, response_gamma=1.1)),
    "upside down": Effects(sensor=NOISELESS, orientation="rotated 180"),
    "dust": Effects(sensor=NOISELESS, dust=5),
    "blur": Effects(sensor=NOISELESS, psf_px=1.5),
}


@pytest.mark.parametrize("name", PLANTED)
def test_each_effect_changes_the_frames(mirror: Mirror, name: str) -> None:
    sound = light_of(mirror, Effects(sensor=NOISELESS))
    assert np.abs(light_of(mirror, PLANTED[name]) - sound).max() > 50  # of 65535


def test_a_knock_comes_at_its_time(mirror: Mirror) -> None:
    effects = Effects(sensor=NOISELESS, camera_motion=step_motion(YAW, 1e-4, at_s=2.0))
    sound = light_of(mirror, Effects(sensor=NOISELESS))
    assert np.abs(light_of(mirror, effects, 1.9) - sound).max() < 3
    assert np.abs(light_of(mirror, effects, 2.1) - sound).max() > 50


def test_yaw_turns_the_camera_to_the_right() -> None:
    turned = EIGHTH.moved(np.array([0, 0, 0, 0, 0.01, 0]), np.zeros(6)).camera
    assert turned.axes[2] @ EIGHTH.camera.axes[0] == pytest.approx(np.sin(0.01))


def test_containers_keep_or_spoil_the_counts(mirror: Mirror) -> None:
    def frame(container: str) -> np.ndarray:
        sensor = replace(NOISELESS, bits=12, container=container)
        return World(mirror, EIGHTH, Effects(sensor=sensor), samples=1).frame(SINE, 0.0)

    plain = frame("plain")
    assert np.array_equal(frame("left-aligned"), plain << 4)
    assert np.array_equal(frame("byte-swapped").byteswap(), plain)
    packed = frame("packed").view(np.uint8).ravel().astype(np.uint32)
    first = packed[0] | (packed[1] & 15) << 8
    second = packed[1] >> 4 | packed[2] << 4
    assert [first, second] == plain.ravel()[:2].tolist()


def test_a_set_on_disk_has_the_documented_names(mirror: Mirror, tmp_path: Path) -> None:
    World(mirror, Bench.paper(0.05)).write_set(tmp_path / "set")
    for picture in full_set():
        assert cv2.imread(str(tmp_path / "set" / f"{picture.name}.png"), 0) is not None


def test_a_tracking_set_is_one_that_the_product_reads(mirror: Mirror, tmp_path: Path) -> None:
    world = World(mirror, Bench.paper(0.05))
    world.write_set(tmp_path / "full")
    displacements_um = world.write_track(tmp_path / "track", tmp_path / "full", 7, begin_s=5.0)
    content = read_track(tmp_path / "track")
    assert content.reference == "../full"
    assert [frame.time_s for frame in content.frames[:2]] == pytest.approx([5.0, 5.12])
    shifts_rad = [(frame.shift_x_rad, frame.shift_y_rad) for frame in content.frames]
    assert shifts_rad[1] == pytest.approx((2 * np.pi / 5, 4 * np.pi / 5))
    assert shifts_rad[5:] == [(0.0, 0.0), (0.0, 0.0)]
    assert displacements_um.tolist() == [0.0] * 7
