"""A scenario in virtual time: applies what the file states to the twin, tick after tick."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from membrane_ctrl.controller.command import Command
from membrane_ctrl.hold.closing_words import RunEnd
from membrane_ctrl.hold.scenario_file import INTERLOCK_SWITCHES, SWITCHES, Scenario, ScenarioStep
from membrane_ctrl.hold.virtual_run import Rings, TruthShape, VirtualRun, VirtualTick
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.sim import bench_events, plant, virtual_bench, virtual_interlocks

_AFTERMATH_S = 60.0  # a run whose process hangs never ends
_EVENTS: dict[str, Callable[[ScenarioStep], bench_events.BenchEvent]] = {
    "ambient": lambda at: bench_events.AmbientChange(at.time_s, at.value, at.over_s),
    "air_temperature": lambda at: bench_events.AirTemperatureChange(at.time_s, at.value, at.over_s),
    "leak": lambda at: bench_events.LeakChange(at.time_s, at.value),
    "laser_dropout": lambda at: bench_events.LaserDropout(at.time_s, at.over_s),
    "laser_drift": lambda at: bench_events.LaserDrift(at.time_s, at.value, at.over_s or math.inf),
    "daily_temperature": lambda at: bench_events.DailyTemperature(at.value),
    "pressure_weather": lambda at: bench_events.PressureWeather(at.value),
}

ScheduledAction = Command | Callable[[virtual_bench.VirtualBench], None]
Ticks = Iterable[VirtualTick | None]  # None: the control process misses one


class ScenarioRun:
    """A scenario in virtual time, from the request to hold until its end; `rings` as in
    `VirtualRun`.
    """

    def __init__(self, scenario: Scenario, rings: Rings | None = None) -> None:
        self.config = config = scenario.config
        self.closing = RunEnd()
        # The twin with the events of its plant and the switches of its bench.
        steps = sorted(scenario.at, key=lambda at: at.time_s)
        mirror = plant.Plant(
            config.twin,
            config.pump,
            tuple(_EVENTS[at.event](at) for at in steps if at.event in _EVENTS),
        )
        self.bench = virtual_bench.VirtualBench(
            mirror,
            config.devices.watchdog_s if config.devices else 0.5,
            interlocks=virtual_interlocks.VirtualInterlocks(config.interlocks),
        )
        shape = None
        if scenario.shapes:
            shape = TruthShape(self.bench, config, config.twin.seed)
        self.virtual = VirtualRun(config, self.bench, zernike_projection(), shape, rings=rings)
        # What happens when: the hold begins, the steps, the hold stops.
        self._ends_s = scenario.duration_s
        begin = (0.0, Command("hold", "scenario"))
        end = (scenario.duration_s, Command("stop", "duration"))
        agenda: list[tuple[float, ScheduledAction]] = [
            begin,
            *_list_actions(steps, scenario.duration_s),
            end,
        ]
        self._agenda = deque(sorted(agenda, key=lambda entry: entry[0]))

    def ticks(self) -> Ticks:
        """Run tick after tick."""
        run = self.virtual
        while run.finished is None and run.now_s < self._ends_s + _AFTERMATH_S:
            commands: list[Command] = []
            while self._agenda and self._agenda[0][0] <= run.now_s:
                _, due = self._agenda.popleft()
                if isinstance(due, Command):
                    commands.append(due)
                else:
                    due(self.bench)
            tick = run.run_tick(tuple(commands))
            if tick is not None:
                self.closing.handle_tick(tick.outputs)
            yield tick
        self.closing.exit = run.exit_code

    def stop(self, who: str) -> None:
        """End the run now."""
        self._ends_s = self.virtual.now_s
        self._agenda = deque([(0.0, Command("stop", who))])


def _list_actions(
    steps: list[ScenarioStep], end_s: float
) -> Iterator[tuple[float, ScheduledAction]]:
    """What is to be done when; a switch returns to its default when its time is over."""
    for at in steps:
        if at.command is not None:
            command = Command(at.command, "scenario", value=at.value, text=at.text)  # type: ignore[arg-type]  # checked
            yield at.time_s, command
        elif at.wrong is not None:
            # A fault of the bench may be repeated, and may end by itself.
            times = 1
            if at.every_s is not None:
                times = max(1, math.ceil((end_s - at.time_s) / at.every_s))
            if at.interlock is not None:
                wrong, right = (
                    _switch_interlock(at.wrong, at.interlock, on) for on in (at.value != 0, False)
                )
            else:
                wrong = _set_switch(at.wrong, at.value)
                right = _set_switch(at.wrong, SWITCHES[at.wrong])
            for begin_s in (at.time_s + k * (at.every_s or 0.0) for k in range(times)):
                yield begin_s, wrong
                if at.for_s is not None:
                    yield begin_s + at.for_s, right
        elif at.event == "power_cycle":
            yield at.time_s, virtual_bench.VirtualBench.power_cycle


def _set_switch(name: str, value: Any) -> Callable[[virtual_bench.VirtualBench], None]:
    kind = type(SWITCHES[name])
    return lambda bench: setattr(bench.wrong, name, kind(value))


def _switch_interlock(
    switch: str, name: str, on: bool
) -> Callable[[virtual_bench.VirtualBench], None]:
    def act(bench: virtual_bench.VirtualBench) -> None:
        names = INTERLOCK_SWITCHES[switch](bench.interlocks)
        if on:
            names.add(name)
        else:
            names.discard(name)

    return act
