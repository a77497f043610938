"""A week of a hold at 10 Hz in virtual time, recorded, with a restart in its middle.

The hold has the defaults of a new one: it tests its actuators, identifies delay and lag, and holds
the centre by `auto`. Room and mirror change as in a laboratory: a day's temperature, highs and
lows, doors, a laser mount that drifts, a leak that grows and shrinks. Every two to six hours
something fails for a while: laser, camera, barometer, thermometer, an answer of the board, its
network, its power. In the middle the program is stopped for a minute and started again on the same
mirror.

The record is written by the recorder's own tables, ten seconds at a time; the pictures of the Rerun
recording are not written.

`python -m tests.studies.held_week FILE FOLDER` appends a line of JSON an hour to FILE, and records
below FOLDER. It stores its whole state beside FILE each hour; a second call continues from it.
"""

from __future__ import annotations

import copyreg
import json
import math
import pickle
import shutil
import struct
import sys
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numba import cloudpickle

from membrane_ctrl.config.schema import (
    Config,
    LoopConfig,
    ResumeConfig,
    StatesConfig,
    TwinConfig,
    leave_to_start,
)
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.tick_assembler import TickAssembler
from membrane_ctrl.controller.tick_codec import pack_tick
from membrane_ctrl.hold.virtual_run import VirtualRun, VirtualTick
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.events import EventLine, Fault
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.run_files.run_tables import RunTables
from membrane_ctrl.sim.bench_events import (
    BenchEvent,
    DailyTemperature,
    LaserDrift,
    LeakChange,
    PressureWeather,
    Surroundings,
)
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.virtual_bench import VirtualBench
from tests.studies.soak import rss_mb
from tests.worlds.recorded_hold import RealisticShapes

DAY_S, HOUR_S = 86_400.0, 3600.0
RATE_HZ = 10.0
DAYS = 7.0
STOPPED_S = 60.0  # between the two holds
WRITE_EVERY = 100  # ticks
SYNC_EVERY = 600  # ticks: once a minute, as a disk costs more than the rows
LEAK_EVERY = 600  # ticks: a comparison of the leak a minute
DOORS_A_DAY, DOOR_PA, DOOR_OPEN_S = 30.0, 20.0, 3.0
# laser, an answer, the network, the board's power, camera, barometer, thermometer
_FAULTS = (
    ("no_light", 3.0),
    ("silent", 0.2),
    ("unreachable", 20.0),
    ("power", 0.0),
    ("camera_lost", 300.0),
    ("barometer_lost", 600.0),
    ("thermometer_lost", 600.0),
)
_RESUMES = ("link_lost", "device_silent", "watchdog_tripped", "board_fault")


@dataclass(frozen=True, slots=True)
class Doors:
    """Doors that open at random times: the pressure steps, and returns when they close."""

    opened_s: FloatArray

    def apply(self, on: Surroundings) -> None:
        """Add the pressure while a door is open."""
        opened_s = np.append(-math.inf, self.opened_s)
        last = np.searchsorted(opened_s, on.time_s, side="right") - 1
        since_s = on.time_s - opened_s[last]
        on.ambient_pa[:] += DOOR_PA * (since_s < DOOR_OPEN_S)


@dataclass
class HeldHour:
    """One hour of the week, of one hold.

    Attributes
    ----------
    hour : int
        Of the week, from 0.
    hold : int
        1 before the restart, 2 after it.
    held_s, true_mean_um, true_std_um, furthest_um
        Of the true centre against the target, while the state is `hold`.
    away_um
        Furthest from the target in any state.
    leak_error_um_per_s, leak_scatter_um_per_s
        Mean and standard deviation of the estimated leak minus the true one, a value a minute.
    """

    hour: int
    hold: int
    ticks: int = 0
    held_s: float = 0.0
    true_mean_um: float = math.nan
    true_std_um: float = math.nan
    furthest_um: float = 0.0
    away_um: float = 0.0
    leak_error_um_per_s: float = math.nan
    leak_scatter_um_per_s: float = math.nan
    rss_mb: float = 0.0
    recorded_mb: float = 0.0
    cpu_s: float = 0.0
    upsets: dict[str, int] = field(default_factory=dict)
    events: dict[str, int] = field(default_factory=dict)
    faults: list[str] = field(default_factory=list)


class _Record:
    """The tables of a hold, written as the recorder writes them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        self._tables = RunTables(folder)
        self._assembler = TickAssembler()
        self._messages: list[bytes] = []
        self._events: list[EventLine] = []
        self._number = 0

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the open tables, whose windows a successor continues."""
        self._write_rows()
        self._tables.sync_tables()
        state = dict(self.__dict__)
        state["_tables"] = self._tables.open_windows
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Continue the tables of the folder."""
        self.__dict__.update(state)
        self._tables = RunTables(self.folder, resumed=state["_tables"])

    def add_tick(self, tick: VirtualTick) -> None:
        """Take a tick; what has come is written every ten seconds."""
        self._number += 1
        self._messages += pack_tick(self._number, tick.inputs, tick.outputs, tick.row.pack())
        if tick.inputs.estimate is not None:
            self._tables.add_shape(tick.inputs.estimate)
        self._events += [
            json.loads(json.dumps({"mono_s": tick.row.mono_s, **event.to_dict()}, default=str))
            for event in tick.events
        ]
        if self._number % WRITE_EVERY == 0:
            self._write_rows()
        if self._number % SYNC_EVERY == 0:
            self._tables.sync_tables()
            self._tables.seal_full_journal()

    def _write_rows(self) -> None:
        self._tables.add_ticks(self._assembler.add_messages(self._messages))
        if self._events:
            self._tables.add_events(self._events)
        self._messages, self._events = [], []

    def close(self) -> None:
        """End all tables."""
        self._write_rows()
        self._tables.close()

    def measure_mb(self) -> float:
        """Size of all files."""
        return sum(file.stat().st_size for file in self.folder.rglob("*") if file.is_file()) / 1e6


def make_config(seed: int) -> Config:
    """A new hold's defaults at 10 Hz; faults of the link may resume without a person."""
    return leave_to_start(
        Config(
            loop=LoopConfig(rate_hz=RATE_HZ),
            twin=TwinConfig(seed=seed),
            states=StatesConfig(stay_after_trip=True),
            resume=ResumeConfig(faults=_RESUMES, most_per_day=24),
        )
    )


def make_surroundings(seed: int, days: float) -> tuple[BenchEvent, ...]:
    """Weather, doors, a mount that drifts by 20 µm each four hours, a leak that changes by half."""
    rng = np.random.default_rng([31, seed])
    doors_s = np.sort(rng.uniform(0.0, days * DAY_S, rng.poisson(DOORS_A_DAY * days)))
    hours = np.arange(2.0, 24.0 * days, 4.0)
    drifts = (
        LaserDrift(HOUR_S * hour, float(rng.choice([-2.0, 2.0])), 600.0) for hour in hours.tolist()
    )
    leaks = []
    for number, hour in enumerate(np.arange(3.0, 24.0 * days, 8.0).tolist()):
        factor = 1.5
        if number % 2:
            factor = 1 / 1.5
        leaks.append(LeakChange(HOUR_S * (hour + rng.uniform(0.0, 2.0)), factor))
    return (DailyTemperature(1.0), PressureWeather(700.0, seed), Doors(doors_s), *drifts, *leaks)


def draw_upsets(seed: int, days: float) -> list[tuple[float, str, float]]:
    """Which sensor or device fails when, and for how long, in the order of time."""
    rng = np.random.default_rng([32, seed])
    upsets: list[tuple[float, str, float]] = []
    at_s = HOUR_S
    while not upsets or at_s < days * DAY_S:
        at_s += float(rng.uniform(2.0, 6.0)) * HOUR_S
        name, lasts_s = _FAULTS[int(rng.integers(len(_FAULTS)))]
        upsets.append((at_s, name, lasts_s))
    return upsets


class _Judge:
    """Sums of one hour."""

    def __init__(self, hour: int, hold: int) -> None:
        self.found = HeldHour(hour, hold)
        self._sum_um = self._square_um2 = 0.0
        self._held = 0
        self._leak_errors: list[float] = []

    def add_tick(self, tick: VirtualTick, bench: VirtualBench) -> None:
        row, found = tick.row, self.found
        found.ticks += 1
        error_um = row.truth_displacement_um - row.target_um
        if math.isfinite(error_um):
            found.away_um = max(found.away_um, abs(error_um))
        if row.state == State.HOLD:
            self._held += 1
            self._sum_um += error_um
            self._square_um2 += error_um**2
            found.furthest_um = max(found.furthest_um, abs(error_um))
            if found.ticks % LEAK_EVERY == 0:
                self._leak_errors.append(row.leak_um_per_s - bench.plant.truth().leak_um_per_s)
        for event in tick.events:
            found.events[event.kind] = found.events.get(event.kind, 0) + 1
            if isinstance(event, Fault):
                found.faults.append(f"{row.mono_s:.0f} s {event.name}: {event.seen}")

    def finish(self, recorded_mb: float, cpu_s: float) -> HeldHour:
        found = self.found
        found.held_s = self._held / RATE_HZ
        if self._held:
            found.true_mean_um = self._sum_um / self._held
            mean_square_um2 = self._square_um2 / self._held
            found.true_std_um = math.sqrt(max(0.0, mean_square_um2 - found.true_mean_um**2))
        if self._leak_errors:
            found.leak_error_um_per_s = float(np.mean(self._leak_errors))
            found.leak_scatter_um_per_s = float(np.std(self._leak_errors))
        found.rss_mb, found.recorded_mb, found.cpu_s = rss_mb(), recorded_mb, cpu_s
        return found


@dataclass
class _Hold:
    """One of the two holds while it runs."""

    number: int
    run: VirtualRun
    record: _Record
    from_s: float
    until_s: float
    asked_to_stop: bool = False


class HeldWeek:
    """The bench of the week, and the holds on it, one after the other.

    Parameters
    ----------
    seed : int
        Of everything.
    days : float
        Length of the week.
    folder : Path
        Of the records.
    """

    def __init__(self, seed: int, days: float, folder: Path) -> None:
        self._config = make_config(seed)
        self._days = days
        self._folder = folder
        plant = Plant(self._config.twin, self._config.pump, make_surroundings(seed, days))
        self._bench = VirtualBench(plant)
        self._upsets = draw_upsets(seed, days)
        self._ends_s = math.inf
        self._now_s = 0.0  # of the week
        self._spent_s = 0.0  # processor time of earlier calls
        self._begun_s = time.process_time()
        self.hold: _Hold | None = self._begin_hold(1, 0.0, days / 2 * DAY_S)
        self._judge = _Judge(0, 1)

    def __getstate__(self) -> dict[str, Any]:
        """The state, with the processor time until now."""
        return {**self.__dict__, "_spent_s": self._count_cpu_s()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Continue in another process."""
        self.__dict__.update(state)
        self._begun_s = time.process_time()

    def run_hour(self) -> HeldHour | None:
        """The next hour, or what is left of a hold; None at the end of the week."""
        hold = self.hold
        if hold is None:
            return None
        commands: tuple[Command, ...] = ()
        if self._judge.found.ticks == 0 and hold.run.now_s == 0.0:
            commands = (Command("hold", "week"),)
        hour = int(self._now_s // HOUR_S)
        while hold.run.finished is None and int(self._now_s // HOUR_S) == hour:
            self.run_tick(commands)
            commands = ()
        if hold.run.finished is not None:
            hold.record.close()
        found = self._judge.finish(hold.record.measure_mb(), self._count_cpu_s())
        if hold.run.finished is not None:
            self.hold = self._begin_next(hold.number)
        number = hold.number
        if self.hold is not None:
            number = self.hold.number
        self._judge = _Judge(int(self._now_s // HOUR_S), number)
        return found

    def run_tick(self, commands: tuple[Command, ...]) -> VirtualTick | None:
        """Run a tick of the present hold; None if the program misses it."""
        hold = self.hold
        assert hold is not None
        self._now_s = hold.from_s + hold.run.now_s
        if self._now_s >= hold.until_s and not hold.asked_to_stop:
            commands, hold.asked_to_stop = (*commands, Command("stop", "week")), True
        self._switch_faults()
        tick = hold.run.run_tick(commands)
        if tick is not None:
            hold.record.add_tick(tick)
            self._judge.add_tick(tick, self._bench)
        return tick

    def _begin_next(self, ended: int) -> _Hold | None:
        if ended > 1:
            return None
        self._bench.advance(STOPPED_S)
        return self._begin_hold(2, self._now_s + STOPPED_S, self._days * DAY_S)

    def _begin_hold(self, number: int, from_s: float, until_s: float) -> _Hold:
        shapes = RealisticShapes(self._bench, self._config)
        run = VirtualRun(self._config, self._bench, zernike_projection(), shapes)
        return _Hold(number, run, _Record(self._folder / f"hold-{number}"), from_s, until_s)

    def _count_cpu_s(self) -> float:
        return self._spent_s + time.process_time() - self._begun_s

    def _switch_faults(self) -> None:
        """Begin or end the failure that is due."""
        due_s, name, lasts_s = self._upsets[0]
        if self._now_s >= due_s and math.isinf(self._ends_s):
            upsets = self._judge.found.upsets
            upsets[name] = upsets.get(name, 0) + 1
            self._switch(name, True)
            self._ends_s = self._now_s + lasts_s
        if self._now_s >= self._ends_s:
            self._switch(name, False)
            self._ends_s = math.inf
            self._upsets = self._upsets[1:]

    def _switch(self, name: str, on: bool) -> None:
        if name != "power":
            setattr(self._bench.wrong, name, on)
        elif on:
            self._bench.power_cycle()


def save_week(week: HeldWeek, path: Path) -> None:
    """Store the whole state; a file that is half written replaces nothing."""
    new = path.with_suffix(".new")
    new.write_bytes(cloudpickle.dumps(week))  # type: ignore[no-untyped-call]
    new.replace(path)


def load_week(path: Path) -> HeldWeek:
    """The state of `save_week`, to continue."""
    week: HeldWeek = pickle.loads(path.read_bytes())
    return week


def _rebuild_struct(form: str) -> struct.Struct:
    return struct.Struct(form)


def _reduce_struct(form: struct.Struct) -> tuple[Any, tuple[str]]:
    return _rebuild_struct, (form.format,)


copyreg.pickle(struct.Struct, _reduce_struct)


def main() -> None:
    """Run the week, or continue it, a line of JSON an hour."""
    file, folder = Path(sys.argv[1]), Path(sys.argv[2])
    days = DAYS
    if len(sys.argv) > 3:
        days = float(sys.argv[3])
    state = file.with_suffix(".state")
    if state.exists():
        week = load_week(state)
    else:
        week = HeldWeek(1, days, folder)
    while (hour := week.run_hour()) is not None:
        save_week(week, state)
        with file.open("a", encoding="utf-8") as lines:
            lines.write(json.dumps(asdict(hour)) + "\n")


if __name__ == "__main__":
    main()
