"""The optics' stages on the emulated bench: rendered pictures of a small camera."""

from __future__ import annotations

from math import erf
from pathlib import Path

import numpy as np
import pytest

from membrane_ctrl.acquisition.mirror_pictures import MirrorPictures
from membrane_ctrl.commissioning.guide.rim_edge import measure_rim_edge_px
from membrane_ctrl.commissioning.guide.session_state import CheckVerdict, read_tables, write_tables
from membrane_ctrl.commissioning.guide.stage import SessionPlan
from membrane_ctrl.config.schema import Config
from membrane_ctrl.measure.simulate import shrink_camera
from membrane_ctrl.model.errors import Exit
from membrane_ctrl.sim import plant, virtual_bench
from tests.commissioning.guided import Person, QuickBench, failed_in, run_stages, state_of

SHRINK = 4
OPTICS = {
    "camera.driver": "aravis",
    "screen.driver": "pygame",
    "screen.width_px": "900",
    "screen.height_px": "900",
    "screen.pixel_mm": "0.5",
}
PLAN = SessionPlan(settled_s=1.0, leak_s=20.0, hold_s=20.0)


@pytest.fixture
def bench() -> QuickBench:
    """The mirror at its depth, as step 4 leaves it."""
    config = Config()
    bench = QuickBench()
    bench.use_mirror(
        virtual_bench.VirtualBench(plant.Plant(config.twin, config.pump), watchdog_s=1.0)
    )
    return bench


@pytest.fixture
def folder(tmp_path: Path, bench: QuickBench) -> Path:
    """A session whose mirror and devices are stated, with a camera of fewer pixels."""
    person = Person(**OPTICS, **{"mirror.pump_ml_per_s": "6", "mirror.pump_kind": "proportional"})
    run_stages(tmp_path, bench, person, "mirror", "devices")
    tables = read_tables(tmp_path)
    camera = shrink_camera(Config().optics.camera, SHRINK)
    tables["optics"]["camera"] = camera.model_dump(exclude_none=True)
    write_tables(tmp_path, tables)
    return tmp_path


@pytest.mark.parametrize("sigma_px", [1.0, 2.0, 4.0])
def test_a_blurred_disc_has_the_width_of_its_blur(sigma_px: float) -> None:
    rows, columns = np.mgrid[:300, :400]
    inside_px = 110.0 - np.hypot(columns - 205.3, rows - 148.6)
    share = np.vectorize(lambda x: 0.5 * (1 + erf(x / (sigma_px * 2**0.5))))(inside_px)
    noise = np.random.default_rng(1).normal(0.0, 1.0, share.shape)
    white = np.clip(20 + 180 * share + noise, 0, 255).astype(np.uint8)
    black = np.full(white.shape, 20, np.uint8)
    width_px = measure_rim_edge_px(MirrorPictures(white, black))
    # 10 to 90 % of a Gaussian edge; a pixel's own width of 1/sqrt(12), and half a step each side
    assert width_px == pytest.approx(2.563 * sigma_px, rel=0.1, abs=0.5)


def test_no_mirror_has_no_rim() -> None:
    dark = np.full((100, 100), 20, np.uint8)
    assert np.isnan(measure_rim_edge_px(MirrorPictures(dark, dark)))


@pytest.mark.campaign  # the settling of the screen takes hundreds of rendered pictures
def test_focus_and_screen_pass_on_the_twin(folder: Path, bench: QuickBench) -> None:
    person = Person()
    assert run_stages(folder, bench, person, "focus", "screen", plan=PLAN) == Exit.DONE, person.text
    assert "screen settles in" in person.text
    assert "gamma" in person.text
    assert bench.lens.blur_px < 2.0
    assert read_tables(folder)["shape"]["enabled"] is True


def test_a_ring_that_is_not_turned_fails(folder: Path, bench: QuickBench) -> None:
    person = Person(**{"focus_turn": "fixed"})
    assert run_stages(folder, bench, person, "focus", plan=PLAN) == Exit.INTERRUPTED
    assert failed_in(folder, person) == ["width of the mirror's rim in the picture, 10 to 90 %"]


def test_a_covered_lens_is_named(folder: Path, bench: QuickBench) -> None:
    bench.lens.gain = 0.0
    person = Person()
    assert run_stages(folder, bench, person, "focus", plan=PLAN) == Exit.INTERRUPTED
    assert "lens cap" in person.text
    assert bench.bench.board.pump_fraction == 0.0
    assert read_tables(folder)["shape"]["enabled"] is True


def test_an_overexposed_camera_is_named(folder: Path, bench: QuickBench) -> None:
    tables = read_tables(folder)
    tables["devices"]["screen"] |= {"settle_ms": 60.0, "linearise": False}
    write_tables(folder, tables)
    bench.lens.gain = 3.0
    bench.lens.blur_px = 0.5
    person = Person()
    assert run_stages(folder, bench, person, "screen", plan=PLAN) == Exit.INTERRUPTED
    assert "saturated" in person.text


def test_without_a_board_the_geometry_stays_by_hand(folder: Path, bench: QuickBench) -> None:
    person = Person()
    assert run_stages(folder, bench, person, "calibration") == Exit.DONE
    assert "12 µm RMS" in person.text


def test_photographs_that_are_not_there_are_named(folder: Path, bench: QuickBench) -> None:
    person = Person(
        **{"calibration.with": "board", "calibration.photographs": str(folder / "none")}
    )
    assert run_stages(folder, bench, person, "calibration") == Exit.INTERRUPTED
    assert failed_in(folder, person) == ["lens from photographs of a board"]
    assert str(folder / "none") in person.text


@pytest.mark.campaign
def test_figures_come_from_rendered_frames(folder: Path, bench: QuickBench) -> None:
    bench.lens.blur_px = 0.5
    person = Person()
    assert run_stages(folder, bench, person, "geometry", "figure", plan=PLAN) == Exit.DONE, (
        person.text
    )
    record = state_of(folder).find_record("figure")
    assert record is not None
    measured = {check.name: check for check in record.checks}
    assert measured["median modulation of the fringes"].verdict == CheckVerdict.PASSED
    assert "rendered" in measured["origin of these figures"].measured
