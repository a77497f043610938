"""Scenarios: what happens to a simulated bench and when, one TOML file each
(docs/reference/scenarios.md); `twin play`.
"""

from __future__ import annotations

import contextlib
import math
import signal
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args

from pydantic import Field, model_validator

from firmware_iface.settings import Section
from membrane_ctrl.config import schema, toml_file
from membrane_ctrl.console import process, why
from membrane_ctrl.controller import tick_codec
from membrane_ctrl.controller.commands import Command, Kind
from membrane_ctrl.hold import scenario, scenarios
from membrane_ctrl.hold.closing_words import Closing, report
from membrane_ctrl.hold.virtual_run import Rings, TruthShape, VirtualRun, VirtualTick
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model import clock, program, run_events, telemetry, terminal
from membrane_ctrl.processes import child, ring
from membrane_ctrl.recorder.process import prepare_rerun
from membrane_ctrl.run_files.run_folder import create_run_folder
from membrane_ctrl.sim import plant, surroundings, virtual_bench, virtual_interlocks

_SWITCHES: dict[str, Any] = {field.name: field.default for field in fields(virtual_bench.Wrong)}
# Switches of one interlock, which the key `interlock` names
_INTERLOCK_SWITCHES: dict[str, Callable[[virtual_interlocks.VirtualInterlocks], set[str]]] = {
    "interlock_open": lambda interlocks: interlocks.open_names,
    "interlock_lost": lambda interlocks: interlocks.lost_names,
}
_FRACTIONS = (
    "pump_share",
    "pump_stuck_fraction",
    "vent_stuck_fraction",
)  # the plant refuses values beyond
_REPEATS_MAX = 100_000
_AFTERMATH_S = 60.0  # a run whose process stands still never ends by itself
Happening = Literal[
    "ambient",
    "air_temperature",
    "leak",
    "laser_dropout",
    "laser_drift",
    "daily_temperature",
    "pressure_weather",
    "power_cycle",
]
_MAKE: dict[str, Callable[[At], surroundings.BenchEvent]] = {
    "ambient": lambda at: surroundings.AmbientChange(at.time_s, at.value, at.over_s),
    "air_temperature": lambda at: surroundings.AirTemperatureChange(at.time_s, at.value, at.over_s),
    "leak": lambda at: surroundings.LeakChange(at.time_s, at.value),
    "laser_dropout": lambda at: surroundings.LaserDropout(at.time_s, at.over_s),
    "laser_drift": lambda at: surroundings.LaserDrift(at.time_s, at.value, at.over_s or math.inf),
    "daily_temperature": lambda at: surroundings.DailyTemperature(at.value),
    "pressure_weather": lambda at: surroundings.PressureWeather(at.value),
}


class At(Section):
    """One thing that happens: exactly one of `wrong`, `event` and `command`."""

    time_s: Annotated[float, Field(ge=0)]
    wrong: str | None = None
    for_s: Annotated[float, Field(gt=0)] | None = None
    every_s: Annotated[float, Field(ge=1e-3)] | None = None
    interlock: str | None = None  # that `wrong` opens or loses
    event: Happening | None = None
    over_s: Annotated[float, Field(ge=0)] = 0.0
    command: str | None = None
    value: float = 1.0
    text: str = ""

    @model_validator(mode="after")
    def _one_thing(self) -> At:
        if sum(thing is not None for thing in (self.wrong, self.event, self.command)) != 1:
            raise ValueError("give exactly one of wrong, event and command")
        if (
            self.wrong is not None
            and self.wrong not in _SWITCHES
            and self.wrong not in _INTERLOCK_SWITCHES
        ):
            known = ", ".join((*_SWITCHES, *_INTERLOCK_SWITCHES))
            raise ValueError(f"wrong = {self.wrong!r} is unknown; known are {known}")
        if (self.wrong in _INTERLOCK_SWITCHES) != (self.interlock is not None):
            raise ValueError(
                f"interlock goes with {' and '.join(_INTERLOCK_SWITCHES)}: the name of one"
            )
        if self.wrong in _FRACTIONS and not 0 <= self.value <= 1:
            raise ValueError(
                f"wrong = {self.wrong!r} with value = {self.value:g}: a fraction, 0 to 1"
            )
        if self.for_s is not None and self.wrong is None:
            raise ValueError("for_s goes with wrong; an event has over_s")
        if self.over_s and self.event is None:
            raise ValueError("over_s goes with event; what is wrong has for_s")
        if self.every_s is not None and (
            self.wrong is None or self.for_s is None or self.for_s >= self.every_s
        ):
            raise ValueError("every_s goes with wrong and with a for_s shorter than it")
        if self.command is not None and self.command not in get_args(Kind):
            raise ValueError(
                f"command = {self.command!r} is unknown; known are {', '.join(get_args(Kind))}"
            )
        return self


class Scenario(Section):
    """One scenario file; `expect` is for the tests."""

    title: str
    duration_s: Annotated[float, Field(gt=0, le=1e7)] = 60.0
    shapes: bool = False  # the camera measures; its shapes are made from the truth
    config: schema.Config = schema.Config()
    at: tuple[At, ...] = ()
    expect: dict[str, Any] | None = None

    @model_validator(mode="after")
    def _before_the_end(self) -> Scenario:
        names = [interlock.name for interlock in self.config.interlocks]
        for number, at in enumerate(self.at):
            if at.interlock is not None and at.interlock not in names:
                known = ", ".join(names) or "none: add [[config.devices.interlocks]]"
                raise ValueError(
                    f"at.{number}: interlock = {at.interlock!r} is not configured; known: {known}"
                )
            if at.time_s >= self.duration_s:
                raise ValueError(
                    f"at.{number}: time_s = {at.time_s:g} is not before duration_s = "
                    f"{self.duration_s:g}"
                )
            if at.every_s is not None and self.duration_s / at.every_s > _REPEATS_MAX:
                raise ValueError(
                    f"at.{number}: every_s = {at.every_s:g} repeats more than {_REPEATS_MAX} times"
                )
        return self


S = TypeVar("S", bound=Scenario)


def load_scenario(path: Path, model: type[S]) -> S:
    """Read a scenario. Raises InputError: one line that names the file, the field and what would be
    right.
    """
    return toml_file.load(path, model)


Due = Command | Callable[[virtual_bench.VirtualBench], None]
Ticks = Iterable[VirtualTick | None]  # None: the control process misses one


class ScenarioRun:
    """A scenario in virtual time, from the request to hold until its end; `rings` as in
    `VirtualRun`.
    """

    def __init__(self, scenario: Scenario, rings: Rings | None = None) -> None:
        self.config = config = scenario.config
        self.closing = Closing()
        steps = sorted(scenario.at, key=lambda at: at.time_s)
        mirror = plant.Plant(
            config.twin,
            config.pump,
            tuple(_MAKE[at.event](at) for at in steps if at.event in _MAKE),
        )
        self.bench = virtual_bench.VirtualBench(
            mirror,
            config.devices.watchdog_s if config.devices else 0.5,
            interlocks=virtual_interlocks.VirtualInterlocks(config.interlocks),
        )
        shape = TruthShape(self.bench, config, config.twin.seed) if scenario.shapes else None
        self.virtual = VirtualRun(config, self.bench, zernike_projection(), shape, rings=rings)
        self._ends_s = scenario.duration_s
        begin, end = (
            (0.0, Command("hold", "scenario")),
            (scenario.duration_s, Command("stop", "duration")),
        )
        agenda: list[tuple[float, Due]] = [begin, *_agenda(steps, scenario.duration_s), end]
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
            tick = run.tick(tuple(commands))
            if tick is not None:
                self.closing.heard(tick.outputs)
            yield tick
        self.closing.exit = run.exit

    def stop(self, who: str) -> None:
        """End the run now."""
        self._ends_s = self.virtual.now_s
        self._agenda = deque([(0.0, Command("stop", who))])


def _agenda(steps: list[At], end_s: float) -> Iterator[tuple[float, Due]]:
    """What is to be done when; a switch returns to its default when its time is over."""
    for at in steps:
        if at.command is not None:
            command = Command(at.command, "scenario", value=at.value, text=at.text)  # type: ignore[arg-type]  # checked
            yield at.time_s, command
        elif at.wrong is not None:
            times = 1 if at.every_s is None else max(1, math.ceil((end_s - at.time_s) / at.every_s))
            if at.interlock is not None:
                wrong, right = (
                    _switch_interlock(at.wrong, at.interlock, on) for on in (at.value != 0, False)
                )
            else:
                wrong, right = _switch(at.wrong, at.value), _switch(at.wrong, _SWITCHES[at.wrong])
            for begin_s in (at.time_s + k * (at.every_s or 0.0) for k in range(times)):
                yield begin_s, wrong
                if at.for_s is not None:
                    yield begin_s + at.for_s, right
        elif at.event == "power_cycle":
            yield at.time_s, virtual_bench.VirtualBench.power_cycle


def _switch(name: str, value: Any) -> Callable[[virtual_bench.VirtualBench], None]:
    kind = type(_SWITCHES[name])
    return lambda bench: setattr(bench.wrong, name, kind(value))


def _switch_interlock(
    switch: str, name: str, on: bool
) -> Callable[[virtual_bench.VirtualBench], None]:
    def act(bench: virtual_bench.VirtualBench) -> None:
        names = _INTERLOCK_SWITCHES[switch](bench.interlocks)
        if on:
            names.add(name)
        else:
            names.discard(name)

    return act


_ROUND_S = 20.0  # of the run, between two rounds of the recorder
_LIVE_ROUND_S = 1.0  # in real time, so that others can follow
_MESSAGES_A_TICK = 4  # at most
_CONSOLE_STOPS_S = 3.0


def play_scenario(word: str, logs_dir: Path, name: str | None, real_time: bool) -> int:
    """Play a scenario, given its name or its file, and record it as a run in `logs_dir`.

    Raises InputError for an unknown or invalid scenario, DeviceError if the folder cannot be
    written.
    """
    path = scenarios.find_scenario(word)
    played = scenario.load_scenario(path, scenario.Scenario)
    name = name or path.stem
    # a stranger's file decides neither where runs are stored nor which are deleted
    config = played.config.model_copy(update={"recording": schema.RecordingConfig()})
    with contextlib.ExitStack() as stack:
        addresses = {n: stack.enter_context(ring.ring(*size)) for n, size in _sizes(config).items()}
        writers = {
            n: stack.enter_context(contextlib.closing(ring.RingWriter(a)))
            for n, a in addresses.items()
        }
        run = scenario.ScenarioRun(played.model_copy(update={"config": config}), writers)
        run_dir = create_run_folder(logs_dir, name, run.virtual.clock.origin_utc, config)
        terminal.progress(f"playing {why.duration(played.duration_s)} of: {played.title}")
        ticks: scenario.Ticks = run.ticks()
        if real_time:
            real = clock.RunClock.start()
            ticks = _paced(run, ticks, real)
            rows, events, shapes = (addresses[n] for n in ("telemetry", "events", "shapes"))
            _show(
                process.ConsoleSpec(real, rows, events, shapes, run_dir, config, played.duration_s),
                stack,
            )
        else:
            ticks = terminal.counted(
                ticks, "playing", round(played.duration_s * config.loop.rate_hz)
            )
        with _stopped_by_signals(run):
            _record(run, ticks, run_dir, name, addresses, _LIVE_ROUND_S if real_time else _ROUND_S)
    report(run_dir, as_json=False, closing=run.closing)
    return run.virtual.exit


def _sizes(config: schema.Config) -> dict[str, tuple[int, int]]:
    """Slots of the rings for two rounds, and bytes of each."""
    ticks = round(2 * _ROUND_S * config.loop.rate_hz)
    return {
        "telemetry": (ticks, telemetry.ROW_BYTES),
        "inputs": (_MESSAGES_A_TICK * ticks, tick_codec.MESSAGE_BYTES),
        "snapshots": (4, tick_codec.SNAPSHOT_MESSAGE_BYTES),
        "events": (4096, 4096),
        "shapes": (256, 1 << 16),
    }


def _record(
    run: scenario.ScenarioRun,
    ticks: scenario.Ticks,
    run_dir: Path,
    name: str,
    addresses: dict[str, ring.RingAddress],
    round_s: float,
) -> None:
    """Run all ticks and record them, in this process: virtual time waits for the disk."""
    prepare_rerun()
    from membrane_ctrl.recorder import recorder, sink

    virtual, config = run.virtual, run.config
    recorded = ("inputs", "snapshots", "events", "shapes")
    with contextlib.ExitStack() as stack:
        readers = {
            n: stack.enter_context(contextlib.closing(ring.RingReader(addresses[n])))
            for n in recorded
        }
        recording = sink.Recording(run_dir, name, virtual.clock, config)
        files = recorder.Recorder(
            run_dir, virtual.clock, config, readers, recording, None, virtual.tell
        )
        virtual.tell(
            run_events.Started(
                "the twin in virtual time", "ordinary", "", program.program_identity()
            )
        )
        due_s = round_s
        for _ in ticks:
            if virtual.now_s >= due_s:
                due_s += round_s
                files.drain()
                files.write()
        virtual.end()
        files.finish()


def _paced(
    run: scenario.ScenarioRun, ticks: scenario.Ticks, real: clock.RunClock
) -> scenario.Ticks:
    """The ticks, each at its time; late ones follow at once."""
    for each in ticks:
        time.sleep(max(0.0, run.virtual.now_s - real.now()))
        yield each


def _show(spec: process.ConsoleSpec, stack: contextlib.ExitStack) -> None:
    """Start a console, which ends with the "end" event; the stack waits for it."""
    screen = child.Child("screen", "membrane_ctrl.console.process:console_main", (spec,), nice=5)
    stack.callback(screen.stop, 0.0)
    stack.callback(screen.join, _CONSOLE_STOPS_S)
    screen.start()


@contextlib.contextmanager
def _stopped_by_signals(run: scenario.ScenarioRun) -> Iterator[None]:
    """Within this context, Ctrl-C, SIGTERM and a closed terminal end the run at its next tick."""
    before = {
        number: signal.getsignal(number)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    }
    for number, handler in before.items():
        if handler != signal.SIG_IGN:
            signal.signal(number, lambda found, frame: run.stop(signal.Signals(found).name))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
