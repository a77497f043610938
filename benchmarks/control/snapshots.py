"""Snapshots of the controller: what one costs a tick at 200 Hz, its size, and how fast a replay
starts with it.

The estimator runs, with its covariance of 71 x 71 states. A snapshot is taken between two ticks of
a held mirror, in the same run as the ticks that are its reference, and goes into a ring as in a
hold. Between two snapshots plant and board of the twin run, so that nothing is warm in the caches
that would not be so in a hold.
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Iterator
from contextlib import ExitStack

import numpy as np

from membrane_ctrl.config.schema import Config, EstimatorConfig, LoopConfig, TwinConfig
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.controller import Controller
from membrane_ctrl.controller.snapshot import continue_from, take_snapshot
from membrane_ctrl.controller.tick_codec import SNAPSHOT_MESSAGE_BYTES, pack_snapshot
from membrane_ctrl.hold.virtual_run import TruthShape, VirtualRun, VirtualTick
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.processes.ring import RingWriter, open_ring
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.virtual_bench import VirtualBench
from tests.support.figures import Figure, at_most

CONFIG = Config(
    loop=LoopConfig(rate_hz=200.0),
    estimator=EstimatorConfig(process_value="estimate"),
    twin=TwinConfig(start_error_um=-1.0, scenario="quiet"),
)
HELD_S, DURATION_S = 20.0, 60.0
EVERY_TICKS = 20
MOST_MS = 0.5


def run() -> list[Figure]:
    """The benchmark."""
    bench = VirtualBench(Plant(CONFIG.twin, CONFIG.pump))
    virtual = VirtualRun(CONFIG, bench, zernike_projection(), TruthShape(bench, CONFIG, 3, 0.036))
    controller = Controller(CONFIG, zernike_projection())
    ticks_s: list[float] = []
    snapshots_s: list[float] = []
    starts_s: list[float] = []
    snapshot = b""
    with ExitStack() as stack:
        writer = RingWriter(stack.enter_context(open_ring(4, SNAPSHOT_MESSAGE_BYTES)))
        stack.callback(writer.close)
        for number, tick in enumerate(_ticks(virtual), start=1):
            before_s = time.perf_counter()
            controller.tick(tick.inputs)
            after_s = time.perf_counter()
            if tick.row.mono_s < HELD_S:
                continue
            ticks_s.append(after_s - before_s)
            if number % EVERY_TICKS == 0:
                before_s = time.perf_counter()
                snapshot = take_snapshot(controller)
                writer.put(pack_snapshot(number + 1, snapshot))
                snapshots_s.append(time.perf_counter() - before_s)
    for _ in range(20):
        before_s = time.perf_counter()
        continue_from(snapshot, CONFIG, zernike_projection())
        starts_s.append(time.perf_counter() - before_s)
    tick_ms, snapshot_ms = 1e3 * np.median(ticks_s), 1e3 * np.median(snapshots_s)
    late_ms = 1e3 * np.quantile(snapshots_s, 0.95)
    return [
        at_most(
            "a snapshot, median",
            float(snapshot_ms),
            "ms",
            MOST_MS,
            "a tick, median",
            float(tick_ms),
        ),
        at_most(
            "a snapshot, 95 % of them within",
            float(late_ms),
            "ms",
            None,
            "a tick, median",
            float(tick_ms),
        ),
        at_most("size of a snapshot", len(snapshot) / 1e3, "kB"),
        at_most("its size compressed", len(zlib.compress(snapshot, 1)) / 1e3, "kB"),
        at_most("a controller made from it, median", float(1e3 * np.median(starts_s)), "ms"),
    ]


def _ticks(virtual: VirtualRun) -> Iterator[VirtualTick]:
    """Hold the mirror, with 16 figures a second."""
    virtual._shape_period_s = 0.06
    commands: tuple[Command, ...] = (Command("hold", "benchmark"),)
    while virtual.now_s < DURATION_S:
        tick = virtual.run_tick(commands)
        commands = ()
        assert tick is not None
        yield tick
