"""The real process on the twin's camera, with a small sensor."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from membrane_ctrl.acquisition.process import acquisition_main
from membrane_ctrl.acquisition.spec import AcquisitionSpec
from membrane_ctrl.acquisition.warm_up import coarse_optics
from membrane_ctrl.config.schema import CameraConfig, Config, OpticsConfig, ShapeConfig
from membrane_ctrl.geometry.file import stated_origin
from membrane_ctrl.metrology.phase.pattern_sequence import fringe_sequence
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.shape_estimate import ShapeEstimate, unpack_estimate
from membrane_ctrl.model.telemetry import FIELDS, ROW_BYTES, TelemetryRow
from membrane_ctrl.processes.child import STOP
from membrane_ctrl.processes.frames import FrameReader, FrameRing
from membrane_ctrl.processes.ring import RingReader, RingWriter, open_ring
from membrane_ctrl.sim.truth import TRUTH_BYTES, Truth

pytestmark = pytest.mark.real_time

PATIENCE_S = 300.0  # the kernels may have to be compiled
CONFIG = Config(
    shape=ShapeConfig(period_s=0.3, frame_interval_s=0.0),
    optics=OpticsConfig(camera=CameraConfig(width_px=306, height_px=256, pixel_um=27.6)),
)
SAG_MM = 37.1


def truth(displacement_um: float) -> Truth:
    nothing = Truth(**dict.fromkeys((field.name for field in fields(Truth)), 0.0))
    return replace(
        nothing, displacement_um=displacement_um, sag_mm=SAG_MM + displacement_um / 1000.0
    )


class Run:
    """The rings of a run and a real acquisition process on them."""

    def __init__(self, stack: ExitStack, twin: bool = True) -> None:
        telemetry = stack.enter_context(open_ring(4096, ROW_BYTES))
        shapes = stack.enter_context(open_ring(64, 1 << 16))
        truths = stack.enter_context(open_ring(16, TRUTH_BYTES))
        frames = FrameRing.for_optics(CONFIG.optics)
        stack.callback(frames.close)
        self.clock = RunClock.start()
        self.spec = AcquisitionSpec(
            CONFIG, self.clock, telemetry, shapes, truths if twin else None, frames.address
        )
        self._telemetry = stack.enter_context(closing(RingWriter(telemetry)))
        self._truth = stack.enter_context(closing(RingWriter(truths)))
        self._shapes = stack.enter_context(closing(RingReader(shapes)))
        self._ticks = 0
        self.displacement_um = 0.0
        self.reports: list[dict[str, Any]] = []
        self.estimates: list[ShapeEstimate] = []
        context = multiprocessing.get_context("spawn")
        self.control, theirs = context.Pipe()
        stack.callback(self.control.close)
        self.process = context.Process(target=acquisition_main, args=(self.spec, theirs))
        self.process.start()
        theirs.close()
        stack.callback(self._end)

    def until(self, happened: Callable[[], bool]) -> None:
        """Tick as the control process would until something happens."""
        give_up_s = self.clock.now() + PATIENCE_S
        while not happened():
            assert self.clock.now() < give_up_s, self.reports[-3:]
            self.tick()
            try:
                if self.control.poll(0.02):
                    self.reports.append(self.control.recv())
            except EOFError:
                self.process.join(PATIENCE_S)
            self.estimates += [unpack_estimate(message) for message in self._shapes.drain()]

    def states(self) -> list[str]:
        return [report["state"] for report in self.reports if report["kind"] == "acquisition"]

    def tick(self) -> None:
        self._ticks += 1
        nothing = TelemetryRow(**dict.fromkeys(FIELDS, float("nan")))
        row = replace(
            nothing,
            mono_s=self.clock.now(),
            displacement_um=self.displacement_um,
            displacement_quality=0.0,
            sample_counter=float(self._ticks),
        )
        self._telemetry.put(row.pack())
        self._truth.put(truth(self.displacement_um).pack())

    def _end(self) -> None:
        self.process.kill()
        self.process.join()


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def test_measures_the_twin_follows_a_jump_and_stops_on_command(stack: ExitStack) -> None:
    run = Run(stack)
    run.until(lambda: len(run.estimates) >= 4)
    assert run.states()[0] == "preparing"
    (geometry,) = [report for report in run.reports if report["kind"] == "geometry"]
    assert (geometry["hash"], geometry["file"]) == (stated_origin(CONFIG.optics).hash, None)
    assert [e.kind for e in run.estimates[:3]] == ["full", "fringes", "fringes"]
    assert [e.cycle for e in run.estimates[:3]] == [1, 2, 3]
    assert all(
        e.verdict == "ok" and e.displacement_um == 0.0 and e.latency_s > 0 for e in run.estimates
    )

    before_um = run.estimates[-1].sag_um
    run.displacement_um = 20.0
    run.tick()
    moved_s = run.clock.now()
    run.until(
        lambda: sum(e.time_s > moved_s for e in run.estimates) >= 2
    )  # the first may have begun before
    assert run.estimates[-1].sag_um - before_um == pytest.approx(20.0, abs=0.5)
    assert run.estimates[-1].displacement_um == pytest.approx(20.0)

    run.control.send("stop")
    run.until(lambda: not run.process.is_alive())
    assert run.process.exitcode == 0
    reader = stack.enter_context(closing(FrameReader(run.spec.frames)))
    last = [head for head in reader.heads() if head.cycle == run.estimates[-1].cycle]
    assert [head.pattern for head in last] == [
        pattern.name for pattern in fringe_sequence(CONFIG.optics.pattern)
    ]
    pixels = reader.copy(last[0])
    assert pixels is not None
    assert pixels.max() > 150  # fringes of about 90 grey levels around 110


def test_pause_resume_full_and_sigterm(stack: ExitStack) -> None:
    run = Run(stack)
    run.until(lambda: bool(run.estimates))
    run.control.send("pause")
    run.until(lambda: "paused" in run.states())
    taken = len(run.estimates)
    resumed_s = run.clock.now() + 3 * CONFIG.shape.period_s
    run.until(lambda: run.clock.now() > resumed_s)
    assert len(run.estimates) == taken
    run.control.send("full")
    run.control.send("resume")
    run.until(lambda: len(run.estimates) >= taken + 2)
    assert [e.kind for e in run.estimates[taken : taken + 2]] == ["full", "fringes"]
    assert run.process.pid is not None
    os.kill(run.process.pid, signal.SIGINT)  # not meant for this process
    os.kill(run.process.pid, STOP)
    run.until(lambda: not run.process.is_alive())
    assert run.process.exitcode == 0


def test_without_a_camera_the_process_reports_it_and_ends(stack: ExitStack) -> None:
    run = Run(stack, twin=False)
    run.until(lambda: not run.process.is_alive())
    run.until(lambda: "failed" in run.states())
    assert run.process.exitcode == 1
    assert "no camera" in run.reports[-1]["message"]


def test_a_small_sensor_has_the_same_field() -> None:
    full = OpticsConfig()
    coarse = coarse_optics(full)
    assert (coarse.camera.width_px, coarse.camera.height_px) == (408, 341)
    for optics in (full, coarse):
        camera = optics.camera
        edge_mm = (np.array([-0.5, -0.5]) - camera.principal) * camera.pixel_um / 1000.0
        np.testing.assert_allclose(edge_mm, [-4.2228, -3.5328])
    assert coarse_optics(CONFIG.optics).camera.width_px == 306
