"""A bench without a laser, with rendered frames: anchored, tracked and held in virtual time, as in
a hold.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from membrane_ctrl.config.schema import (
    CameraConfig,
    Config,
    EstimatorConfig,
    OpticsConfig,
    ShapeConfig,
    TwinConfig,
)
from membrane_ctrl.controller.command import Command
from membrane_ctrl.hold.virtual_run import VirtualRun
from membrane_ctrl.metrology.cycle.live_reconstructor import LiveReconstructor
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.metrology.phase import pattern_sequence
from membrane_ctrl.metrology.tracking.live_tracker import LiveTracker
from membrane_ctrl.model.events import Fault, SensorsUsed
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.sim.optics.camera import TwinOptics
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.virtual_bench import VirtualBench

SHRINK, PERIOD_S = 8, 0.1
OPTICS = OpticsConfig(
    camera=CameraConfig(width_px=2448 // SHRINK, height_px=2048 // SHRINK, pixel_um=3.45 * SHRINK)
)
CONFIG = Config(
    estimator=EstimatorConfig(process_value="optics"),
    shape=ShapeConfig(mode="track", track_rate_hz=1 / PERIOD_S),
    optics=OPTICS,
    twin=TwinConfig(laser=False),
)


class Rendered:
    """A frame a period, of the pattern that the tracking asks for; its figure arrives a period
    later.
    """

    def __init__(self, bench: VirtualBench) -> None:
        self.now_s = 0.0
        self._optics = TwinOptics(OPTICS, CONFIG.twin, bench.plant.truth, self)
        self._tracker = LiveTracker(
            OPTICS, LiveReconstructor(OPTICS, 1), CONFIG.shape.track_periods, 10.0
        )
        self._cycle = list(pattern_sequence.full_sequence(OPTICS.pattern))
        self._frames: list[np.ndarray] = []
        self._times_s: list[float] = []
        self._done: ShapeEstimate | None = None
        self.anchored = False
        self.figures = 0

    def now(self) -> float:
        return self.now_s

    def __call__(self, now_s: float) -> ShapeEstimate | None:
        self.now_s, done, self._done = now_s, self._done, None
        self._optics.screen.show(
            self._tracker.pattern if self.anchored else self._cycle[len(self._frames)]
        )
        pixels = self._optics.camera.grab().pixels.copy()
        if self.anchored:
            self._done = self._tracker.measure_fringes([pixels], [now_s], [math.nan])
            self.anchored = not self._done.tracking_lost
        else:
            self._frames.append(pixels)
            self._times_s.append(now_s)
            if len(self._frames) == len(self._cycle):
                self._done = self._tracker.measure_full(
                    self._frames, self._times_s, [math.nan] * len(self._frames)
                )
                self.anchored = self._done.verdict != "rejected"
                self._frames, self._times_s = [], []
        self.figures += 1
        return None if done is None else replace(done, cycle=self.figures)


@pytest.mark.campaign
def test_rendered_frames_alone_start_settle_and_hold_a_mirror_through_another_anchor() -> None:
    bench = VirtualBench(Plant(CONFIG.twin, CONFIG.pump))
    source = Rendered(bench)
    run = VirtualRun(CONFIG, bench, zernike_projection(), source)
    run._shape_period_s = PERIOD_S
    rows, events = [], []
    while run.now_s < 60.0:
        if abs(run.now_s - 42.0) < 0.01:
            source.anchored = False  # as after a second without the order
        tick = run.run_tick(() if rows else (Command("hold", "a test", "it runs"),))
        assert tick is not None
        rows.append(tick.row)
        events += tick.events
    assert rows[-1].state == State.HOLD
    held = [event.sensors for event in events if isinstance(event, SensorsUsed)]
    assert held[0] == ("optics", "barometer", "thermometer")
    assert [event.name for event in events if isinstance(event, Fault)] == [
        "film_unseen"
    ]  # during the anchor
    time_s, true_um = np.array([(row.mono_s, row.truth_displacement_um) for row in rows]).T
    before = true_um[(time_s > 27.0) & (time_s < 42.0)]
    assert before.std() < 0.1
    assert np.abs(true_um[time_s > 42.0] - before.mean()).max() < 0.4
    assert true_um[time_s > 50.0].mean() == pytest.approx(before.mean(), abs=0.1)
