"""A second program on the board of a running hold: what is permitted, and how the hold reacts."""

from __future__ import annotations

from firmware_iface import roles
from firmware_iface.drivers.pump_board import PumpBoard
from membrane_ctrl.config.schema import Config, LoopConfig, ResumeConfig, ShapeConfig, StatesConfig
from membrane_ctrl.controller.command import Command
from membrane_ctrl.hold.virtual_run import VirtualRun, VirtualTick
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.events import Fault
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.virtual_bench import MemoryLink, VirtualBench, at_once

CONFIG = Config(
    loop=LoopConfig(rate_hz=10.0),
    shape=ShapeConfig(enabled=False),
    states=StatesConfig(stay_after_trip=True),
    resume=ResumeConfig(faults=("watchdog_tripped", "link_lost", "device_silent"), wait_s=1.0),
)


class Story:
    """A hold in virtual time, until it holds."""

    def __init__(self) -> None:
        self.bench = VirtualBench(Plant(CONFIG.twin, CONFIG.pump), watchdog_s=0.5)
        self.run = VirtualRun(CONFIG, self.bench, zernike_projection())
        self.ticks = [self._ticked(Command("hold", "test"))]
        while self.ticks[-1].row.state != State.HOLD:
            self.ticks.append(self._ticked())

    def _ticked(self, *commands: Command) -> VirtualTick:
        tick = self.run.run_tick(commands)
        assert tick is not None
        return tick

    def go_on(self, duration_s: float) -> list[VirtualTick]:
        return [self._ticked() for _ in range(round(duration_s * CONFIG.loop.rate_hz))]

    def stall(self, duration_s: float) -> None:
        self.bench.wrong.stalled = True
        for _ in range(round(duration_s * CONFIG.loop.rate_hz)):
            self.run.run_tick()
        self.bench.wrong.stalled = False


def intrude(bench: VirtualBench, pump_fraction: float) -> str:
    """Another program claims the board, clears its faults and pumps; returns the refusal, or
    nothing.
    """
    other = PumpBoard("", watchdog_s=10.0, link=MemoryLink(bench))
    try:
        at_once(other.open())
        at_once(other.clear_faults(roles.ALL_FAULTS))
        at_once(other.write(roles.BenchCommand(pump_fraction, 0.0)))
    except roles.LinkError as error:
        return str(error)
    return ""


def faults(ticks: list[VirtualTick]) -> list[str]:
    return [event.name for tick in ticks for event in tick.events if isinstance(event, Fault)]


def test_a_second_program_is_refused_as_long_as_the_hold_feeds_the_watchdog() -> None:
    story = Story()
    for _ in range(20):
        assert "another program holds the board" in intrude(story.bench, 1.0)
        (tick,) = story.go_on(0.1)
        assert (tick.row.state, tick.row.fault) == (State.HOLD, 0)
        assert story.bench.board.pump_fraction < 0.9
    story.stall(1.0)
    assert story.bench.board.pump_fraction == 0.0  # what was refused has not fed the watchdog


def test_a_hold_that_lost_its_board_detects_it_in_the_next_tick_and_never_reclaims_it() -> None:
    story = Story()
    story.stall(1.0)
    assert intrude(story.bench, 0.2) == ""
    (first,) = story.go_on(0.1)
    assert faults([first]) == ["board_taken"]
    assert first.outputs.command.pump_fraction == 0.0
    assert (
        story.bench.board.pump_fraction == 0.2
    )  # the other program's, which is responsible for it
    later = story.go_on(5.0)
    assert {tick.outputs.command.pump_fraction for tick in later} == {0.0}
    story.stall(11.0)  # also the other one's claim lapses
    later += story.go_on(30.0)
    assert {tick.row.state for tick in later} == {State.FAULT}
    assert faults(later) == []
    assert story.bench.board.pump_fraction == 0.0


def test_a_stop_by_any_program_is_a_fault_in_the_next_tick_and_never_resumes() -> None:
    story = Story()
    story.bench.board.write(story.bench.board.registers.register("stop").address, [1])
    assert story.bench.board.pump_fraction == 0.0
    (first,) = story.go_on(0.1)
    assert faults([first]) == ["board_fault"]
    later = story.go_on(40.0)
    assert {tick.row.state for tick in later} == {State.FAULT}
    assert story.bench.board.pump_fraction == 0.0


def test_a_board_that_was_stopped_before_the_hold_began_is_a_fault_of_its_check() -> None:
    """Not only once the actuator test has found that the film does not move."""
    bench = VirtualBench(Plant(CONFIG.twin, CONFIG.pump), watchdog_s=0.5)
    run = VirtualRun(CONFIG, bench, zernike_projection())
    bench.board.write(bench.board.registers.register("stop").address, [1])
    ticks = [
        tick for _ in range(10) if (tick := run.run_tick((Command("hold", "test"),))) is not None
    ]
    assert faults(ticks) == ["board_fault"]
    assert {tick.outputs.command.pump_fraction for tick in ticks} == {0.0}
