"""A mirror, its board and its controller, for stories: command, wait, and note what is wrong."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from campaign_run import config_of
from campaign_times import TICK_S, WATCHDOG_S
from campaign_world import WatchedPlant, World

from firmware_iface.drivers.pump_board import PumpBoard
from firmware_iface.emulators.pump_board import BoardSample
from membrane_ctrl.config.schema import Config
from membrane_ctrl.controller.command import Command, Kind
from membrane_ctrl.hold.virtual_run import TruthShape, VirtualRun
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.sim.virtual_bench import MemoryLink, VirtualBench

_WORDS = 2**16


@dataclass
class Stage:
    """A mirror, its board and its controller; `violations` lists what was wrong."""

    world: World = field(default_factory=World)
    resumes: bool = False
    camera: bool = False
    config: Config | None = None
    violations: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.config = self.config or config_of(1, self.world, self.resumes)
        self.plant = WatchedPlant(self.world, self.config.twin, self.config.pump)
        self.bench = self.make_bench()
        self.change_figure: Callable[[ShapeEstimate], ShapeEstimate] = lambda figure: figure
        true_shape = TruthShape(self.bench, self.config, 1)

        def measure(now_s: float) -> ShapeEstimate | None:
            figure = true_shape(now_s)
            return None if figure is None else self.change_figure(figure)

        source = measure if self.camera else None
        self.run = VirtualRun(self.config, self.bench, zernike_projection(), source)
        self.state = State.STANDBY

    def make_bench(self) -> VirtualBench:
        """The board at the mirror, before anybody has opened it."""
        return VirtualBench(self.plant, WATCHDOG_S)

    def tick(self, *commands: Command) -> None:
        """One period."""
        tick = self.run.run_tick(commands)
        if tick is not None:
            self.state = State(int(tick.row.state))

    def ask(self, *kinds: Kind, value: float = math.nan) -> None:
        """Commands of one tick."""
        self.tick(*(Command(kind, "story", value=value) for kind in kinds))

    def wait(self, seconds: float, check: Callable[[], str] | None = None) -> None:
        """Let time pass; `check` returns what is wrong now."""
        for _ in range(round(seconds / TICK_S)):
            self.tick()
            if check is not None and (wrong := check()):
                self.must(False, wrong)

    def until(self, state: State, most_s: float = 120.0) -> None:
        """Wait for a state."""
        for _ in range(round(most_s / TICK_S)):
            if self.state == state:
                return
            self.tick()
        self.must(False, f"{state.name} did not come within {most_s:g} s")

    def held(self) -> Stage:
        """Ask for a hold, and wait for it."""
        self.ask("hold")
        self.until(State.HOLD)
        return self

    def must(self, true: bool, what: str) -> None:
        """Note a violation unless this is true."""
        if not true and len(self.violations) < 3:
            self.violations.append(f"{self.run.now_s:.2f} s in {self.state.name.lower()}: {what}")

    def still(self) -> str:
        """The violation if the pump is driven."""
        return (
            f"the pump is driven with {self.plant.pump_given:.2f}"
            if self.plant.pump_given > 0
            else ""
        )

    def near(self, target_um: float = 0.0, within_um: float = 10.0) -> None:
        """The mirror is where it should be."""
        off_um = self.plant.truth().displacement_um - target_um
        self.must(abs(off_um) < within_um, f"the mirror is {off_um:.1f} µm off")


Change = Callable[[BoardSample], BoardSample]


def sensors_say(stage: Stage, change: Change) -> None:
    """Insert sensors between the plant and the board."""
    sample_of = stage.plant.sample_of
    stage.plant.sample_of = lambda truth: change(sample_of(truth))  # type: ignore[method-assign]


class OldBoard(Stage):
    """A board that has long been on: its heartbeat and its sample counter are about to wrap."""

    def make_bench(self) -> VirtualBench:
        sensors_say(
            self, lambda sample: replace(sample, sample_counter=sample.sample_counter + 2**32 - 500)
        )
        bench = VirtualBench(self.plant, WATCHDOG_S)
        bench.board._heartbeat_fed = bench.board._settable["heartbeat"] = float(_WORDS - 300)
        return bench


def another_client(stage: Stage, watchdog_s: float = WATCHDOG_S) -> PumpBoard:
    """A driver of another program on the same board."""
    return PumpBoard("", watchdog_s=watchdog_s, link=MemoryLink(stage.bench))
