"""A camera and a display of another package at the twin's mirror, and what their mistakes do to the
cycle.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from acquisition_fakes import VirtualClock

from firmware_iface.drivers.camera_opencv import FolderCamera
from firmware_iface.guarded_camera import GuardedCamera
from firmware_iface.pattern_screen import PatternScreen
from membrane_ctrl.acquisition import driver_check, optical_bench
from membrane_ctrl.acquisition.cycle import CycleDone, CycleFailed, ShapeCycle
from membrane_ctrl.acquisition.cycle_plan import CyclePlan
from membrane_ctrl.config.schema import Config
from membrane_ctrl.config.toml_file import dump_toml, load_toml
from membrane_ctrl.metrology.cycle.live_reconstructor import LiveReconstructor
from membrane_ctrl.metrology.phase.pattern_sequence import fringe_sequence, full_sequence
from membrane_ctrl.model.errors import InputError
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.processes.frames import FrameRing, FrameWriter
from membrane_ctrl.sim.optics.camera import TwinOptics
from tests.support.studio_package import install_studio

SCREEN = {
    "width_px": 1300,
    "height_px": 1100,
    "pixel_mm": 0.4,
    "settle_ms": 0,
    "linearise": False,
    "self_test": False,
}
SENSOR = {"width_px": 306, "height_px": 256, "pixel_um": 27.6}


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder in which the package is installed."""
    folder = install_studio(tmp_path / "site")
    monkeypatch.syspath_prepend(folder)
    yield folder
    sys.modules.pop("studio_optics", None)


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as opened:
        yield opened


def configured(
    camera: dict[str, Any] | None = None, screen: dict[str, Any] | None = None
) -> Config:
    devices = {
        "board": "tcp://127.0.0.1:1",
        "camera": {"driver": "external", "name": "studio_cam", **(camera or {})},
        "screen": {"driver": "external", "name": "studio_wall", **SCREEN, **(screen or {})},
    }
    return Config.model_validate({"devices": devices, "optics": {"camera": SENSOR}})


class Still:
    """A film at rest, and a laser that sees it."""

    displacement_um = 0.0
    sag_mm = 37.1

    def at(self, time_s: float) -> float:
        return 0.0


def cycles_of(config: Config, stack: ExitStack) -> tuple[ShapeCycle, optical_bench.OpticalBench]:
    """Cycles of the configured optics at the twin's mirror."""
    clock = VirtualClock()
    twin = TwinOptics(config.optics, config.twin, Still, clock)
    bench = optical_bench.emulated_bench(config, clock, twin)
    frames = FrameRing.for_optics(config.optics)
    stack.callback(frames.close)
    writer = stack.enter_context(closing(FrameWriter(frames.address)))
    stack.callback(bench.close)
    optical_bench.open_bench(bench, config, clock)
    plan = CyclePlan(
        full_sequence(config.optics.pattern), fringe_sequence(config.optics.pattern), 0.0
    )
    reconstructor = LiveReconstructor(config.optics, config.shape.bin_px)
    return ShapeCycle(
        bench.camera, bench.screen, reconstructor, plan, writer, clock, Still()
    ), bench


def figure(taken: CycleDone | CycleFailed | None) -> ShapeEstimate:
    assert isinstance(taken, CycleDone), taken
    assert taken.estimate.verdict == "ok", taken.estimate.reason
    return taken.estimate


def test_the_figure_is_that_of_the_twins_own_optics(site: Path, stack: ExitStack) -> None:
    config = configured()
    cycles, bench = cycles_of(config, stack)
    assert isinstance(bench.camera, GuardedCamera)
    assert isinstance(bench.screen, PatternScreen)
    own = config.model_copy(update={"devices": None})
    reference, _ = cycles_of(own, stack)
    for kind in ("full", "fringes"):
        found, expected = figure(cycles.run_cycle()), figure(reference.run_cycle())
        assert found.kind == kind
        assert np.abs(found.coeffs_um[3:] - expected.coeffs_um[3:]).max() < 0.5
        assert found.sag_um == pytest.approx(expected.sag_um, abs=5.0)


@pytest.mark.parametrize("role", ["camera", "screen"])
def test_either_of_them_may_be_the_twins_own(role: str, site: Path, stack: ExitStack) -> None:
    config = configured()
    assert config.devices is not None
    built_in = {"camera": {"driver": "aravis"}, "screen": {"driver": "pygame", **SCREEN}}
    tables = config.model_dump(mode="json", exclude_none=True)
    tables["devices"][role] = built_in[role]
    cycles, bench = cycles_of(Config.model_validate(tables), stack)
    ours, theirs = {"camera": (bench.camera, bench.screen), "screen": (bench.screen, bench.camera)}[
        role
    ]
    assert not isinstance(ours, GuardedCamera | PatternScreen)
    assert isinstance(theirs, GuardedCamera | PatternScreen)
    figure(cycles.run_cycle())


def test_each_mistake_costs_a_cycle_and_is_named(site: Path, stack: ExitStack) -> None:
    mistakes = {
        "raise": "LinkError: camera studio_cam: grab: RuntimeError: bus error 5",
        "exit": "LinkError: camera studio_cam: grab: SystemExit: 3",
        "nothing": "LinkError: camera studio_cam: grab returned NoneType instead of Frame",
        "size": "LinkError: camera studio_cam: gave 306 x 255 uint8, [optics.camera] states 306 x "
        "256 uint8",
        "close": "LinkDownError: camera studio_cam: unplugged",
    }
    cycles, _ = cycles_of(configured({"faults": list(mistakes), "fault_every": 20}), stack)
    failed: list[str] = []
    good_since = 0
    while len(failed) < len(mistakes):
        taken = cycles.run_cycle()
        if isinstance(taken, CycleFailed):
            assert taken.stage == "camera"
            failed.append(taken.message)
            good_since = 0
        else:
            figure(taken)
            good_since += 1
        assert good_since < 4
    assert failed == list(mistakes.values())
    figure(cycles.run_cycle())


def test_a_late_frame_is_taken_again(site: Path, stack: ExitStack) -> None:
    cycles, bench = cycles_of(configured({"faults": ["late"], "fault_every": 5}), stack)
    figure(cycles.run_cycle())
    assert bench.camera.driver._exposures == len(full_sequence(configured().optics.pattern)) + 1


def refusal(config: Config) -> str:
    """Why a command refuses the optics, before it opens anything."""
    assert config.devices is not None
    with pytest.raises(InputError) as caught:
        driver_check.require_optics(config.devices)
    (line,) = caught.value.lines
    assert "\n" not in line
    return line


@pytest.mark.parametrize(
    ("camera", "screen", "words"),
    [
        ({"exposure": 5}, {}, "devices.camera: exposure: unknown key; did you mean exposure_ms?"),
        ({"exposure_ms": 2000.0}, {}, "exposure_ms: input should be less than or equal to 1000"),
        ({}, {"bright": 1}, "devices.screen: bright: 1: write true or false"),
        (
            {"name": "studio_com"},
            {},
            "no camera driver 'studio_com' is installed; installed: studio_cam",
        ),
        ({"name": "studio_wall"}, {}, "no camera driver 'studio_wall' is installed"),
        (
            {},
            {"name": "studio_cam"},
            "no screen driver 'studio_cam' is installed; installed: studio_wall",
        ),
    ],
    ids=["key", "range", "screen", "name", "screen as camera", "camera as screen"],
)
def test_a_table_that_a_package_refuses_is_one_line(
    camera: dict[str, Any], screen: dict[str, Any], words: str, site: Path
) -> None:
    assert words in refusal(configured(camera, screen))


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("import not_there", "does not load: ModuleNotFoundError: No module named 'not_there'"),
        ("raise SystemExit('no licence')", "does not load: SystemExit: no licence"),
        ("class StudioCamera: pass", "the camera driver studio_cam has no class Settings"),
        ("import os\nos._exit(7)", "the drivers' packages ended the process that loads them (7)"),
    ],
    ids=["import", "exit", "settings", "dies"],
)
def test_a_package_that_does_not_load_is_one_line(source: str, words: str, site: Path) -> None:
    (site / "studio_optics.py").write_text(source + "\n")
    assert words in refusal(configured())


def test_a_package_that_hangs_is_not_waited_for(
    site: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (site / "studio_optics.py").write_text("import threading\nthreading.Event().wait()\n")
    monkeypatch.setattr(driver_check, "_LOADED_S", 0.0)
    assert "the drivers' packages do not load within 0 s" in refusal(configured())


def test_this_process_loads_no_package(site: Path, tmp_path: Path) -> None:
    config = configured({"exposure_ms": 5.0})
    path = tmp_path / "config.toml"
    path.write_text(dump_toml(config))
    assert load_toml(path, Config) == config
    assert config.devices is not None
    driver_check.require_optics(config.devices)
    assert "studio_optics" not in sys.modules


def make(config: Config) -> Callable[[], object]:
    return lambda: optical_bench.configured_bench(config, VirtualClock())


def test_a_driver_that_is_no_camera_is_refused(site: Path) -> None:
    source = (site / "studio_optics.py").read_text()
    (site / "studio_optics.py").write_text(source.replace("def grab(", "def snap("))
    with pytest.raises(
        InputError, match=r"devices\.camera: camera studio_cam: the driver has neither grab nor"
    ):
        make(configured())()


def test_a_driver_that_cannot_be_made_is_refused(site: Path) -> None:
    source = (site / "studio_optics.py").read_text()
    (site / "studio_optics.py").write_text(
        source.replace("np.random.default_rng(3)", "np.random.rng(3)")
    )
    with pytest.raises(
        InputError, match=r"devices\.camera: StudioCamera cannot be made: AttributeError"
    ):
        make(configured())()


def test_a_package_cannot_replace_a_built_in_driver(site: Path) -> None:
    entries = site / "studio_optics-2.1.dist-info" / "entry_points.txt"
    entries.write_text(
        entries.read_text().replace("studio_cam = studio_optics:S", "folder = studio_optics:S")
    )
    tables = configured().model_dump(mode="json", exclude_none=True)
    del tables["devices"]["screen"]
    tables["devices"]["camera"] = {"driver": "folder", "folder": str(site)}
    bench = optical_bench.configured_bench(Config.model_validate(tables), VirtualClock())
    assert isinstance(bench.screen, FolderCamera)
    assert "studio_optics" not in sys.modules
