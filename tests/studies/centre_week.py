"""Days of a mirror held by the estimate of its centre, in virtual time.

Sensors are lost and return, the laser is knocked and drifts, its mount and the camera mount move
with the daily temperature, the leak changes, and the camera tracks, measures in cycles, or is off.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from membrane_ctrl.config.schema import Config, EstimatorConfig, LoopConfig, TwinConfig
from membrane_ctrl.controller.command import Command
from membrane_ctrl.hold.virtual_run import TruthShape, VirtualRun, VirtualTick
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.events import Event, Fault, Maintenance, Plausibility, SensorsUsed
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.sim.bench_events import DailyTemperature, LaserDrift, LeakChange, PressureWeather
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.virtual_bench import VirtualBench

DAY_S, RATE_HZ, TRACK_S, CYCLE_S = 86_400.0, 10.0, 0.2, 2.0
FIRST_S = 600.0  # before the first change
BUMP_UM = 0.3
BEFORE_S, AFTER_S, TOLD_S = (
    5.0,
    10.0,
    120.0,
)  # of a change: means before it, its bump, what is told of it
CAMERA_MOUNT_UM_PER_K, STATED_MOUNT_UM_PER_K, CAMERA_MOUNT_S = (
    0.44,
    0.34,
    1800.0,
)  # what is known of the stand is 30 % wrong
SENSORS = ("no_light", "laser_stuck", "camera_lost", "barometer_lost", "thermometer_lost")
KINDS = (*SENSORS, "knock", "cycle", "shape_off")
TOLD = {
    "no_light": "laser",
    "camera_lost": "optics",
    "shape_off": "optics",
    "barometer_lost": "barometer",
    "thermometer_lost": "thermometer",
}
TOLD_AFTER_S = 10.0  # a loss that lasts longer is told


@dataclass
class Change:
    """Something that happened, and what came of it."""

    kind: str
    at_s: float
    begins: bool
    lasts_s: float
    bump_um: float = np.nan
    held_by: list[str] = field(default_factory=list)
    faulty_sensors: list[str] = field(default_factory=list)

    @property
    def told_once(self) -> bool:
        """A loss and its end are told by an event each, a knock by the jump and its judgement, all
        else by none.
        """
        jumps = [words for words in self.held_by if ";" in words]
        if self.kind == "knock":
            return len(jumps) == 1 and self.faulty_sensors == ["laser", "none"]
        plain = (
            [TOLD[self.kind] in words for words in self.held_by]
            if self.kind in TOLD
            else self.held_by
        )
        if self.kind in TOLD and self.lasts_s > TOLD_AFTER_S:
            return plain == [not self.begins]
        return not jumps and (not plain or self.kind in TOLD)


@dataclass
class Day:
    """What a run was like."""

    changes: list[Change] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    notices: list[str] = field(default_factory=list)
    hours_um: list[tuple[float, float]] = field(
        default_factory=list
    )  # mean and standard deviation of the true centre
    missed: int = 0
    held_s: float = 0.0
    cpu_s: float = 0.0

    @property
    def std_um(self) -> float:
        """Of the true centre, the whole day."""
        means, stds = np.array(self.hours_um).T
        return float(np.sqrt(np.mean(stds**2) + np.var(means)))

    @property
    def hour_um(self) -> float:
        """Of the true centre in an hour, the median."""
        return float(np.median(np.array(self.hours_um)[:, 1]))


def config_of(seed: int) -> Config:
    """All sensors, at 10 Hz."""
    return Config(
        loop=LoopConfig(rate_hz=RATE_HZ),
        estimator=EstimatorConfig(
            process_value="estimate", camera_mount_um_per_k=STATED_MOUNT_UM_PER_K
        ),
        twin=TwinConfig(seed=seed, start_error_um=-1.0),
    )


def _upsets(seed: int) -> Iterator[tuple[float, str, float]]:
    """Which change begins when, and how long it lasts; the first ones are all kinds in a random
    order.
    """
    rng = np.random.default_rng([21, seed])
    at_s, first = FIRST_S, list(rng.permutation(KINDS))
    while True:
        kind = str(first.pop() if first else rng.choice(KINDS))
        lasts_s = float(np.exp(rng.uniform(np.log(2.0), np.log(600.0))))
        if kind in ("cycle", "shape_off"):
            lasts_s = max(lasts_s, 60.0)
        if kind == "laser_stuck":
            lasts_s = max(lasts_s, 10.0)
        yield at_s, kind, lasts_s
        at_s += lasts_s + float(rng.uniform(300.0, 1500.0))


def _slow(
    seed: int, days: float
) -> tuple[DailyTemperature | PressureWeather | LaserDrift | LeakChange, ...]:
    """What happens beside: a day's temperature, highs and lows, a drifting mount, a leak that grows
    and shrinks.
    """
    rng = np.random.default_rng([22, seed])
    hours = np.arange(1.0, 24.0 * days)
    drifts = (
        LaserDrift(3600 * h + rng.uniform(0, 1800), float(rng.choice([-2.0, 2.0])), 600.0)
        for h in hours[::2]
    )
    leaks = (
        LeakChange(3600 * h + rng.uniform(1800, 3000), 1.5 if n % 2 == 0 else 1 / 1.5)
        for n, h in enumerate(hours[1::2])
    )
    return (DailyTemperature(1.0), PressureWeather(700.0, seed), *drifts, *leaks)


class _Week:
    """A run and its judge."""

    def __init__(self, days: float, seed: int) -> None:
        config = config_of(seed)
        self.bench = VirtualBench(Plant(config.twin, config.pump, _slow(seed, days)))
        self.run = VirtualRun(
            config, self.bench, zernike_projection(), TruthShape(self.bench, config, seed, 0.036)
        )
        self.run._shape_period_s = TRACK_S
        self.day, self._rng = Day(), np.random.default_rng([23, seed])
        self._camera_mount_k = [0.0, 0.0]
        self._first_k = self.bench.truth.air_temperature_c
        self._recent: list[float] = []  # true centre
        self._hour: list[float] = []
        self._open: list[tuple[Change, float, list[float]]] = []
        self._pending: list[Command] = [Command("hold", "week")]

    def tick(self) -> VirtualTick | None:
        """A tick, in which the stand follows the air."""
        given_k = self.bench.truth.air_temperature_c - self._first_k
        for place, now_k in enumerate(self._camera_mount_k):
            given_k = self._camera_mount_k[place] = now_k + (given_k - now_k) / (
                RATE_HZ * CAMERA_MOUNT_S / 2
            )
        self.bench.wrong.camera_offset_um = CAMERA_MOUNT_UM_PER_K * given_k
        commands, self._pending = tuple(self._pending), []
        tick = self.run.run_tick(commands)
        if tick is not None:
            self._judge(tick)
        return tick

    def switch(self, kind: str, begins: bool, lasts_s: float) -> None:
        """Begin or end a change."""
        wrong = self.bench.wrong
        if kind in SENSORS:
            setattr(wrong, kind, begins)
        elif kind == "knock":
            if not begins:
                return
            by_um = float(np.exp(self._rng.uniform(np.log(14.0), np.log(200.0))))
            wrong.laser_offset_um += -by_um if wrong.laser_offset_um > 0 else by_um
        elif kind == "cycle":
            self.run._shape_period_s = CYCLE_S if begins else TRACK_S
        else:
            self._pending.append(Command("shape_off" if begins else "shape_on", "week"))
        change = Change(kind, self.run.now_s, begins, lasts_s)
        self.day.changes.append(change)
        self._open.append((change, float(np.mean(self._recent)), []))

    def _judge(self, tick: VirtualTick) -> None:
        row, day = tick.row, self.day
        um = row.truth_displacement_um
        self._recent = [*self._recent[-round(BEFORE_S * RATE_HZ) + 1 :], um]
        if row.state == State.HOLD:
            day.held_s += row.dt_s
            self._hour.append(um)
        if len(self._hour) == round(3600 * RATE_HZ):
            day.hours_um.append((float(np.mean(self._hour)), float(np.std(self._hour))))
            self._hour = []
        day.missed = int(row.missed_ticks)
        for change, before_um, after_um in self._open:
            if len(after_um) < round(AFTER_S * RATE_HZ):
                after_um.append(um - before_um)
                halves = np.array(after_um[: len(after_um) // 5 * 5]).reshape(-1, 5).mean(axis=1)
                change.bump_um = float(np.abs(halves).max()) if halves.size else np.nan
        self._open = [each for each in self._open if self.run.now_s < each[0].at_s + TOLD_S]
        for event in tick.events:
            self._note(event)

    def _note(self, event: Event) -> None:
        now_s = self.run.now_s
        if isinstance(event, Fault):
            self.day.faults.append(f"{now_s:.0f} s {event.name}: {event.seen}")
        if isinstance(event, Maintenance):
            self.day.notices.append(f"{now_s:.0f} s {event.name}")
        last = self._open[-1][0] if self._open else None
        if isinstance(event, SensorsUsed) and last:
            last.held_by.append(
                "; ".join(filter(None, (", ".join(event.sensors), ", ".join(event.jumped))))
            )
        if isinstance(event, Plausibility) and last:
            last.faulty_sensors.append(event.faulty)
        if isinstance(event, SensorsUsed | Plausibility) and not last:
            self.day.notices.append(f"{now_s:.0f} s {event}")


def days(count: float, seed: int) -> Day:
    """Hold for so many days."""
    week, begun_s = _Week(count, seed), time.process_time()
    upsets = _upsets(seed)
    at_s, kind, lasts_s = next(upsets)
    until_s = np.inf
    while week.run.now_s < count * DAY_S and week.tick() is not None:
        if week.run.now_s >= at_s:
            week.switch(kind, True, lasts_s)
            at_s, until_s = np.inf, week.run.now_s + lasts_s
        if week.run.now_s >= until_s:
            week.switch(kind, False, lasts_s)
            until_s = np.inf
            at_s, kind, lasts_s = next(upsets)
    week.day.cpu_s = time.process_time() - begun_s
    return week.day
