"""Scenario files: what happens to a simulated bench and when, and the expected outcome. One TOML file each.

[config.twin]            # what differs from the default configuration
scenario = "calm"

[[at]]                   # something is wrong with bench, link or process: a switch of `virtual_bench.Wrong`
time_s = 25.0
wrong = "no_light"
for_s = 10.0             # for ever when left out
every_s = 15.0           # again and again with this period, to the end; once when left out

[[at]]                   # something happens to the mirror: an event of `twin.events`
time_s = 40.0
event = "ambient"
value = 20.0             # Pa

[[at]]                   # somebody asks for something
time_s = 60.0
command = "lower"

[expect]
exit = "done"
faults = ["displacement_missing"]

[[expect.bounds]]
field = "truth_displacement_um"
from_s = 25.0
to_s = 35.0
low = -4.0
high = 4.0
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import Field, model_validator

from firmware_iface.settings import Section
from membrane_ctrl.config.schema import Config
from membrane_ctrl.config.toml_file import load
from membrane_ctrl.controller.commands import Command, Kind
from membrane_ctrl.hold.virtual_run import VirtualRun, VirtualTick
from membrane_ctrl.metrology.optics.hencky import zernike_projection
from membrane_ctrl.model.events import EventLine
from membrane_ctrl.model.telemetry import FIELDS
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.truth_shape import TruthShape
from membrane_ctrl.sim.virtual_bench import VirtualBench, Wrong
from tests.support import bench_events as happenings

_SWITCHES: dict[str, Any] = {field.name: field.default for field in fields(Wrong)}
_FRACTIONS = ("pump_share", "pump_stuck_fraction", "vent_stuck_fraction")  # the plant refuses values beyond
Happening = Literal["ambient", "air_temperature", "leak", "laser_dropout", "laser_drift", "power_cycle"]
_MAKE: dict[str, Callable[[At], happenings.BenchEvent]] = {
    "ambient": lambda at: happenings.AmbientChange(at.time_s, at.value, at.over_s),
    "air_temperature": lambda at: happenings.AirTemperatureChange(at.time_s, at.value, at.over_s),
    "leak": lambda at: happenings.LeakChange(at.time_s, at.value),
    "laser_dropout": lambda at: happenings.LaserDropout(at.time_s, at.over_s),
    "laser_drift": lambda at: happenings.LaserDrift(at.time_s, at.value, at.over_s or math.inf),
}


class At(Section):
    """One thing that happens: exactly one of `wrong`, `event` and `command`."""

    time_s: Annotated[float, Field(ge=0)]
    wrong: str | None = None
    for_s: Annotated[float, Field(gt=0)] | None = None
    every_s: Annotated[float, Field(ge=1e-3)] | None = None
    event: Happening | None = None
    over_s: Annotated[float, Field(ge=0)] = 0.0
    command: str | None = None
    value: float = 1.0
    text: str = ""

    @model_validator(mode="after")
    def _one_thing(self) -> At:
        if sum(thing is not None for thing in (self.wrong, self.event, self.command)) != 1:
            raise ValueError("give exactly one of wrong, event and command")
        if self.wrong is not None and self.wrong not in _SWITCHES:
            raise ValueError(f"wrong = {self.wrong!r} is unknown; known are {', '.join(_SWITCHES)}")
        if self.wrong in _FRACTIONS and not 0 <= self.value <= 1:
            raise ValueError(f"wrong = {self.wrong!r} with value = {self.value:g}: a fraction, 0 to 1")
        if self.for_s is not None and self.wrong is None:
            raise ValueError("for_s goes with wrong; an event has over_s")
        if self.over_s and self.event is None:
            raise ValueError("over_s goes with event; what is wrong has for_s")
        if self.every_s is not None and (self.wrong is None or self.for_s is None or self.for_s >= self.every_s):
            raise ValueError("every_s goes with wrong and with a for_s shorter than it")
        if self.command is not None and self.command not in get_args(Kind):
            raise ValueError(f"command = {self.command!r} is unknown; known are {', '.join(get_args(Kind))}")
        return self


class Bound(Section):
    """A telemetry field stays within bounds: every row, or the mean over `mean_s`; and its standard deviation."""

    field: str
    from_s: float = 0.0
    to_s: Annotated[float, Field(gt=0)] = 1e9
    low: float | None = None
    high: float | None = None
    std_max: Annotated[float, Field(gt=0)] | None = None
    mean_s: Annotated[float, Field(gt=0)] | None = None

    @model_validator(mode="after")
    def _known(self) -> Bound:
        if self.field not in FIELDS:
            raise ValueError(f"field = {self.field!r} is not in the telemetry; known are {', '.join(FIELDS)}")
        if self.low is None and self.high is None and self.std_max is None:
            raise ValueError("give low, high or std_max")
        return self


class Expectation(Section):
    """The expected outcome; omitted keys are not checked."""

    exit: Literal["done", "safety_trip", "device_failed", "interrupted"] | None = None
    states: tuple[str, ...] | None = None
    faults: tuple[str, ...] | None = None
    shape_reasons: tuple[str, ...] = ()  # each must be part of a reason that the shape loop gave
    events: tuple[str, ...] = ()  # kinds that must occur
    bounds: tuple[Bound, ...] = ()


class Scenario(Section):
    """One scenario file."""

    title: str
    duration_s: Annotated[float, Field(gt=0, le=1e7)] = 60.0
    shapes: bool = False  # the camera measures; its shapes are made from the truth
    config: Config = Config()
    at: tuple[At, ...] = ()
    expect: Expectation

    @model_validator(mode="after")
    def _before_the_end(self) -> Scenario:
        for number, at in enumerate(self.at):
            if at.time_s >= self.duration_s:
                raise ValueError(
                    f"at.{number}: time_s = {at.time_s:g} is not before duration_s = {self.duration_s:g}"
                )
        return self


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of a scenario.

    Attributes
    ----------
    ticks : tuple of VirtualTick
        All ticks that ran.
    events : tuple of dict
        All events, with `mono_s`.
    bench : VirtualBench
        State at the end.
    """

    ticks: tuple[VirtualTick, ...]
    events: tuple[EventLine, ...]
    bench: VirtualBench

    def of(self, kind: str) -> list[EventLine]:
        """The events of a kind."""
        return [event for event in self.events if event["kind"] == kind]


def load_scenario(path: Path) -> Scenario:
    """Read a scenario. Raises InputError: one line that names the file, the field and a valid value."""
    return load(path, Scenario)


def play(scenario: Scenario) -> Outcome:
    """Run a scenario in virtual time, from the command `hold` until its end and 5 s of aftermath."""
    config = scenario.config
    steps = sorted(scenario.at, key=lambda at: at.time_s)
    plant = Plant(config.twin, config.pump, tuple(_MAKE[at.event](at) for at in steps if at.event in _MAKE))
    bench = VirtualBench(plant, config.devices.watchdog_s if config.devices else 0.5)
    shape = TruthShape(bench, config, config.twin.seed) if scenario.shapes else None
    run = VirtualRun(config, bench, zernike_projection(), shape)
    wish = Command("hold", "scenario")
    agenda = [(0.0, wish), *_agenda(steps, scenario.duration_s), (scenario.duration_s, Command("stop", "duration"))]
    agenda.sort(key=lambda entry: entry[0])
    ticks: list[VirtualTick] = []
    while run.finished is None and run.now_s < scenario.duration_s + 60.0:
        commands: list[Command] = []
        while agenda and agenda[0][0] <= run.now_s:
            _, due = agenda.pop(0)
            if isinstance(due, Command):
                commands.append(due)
            else:
                due(bench)
        tick = run.tick(tuple(commands))
        if tick is not None:
            ticks.append(tick)
    bench.advance(5.0)
    events = tuple({**event.to_dict(), "mono_s": tick.row.mono_s} for tick in ticks for event in tick.events)
    return Outcome(tuple(ticks), events, bench)


def failures(expect: Expectation, outcome: Outcome) -> Iterator[str]:
    """Deviations from the expected outcome, a line each."""
    finished = outcome.ticks[-1].outputs.finished if outcome.ticks else None
    exit_name = "none" if finished is None else finished.name.lower()
    found: list[tuple[str, Any, Any]] = [
        ("exit", expect.exit, exit_name),
        ("states", expect.states, tuple(e["state"] for e in outcome.of("state"))),
        ("faults", expect.faults, tuple(e["name"] for e in outcome.of("fault"))),
    ]
    yield from (f"{name}: {got}, not {wanted}" for name, wanted, got in found if wanted is not None and wanted != got)
    kinds = {event["kind"] for event in outcome.events}
    yield from (f"no event of kind {kind}" for kind in expect.events if kind not in kinds)
    reasons = [str(event["reason"]) for event in outcome.of("shape")]
    for part in expect.shape_reasons:
        if not any(part in reason for reason in reasons):
            yield f"the shape loop never said {part!r}; it said {reasons}"
    for bound in expect.bounds:
        yield from _broken(bound, outcome)


Due = Command | Callable[[VirtualBench], None]


def _agenda(steps: list[At], end_s: float) -> Iterator[tuple[float, Due]]:
    """Actions by time; a switch returns when its time is over."""
    for at in steps:
        if at.command is not None:
            command = Command(at.command, "scenario", value=at.value, text=at.text)  # type: ignore[arg-type]  # checked
            yield at.time_s, command
        elif at.wrong is not None:
            times = 1 if at.every_s is None else max(1, math.ceil((end_s - at.time_s) / at.every_s))
            for begin_s in (at.time_s + k * (at.every_s or 0.0) for k in range(times)):
                yield begin_s, _switch(at.wrong, at.value)
                if at.for_s is not None:
                    yield begin_s + at.for_s, _switch(at.wrong, _SWITCHES[at.wrong])
        elif at.event == "power_cycle":
            yield at.time_s, VirtualBench.power_cycle


def _switch(name: str, value: Any) -> Callable[[VirtualBench], None]:
    kind = type(_SWITCHES[name])
    return lambda bench: setattr(bench.wrong, name, kind(value))


def _broken(bound: Bound, outcome: Outcome) -> Iterator[str]:
    rows = [tick.row for tick in outcome.ticks if bound.from_s <= tick.row.mono_s <= bound.to_s]
    values = np.array([getattr(row, bound.field) for row in rows])
    where = f"{bound.field} from {bound.from_s:g} s to {bound.to_s:g} s"
    if bound.mean_s is not None and rows:
        bins = ((np.array([row.mono_s for row in rows]) - rows[0].mono_s) / bound.mean_s).astype(int)
        values = np.array([values[bins == k].mean() for k in range(int(bins[-1]))])  # the last bin is cut
    if not values.size or not np.isfinite(values).all():
        yield f"{where}: not there all the time"
        return
    if bound.low is not None and values.min() < bound.low:
        yield f"{where}: {values.min():.4g}, below {bound.low:g}"
    if bound.high is not None and values.max() > bound.high:
        yield f"{where}: {values.max():.4g}, above {bound.high:g}"
    if bound.std_max is not None and values.std() > bound.std_max:
        yield f"{where}: standard deviation {values.std():.4g}, above {bound.std_max:g}"
