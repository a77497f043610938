"""Memory of the acquisition process over many cycles on frames of its twin; a part of `memory`."""

from __future__ import annotations

import time
from contextlib import ExitStack, closing
from dataclasses import fields, replace

import psutil

from membrane_ctrl.acquisition.spec import AcquisitionSpec
from membrane_ctrl.config.schema import CameraConfig, Config, OpticsConfig, ShapeConfig
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.telemetry import FIELDS, ROW_BYTES, TelemetryRow
from membrane_ctrl.processes.child import Child
from membrane_ctrl.processes.event_pipe import make_pipe
from membrane_ctrl.processes.frames import FrameRing
from membrane_ctrl.processes.ring import RingReader, RingWriter, open_ring
from membrane_ctrl.sim.truth import TRUTH_BYTES, Truth
from tests.support.figures import Figure, at_most

WARM_CYCLES, CYCLES = 200, 1500
_CONFIG = Config(
    shape=ShapeConfig(period_s=0.2, frame_interval_s=0.0),
    optics=OpticsConfig(camera=CameraConfig(width_px=306, height_px=256, pixel_um=27.6)),
)
_TRUTH = Truth(**{**dict.fromkeys((field.name for field in fields(Truth)), 0.0), "sag_mm": 37.1})
_NOTHING = TelemetryRow(**dict.fromkeys(FIELDS, float("nan")))
_PATIENCE_S = 1800.0


def acquisition_figures() -> list[Figure]:
    """Growth from the cycle `WARM_CYCLES` to the cycle `CYCLES`."""
    with ExitStack() as stack:
        telemetry = stack.enter_context(open_ring(4096, ROW_BYTES))
        shapes = stack.enter_context(open_ring(64, 1 << 16))
        truths = stack.enter_context(open_ring(16, TRUTH_BYTES))
        frames = FrameRing.for_optics(_CONFIG.optics)
        stack.callback(frames.close)
        clock = RunClock.start()
        ours, theirs = make_pipe()
        spec = AcquisitionSpec(_CONFIG, clock, telemetry, shapes, truths, frames.address)
        child = Child(
            "acquisition",
            "membrane_ctrl.acquisition.process:acquisition_main",
            (spec, theirs),
            nice=10,
        )
        rows = stack.enter_context(closing(RingWriter(telemetry)))
        truth = stack.enter_context(closing(RingWriter(truths)))
        reader = stack.enter_context(closing(RingReader(shapes)))
        child.start()
        stack.callback(child.stop, 10.0)
        cycles, warm_mb = 0, 0.0
        while cycles < CYCLES:
            now_s = clock.now()
            assert child.alive
            assert now_s < _PATIENCE_S
            rows.put(_row(now_s))
            truth.put(_TRUTH.pack())
            cycles += len(reader.drain())
            while ours.poll():
                ours.recv()
            if not warm_mb and cycles >= WARM_CYCLES:
                warm_mb = _rss_mb(child)
            time.sleep(0.02)
        grown = 100.0 * (_rss_mb(child) / warm_mb - 1.0)
    name = f"acquisition: memory grown from cycle {WARM_CYCLES} to {CYCLES}"
    return [at_most(name, grown, "%", 5.0, "MB at cycle 200", warm_mb)]


def _row(now_s: float) -> bytes:
    good = replace(_NOTHING, mono_s=now_s, displacement_um=0.0, displacement_quality=0.0)
    return replace(good, sample_counter=float(round(50 * now_s))).pack()


def _rss_mb(child: Child) -> float:
    return float(psutil.Process(child.pid).memory_info().rss) / 1e6
