"""Tracking on devices: an emulated GigE Vision camera at full size, read, decoded and fitted 20
times a second.

The camera is a process of its own, so that its work is not counted; its pictures are rendered
beforehand. What is counted is one process that does what a hold's acquisition does: read the
camera, keep the frame, fit its figure.
"""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from multiprocessing.sharedctypes import Synchronized
from typing import Any

import numpy as np

from benchmarks.metrology.acquisition import LaserAtRest
from firmware_iface.drivers.camera_aravis import AravisCamera
from firmware_iface.guarded_camera import GuardedCamera
from firmware_iface.optical_roles import DriverClock, Pattern, SensorFormat
from firmware_iface.settings import AravisCameraConfig
from membrane_ctrl.acquisition.cycle import CycleDone, ShapeCycle
from membrane_ctrl.acquisition.cycle_plan import CyclePlan
from membrane_ctrl.acquisition.waiting_clock import WaitingClock
from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.cycle.live_reconstructor import LiveReconstructor
from membrane_ctrl.metrology.phase.pattern_sequence import fringe_sequence, full_sequence
from membrane_ctrl.metrology.tracking.live_tracker import LiveTracker, crossed_patterns
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.processes.frames import FrameRing, FrameWriter
from membrane_ctrl.sim.optics.camera import OpticsRenderer
from membrane_ctrl.sim.optics.film_shape import typical_film
from tests.support.figures import Figure, at_least, at_most
from tests.worlds.gige_camera import GigeCameraEmulator

OPTICS = OpticsConfig()
RATE_HZ, EXPOSURE_MS, PERIODS, STEP_S = 20.0, 10.0, 32, 10.0
# pictures of each crossed pattern, and one that gives the bins their light and never comes again
NOISES = 4
FRAMES = 400
SETTLE_S = 0.03
PATIENCE_S = 120.0


def _camera(shown: Synchronized[int], ready: Any, done: Any) -> None:
    """Answer as a camera until `done`."""
    renderers = [
        OpticsRenderer(OPTICS, typical_film(37.1, 500.0, 1), seed=seed)
        for seed in range(NOISES + 1)
    ]
    pictures = [
        [renderers[0].render_picture(pattern, 0.0).copy()]
        for pattern in full_sequence(OPTICS.pattern)
    ]
    pictures += [
        [r.render_picture(pattern, 0.0).copy() for r in renderers]
        for pattern in crossed_patterns(PERIODS)
    ]
    counts = [0] * len(pictures)

    def expose(exposure_ms: float, gain: int) -> Any:
        of, count = pictures[shown.value], counts[shown.value]
        counts[shown.value] += 1
        return of[1 + count % NOISES if count and len(of) > 1 else 0]

    with GigeCameraEmulator(expose, OPTICS.camera.width_px, OPTICS.camera.height_px):
        ready.set()
        done.wait()


class Panel:
    """A screen that the camera's process knows of."""

    def __init__(self, shown: Synchronized[int], patterns: Sequence[Pattern]) -> None:
        self._shown, self._patterns, self._lit = shown, list(patterns), -1

    def begin(self, pattern: Pattern) -> None:
        """Send it."""
        now = self._patterns.index(pattern)
        if now != self._lit:
            self._lit = self._shown.value = now
            self._settled_s = time.monotonic() + SETTLE_S

    def wait(self) -> None:
        """Until it is settled."""
        time.sleep(max(self._settled_s - time.monotonic(), 0.0))

    def show(self, pattern: Pattern) -> None:
        """Role Screen."""
        self.begin(pattern)
        self.wait()

    def close(self) -> None:
        """Nothing is open."""


def run() -> list[Figure]:
    """All figures."""
    context = multiprocessing.get_context("spawn")
    shown, ready, done = context.Value("i", 0), context.Event(), context.Event()
    child = context.Process(target=_camera, args=(shown, ready, done))
    child.start()
    try:
        assert ready.wait(PATIENCE_S), "the emulated camera did not start"
        return _measured(Panel(shown, [*full_sequence(OPTICS.pattern), *crossed_patterns(PERIODS)]))
    finally:
        done.set()
        child.join()


def _measured(screen: Panel) -> list[Figure]:
    clock = WaitingClock(RunClock.start())
    config = AravisCameraConfig(camera="127.0.0.1", exposure_ms=EXPOSURE_MS, packet_bytes=60_000)
    with ExitStack() as stack:
        sensor = SensorFormat(OPTICS.camera.width_px, OPTICS.camera.height_px)
        driver = AravisCamera(config, sensor, DriverClock(clock.now, clock.sleep))
        camera = GuardedCamera(driver, sensor, clock.now, "camera aravis")
        stack.callback(camera.close)
        camera.open()
        ring = FrameRing.for_optics(OPTICS)
        stack.callback(ring.close)
        writer = FrameWriter(ring.address)
        stack.callback(writer.close)
        tracker = LiveTracker(OPTICS, LiveReconstructor(OPTICS), PERIODS, STEP_S, EXPOSURE_MS / 1e3)
        plan = CyclePlan(full_sequence(OPTICS.pattern), fringe_sequence(OPTICS.pattern), 0.0)
        plan = replace(plan, standing=lambda: tracker.pattern)
        cycle = ShapeCycle(camera, screen, tracker, plan, writer, clock, LaserAtRest())
        cycle.want_full()
        for _ in range(30):  # the anchor, its five steps, and what is compiled
            assert isinstance(cycle.run_cycle(), CycleDone)
            cycle.prepare_next()
        verdicts, late_ms, due_s = [], [], clock.now()
        begin_s, busy_s = clock.now(), time.process_time()
        for _ in range(FRAMES):
            clock.sleep(max(due_s - clock.now(), 0.0))
            due_s = max(due_s + tracker.interval_factor / RATE_HZ, clock.now())
            one = cycle.run_cycle()
            assert isinstance(one, CycleDone)
            verdicts.append(one.estimate.verdict)
            late_ms.append(1e3 * (clock.now() - one.estimate.time_s) - EXPOSURE_MS / 2)
            cycle.prepare_next()
        passed_s, busy_s = clock.now() - begin_s, time.process_time() - busy_s
        lost = driver.counts.incomplete + driver.counts.missing
    good = verdicts.count("ok")
    return [
        at_most(
            "one core's share, 20 figures a second, camera's reading included",
            100 * busy_s / passed_s,
            "%",
            12.0,
        ),
        Figure("processor of one figure", 1e3 * busy_s / FRAMES, "ms"),
        at_least("figures a second", FRAMES / passed_s, "1/s", RATE_HZ / 1.1),
        at_least("figures that are ok", 100 * good / FRAMES, "%", 99.0),
        at_most("figure after the frame's end, median", float(np.median(late_ms)), "ms", 15.0),
        Figure(
            "figure after the frame's end, 95th percentile", float(np.percentile(late_ms, 95)), "ms"
        ),
        Figure("figures within 15 ms", 100 * float(np.mean(np.array(late_ms) < 15.0)), "%"),
        at_most("frames lost and retaken", lost, "of all", None),
    ]
