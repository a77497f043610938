"""The real process on a real bench: an X display, and an emulated GigE camera that sees it."""

from __future__ import annotations

import json
import multiprocessing
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware_iface.display_patterns import ScreenRaster, compute_pattern_light
from membrane_ctrl.acquisition.process import acquisition_main
from membrane_ctrl.acquisition.spec import AcquisitionSpec
from membrane_ctrl.cli import run as command
from membrane_ctrl.config.schema import Config
from membrane_ctrl.config.toml_file import dump_toml
from membrane_ctrl.metrology.phase.pattern_sequence import full_sequence
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.shape_estimate import ShapeEstimate, unpack_estimate
from membrane_ctrl.model.telemetry import ROW_BYTES
from membrane_ctrl.processes.frames import FrameRing
from membrane_ctrl.processes.ring import RingReader, open_ring
from membrane_ctrl.sim.optics.camera import OpticsRenderer
from membrane_ctrl.sim.optics.film_shape import typical_film
from tests.support.virtual_display import screenshot, virtual_display
from tests.worlds.gige_camera import GigeCameraEmulator, gige_camera

pytestmark = pytest.mark.real_time

PATIENCE_S = 300.0  # the kernels may have to be compiled
SCREEN = {"width_px": 420, "height_px": 300, "pixel_mm": 1.6}
SCREEN_TABLE = (
    '[devices.screen]\ndriver = "pygame"\nwidth_px = 420\nheight_px = 300\npixel_mm = 1.6\n'
)
CONFIG = Config.model_validate(
    {
        "shape": {"period_s": 0.3, "frame_interval_s": 0.0},
        "optics": {"camera": {"width_px": 306, "height_px": 256, "pixel_um": 27.6}},
        "recording": {"min_free_mb": 1, "raw_every_cycles": 1},
        "devices": {
            "board": "tcp://127.0.0.1:1",
            "camera": {
                "driver": "aravis",
                "camera": "127.0.0.1",
                "exposure_ms": 30,
                "packet_bytes": 8000,
            },
            "screen": {
                "driver": "pygame",
                **SCREEN,
                "settle_ms": 50,
                "linearise": False,
                "self_test": False,
            },
        },
    }
)


class Sight:
    """The display as the camera sees it in the film, byte for byte."""

    def __init__(self, framebuffer: Path) -> None:
        self._framebuffer = framebuffer
        pattern = CONFIG.optics.pattern
        raster = ScreenRaster(**SCREEN, periods=pattern.periods, period_mm=pattern.period_mm)  # type: ignore[arg-type]
        renderer = OpticsRenderer(CONFIG.optics, typical_film(37.1, 500.0, 1), seed=1)
        self._pictures = {}
        for shown in full_sequence(pattern):
            levels = np.rint(255 * compute_pattern_light(shown, raster).astype(np.float64)).astype(
                np.uint8
            )
            self._pictures[levels.tobytes()] = renderer.render_picture(shown, 0.0).copy()
        self._dark = np.zeros((256, 306), np.uint8)

    def expose(self, exposure_ms: float, gain: int) -> Any:
        return self._pictures.get(screenshot(self._framebuffer)[:, :, 0].tobytes(), self._dark)


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as opened:
        yield opened


@pytest.fixture
def camera(stack: ExitStack, tmp_path: Path) -> GigeCameraEmulator:
    framebuffer = stack.enter_context(
        virtual_display(tmp_path, SCREEN["width_px"], SCREEN["height_px"])
    )  # type: ignore[arg-type]
    return stack.enter_context(gige_camera(Sight(framebuffer).expose, 306, 256))


class Run:
    """The acquisition process of a run without a twin."""

    def __init__(self, stack: ExitStack, config: Config, run_dir: Path) -> None:
        telemetry = stack.enter_context(open_ring(64, ROW_BYTES))
        shapes = stack.enter_context(open_ring(64, 1 << 16))
        frames = FrameRing.for_optics(config.optics)
        stack.callback(frames.close)
        self._clock = RunClock.start()
        spec = AcquisitionSpec(
            config, self._clock, telemetry, shapes, None, frames.address, run_dir
        )
        self._shapes = stack.enter_context(closing(RingReader(shapes)))
        context = multiprocessing.get_context("spawn")
        self.control, theirs = context.Pipe()
        stack.callback(self.control.close)
        self.process = context.Process(target=acquisition_main, args=(spec, theirs))
        self.process.start()
        theirs.close()
        stack.callback(self._end)
        self.reports: list[dict[str, Any]] = []
        self.estimates: list[ShapeEstimate] = []

    def until(self, happened: Callable[[], bool]) -> None:
        """Listen until something has happened."""
        while not happened():
            assert self._clock.now() < PATIENCE_S, self.reports[-3:]
            try:
                if self.control.poll(0.02):
                    self.reports.append(self.control.recv())
            except EOFError:
                self.process.join(PATIENCE_S)
            self.estimates += [unpack_estimate(message) for message in self._shapes.drain()]

    def has_reported(self, state: str, words: str) -> bool:
        """Whether a report says so."""
        reports = (report for report in self.reports if report["kind"] == "acquisition")
        return any(report["state"] == state and words in report["message"] for report in reports)

    def _end(self) -> None:
        self.process.kill()
        self.process.join()


def test_cycles_through_display_and_camera(
    stack: ExitStack, camera: GigeCameraEmulator, tmp_path: Path
) -> None:
    run = Run(stack, CONFIG, tmp_path)
    run.until(lambda: any(e.kind == "fringes" and e.verdict == "ok" for e in run.estimates))
    fringes = next(e for e in run.estimates if e.kind == "fringes" and e.verdict == "ok")
    before = run.estimates[: run.estimates.index(fringes)]
    full = next(e for e in reversed(before) if e.kind == "full")
    # a pause of the machine costs a cycle frames, or the whole cycle, after which a full one
    # follows
    assert all(e.kind == "full" or e.verdict == "rejected" for e in before[: before.index(full)])
    assert all(e.verdict != "ok" for e in before[before.index(full) + 1 :])
    assert full.verdict != "rejected"
    assert full.sag_um == pytest.approx(37_100, rel=0.01)
    assert run.has_reported("preparing", "camera: Aravis Fake EMU1")

    camera.unplug()
    run.until(lambda: run.has_reported("retrying", "plugged in"))
    camera.plug_in()
    taken = len(run.estimates)
    run.until(lambda: any(e.verdict == "ok" for e in run.estimates[taken:]))

    run.control.send("stop")
    run.until(lambda: not run.process.is_alive())
    assert run.process.exitcode == 0
    kept = sorted(path.name for path in (tmp_path / "raw").iterdir())
    name = f"cycle-{fringes.cycle:06d}"
    assert {f"cycle-{full.cycle:06d}", name} <= set(kept)
    assert command(["measure", str(tmp_path / "raw" / name), "--out", str(tmp_path / "again")]) == 0
    again = json.loads((tmp_path / "again" / "result.json").read_text())["zernike"]["coeffs_um"]
    assert again[3] == pytest.approx(fringes.coeffs_um[3], abs=2.0)


def test_a_camera_that_is_not_there_is_waited_for(
    stack: ExitStack, camera: GigeCameraEmulator, tmp_path: Path
) -> None:
    camera.unplug()
    run = Run(stack, CONFIG, tmp_path)
    run.until(lambda: run.has_reported("retrying", "not found"))
    camera.plug_in()
    run.until(lambda: bool(run.estimates))
    run.control.send("stop")
    run.until(lambda: not run.process.is_alive())


def test_check_names_what_is_wrong_with_the_screen(
    stack: ExitStack, camera: GigeCameraEmulator, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert CONFIG.devices is not None
    assert CONFIG.devices.screen is not None
    screen = CONFIG.devices.screen.model_copy(update={"width_px": 640})
    devices = CONFIG.devices.model_copy(update={"screen": screen})
    path = tmp_path / "lab.toml"
    path.write_text(dump_toml(CONFIG.model_copy(update={"devices": devices})))
    assert command(["check", str(path), "--json"]) == 4
    probes = {probe["role"]: probe for probe in json.loads(capsys.readouterr().out)["devices"]}
    assert "is 420 x 300, [devices.screen] states 640 x 300" in probes["camera"]["problem"]
    path.write_text(dump_toml(CONFIG))
    assert command(["check", str(path), "--json"]) == 4  # there is no board
    probes = {probe["role"]: probe for probe in json.loads(capsys.readouterr().out)["devices"]}
    assert probes["camera"]["problem"] == ""
    assert probes["camera"]["identity"].startswith("Aravis Fake EMU1")
    assert probes["camera"]["latency_p50_ms"] >= 30.0


@pytest.mark.parametrize(
    ("devices", "words"),
    [
        (SCREEN_TABLE, "needs a [devices.camera]"),
        ('[devices.camera]\ndriver = "aravis"\n', "a camera needs a [devices.screen]"),
        (
            '[devices.camera]\ndriver = "folder"\nfolder = "f"\n' + SCREEN_TABLE,
            "a folder of frames must not have one",
        ),
        (
            '[devices.camera]\ndriver = "aravis"\npixel_format = "Mono12"\n' + SCREEN_TABLE,
            "optics.camera.bits = 8, but devices.camera gives 12",
        ),
    ],
)
def test_tables_that_do_not_fit_are_one_line(
    devices: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "lab.toml"
    path.write_text('[devices]\nboard = "tcp://h:1"\n' + devices)
    assert command(["check", str(path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
