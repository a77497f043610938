"""The supervisor's own loop gives the same rows, to the bit, as a virtual run that steps it."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta
from typing import cast

import pytest

from membrane_ctrl.config.schema import Config, LoopConfig, TwinConfig
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.controller import Controller
from membrane_ctrl.controller.tick import TickOutputs
from membrane_ctrl.hold.supervisor import Supervisor, Wiring, newest_of
from membrane_ctrl.hold.virtual_run import TruthShape, VirtualRun
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.errors import Exit
from membrane_ctrl.model.shape_estimate import ShapeEstimate, pack_estimate, unpack_estimate
from membrane_ctrl.model.telemetry import FIELDS, ROW_BYTES
from membrane_ctrl.processes.ring import RingReader, RingWriter, open_ring
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.virtual_bench import VirtualBench
from tests.support.virtual_time import run_virtual as in_virtual_time
from tests.worlds.loop_bench import LoopBench

# a power of two, so that the supervisor's sum of periods is exact and both tick at the same
# instants to the bit
RATE_HZ = 32.0
CONFIG = Config(loop=LoopConfig(rate_hz=RATE_HZ), twin=TwinConfig(seed=11))
LASTS_S = 60.0
FAULT_S, OVER_S = 30.0, 33.0

Upset = Callable[[VirtualBench, bool], None]
HOLD, STOP = Command("hold", "test"), Command("stop", "duration")


def switched(name: str, on: object, off: object) -> Upset:
    """A switch that is on while the fault lasts."""
    return lambda bench, lasts: setattr(bench.wrong, name, on if lasts else off)


UPSETS: dict[str, Upset] = {
    "nothing": lambda bench, lasts: None,
    "unreachable": switched("unreachable", True, False),
    "no shapes": switched("camera_lost", True, False),
}


def upset_between(bench: VirtualBench, upset: Upset, from_s: float, to_s: float) -> None:
    """Turn the switches as they stand during the period that ends at `to_s`."""
    for at_s, lasts in ((FAULT_S, True), (OVER_S, False)):
        if from_s < at_s <= to_s:
            upset(bench, lasts)


class LoopClock:
    """A `RunClock` that reads the event loop's time."""

    def now(self) -> float:
        return asyncio.get_running_loop().time()

    def utc(self, mono_s: float) -> datetime:
        return datetime(2026, 1, 1, tzinfo=UTC) + timedelta(seconds=mono_s)


class UpsetBench(LoopBench):
    """The bench with an upset and with shapes."""

    def __init__(self, upset: Upset, shapes: RingWriter) -> None:
        super().__init__(CONFIG)
        self._upset, self._upset_s = upset, 0.0
        self._shapes, self._shape, self._shape_due_s = (
            shapes,
            TruthShape(self.virtual, CONFIG, 5),
            0.0,
        )

    def before(self, now_s: float) -> None:
        upset_between(self.virtual, self._upset, self._upset_s, now_s)
        self._upset_s = now_s

    def truth(self) -> tuple[float, float]:
        truth, now_s = self.now().truth, asyncio.get_running_loop().time()
        if now_s >= self._shape_due_s:
            self._shape_due_s += CONFIG.shape.period_s
            estimate = self._shape(now_s)
            if estimate is not None:
                self._shapes.put(pack_estimate(estimate))
        return truth.displacement_um, truth.laser_bias_um


def supervised(upset: Upset) -> tuple[list[TickOutputs], Exit]:
    """The run of a supervisor with rings and event loop, but without processes."""
    heard: list[TickOutputs] = []

    async def hold() -> Exit:
        with ExitStack() as stack:
            sizes = {"telemetry": ROW_BYTES, "events": 4096, "shapes": 1 << 15}
            addresses = {
                name: stack.enter_context(open_ring(16, size)) for name, size in sizes.items()
            }
            telemetry, events, shapes = (RingWriter(addresses[name]) for name in sizes)
            reader = RingReader(addresses["shapes"])
            for end in (telemetry, events, shapes, reader):
                stack.callback(end.close)
            bench = UpsetBench(upset, shapes)
            wiring = Wiring(
                bench,
                telemetry,
                events,
                shapes=newest_of(reader),
                truth=bench.truth,
                tick_listeners={"test": heard.append},
            )
            controller = Controller(CONFIG, zernike_projection())
            await bench.open()
            supervisor = Supervisor(controller, wiring, cast(RunClock, LoopClock()), RATE_HZ)
            supervisor.queue_command(HOLD)
            return await supervisor.run(LASTS_S)

    return heard, in_virtual_time(hold())


def virtual(upset: Upset) -> tuple[list[TickOutputs], Exit | None]:
    """The same without them."""
    bench = VirtualBench(Plant(CONFIG.twin, CONFIG.pump))
    truth = TruthShape(bench, CONFIG, 5)

    def shape(now_s: float) -> ShapeEstimate | None:
        estimate = truth(now_s)
        return None if estimate is None else unpack_estimate(pack_estimate(estimate))

    run = VirtualRun(CONFIG, bench, zernike_projection(), shape)
    outputs: list[TickOutputs] = []
    while run.finished is None:
        next_s = run.now_s + 1.0 / RATE_HZ
        upset_between(bench, upset, run.now_s, next_s)
        tick = run.run_tick((HOLD,) * (next_s == 1.0 / RATE_HZ) + (STOP,) * (next_s == LASTS_S))
        assert tick is not None
        outputs.append(tick.outputs)
    return outputs, run.finished


@pytest.mark.parametrize("name", UPSETS)
def test_a_virtual_run_is_the_supervisors(name: str) -> None:
    theirs, their_exit = supervised(UPSETS[name])
    ours, our_exit = virtual(UPSETS[name])
    assert len(theirs) > FAULT_S * RATE_HZ
    for their, our in zip(theirs, ours, strict=False):
        differs = {
            field: (a, b)
            for field in FIELDS
            for a, b in [(getattr(their.row, field), getattr(our.row, field))]
            if a != b and not (math.isnan(a) and math.isnan(b))
        }
        assert not differs, f"{our.row.mono_s} s"
        assert their.events == our.events
    assert (len(theirs), their_exit) == (len(ours), our_exit)


def test_the_disturbances_of_the_comparison_have_an_effect() -> None:
    quiet = [output.row.pack() for output in virtual(UPSETS["nothing"])[0]]
    for name in UPSETS.keys() - {"nothing"}:
        assert [output.row.pack() for output in virtual(UPSETS[name])[0]] != quiet, name
