"""Days of a simulated hold with weather, a daily temperature and random faults."""

from __future__ import annotations

import contextlib
import resource
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from membrane_ctrl.config.schema import Config, LoopConfig, ResumeConfig, StatesConfig, TwinConfig
from membrane_ctrl.controller.command import Command
from membrane_ctrl.hold.virtual_run import TruthShape, VirtualRun, VirtualTick
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.sim.bench_events import (
    BenchEvent,
    DailyTemperature,
    LaserDropout,
    PressureWeather,
)
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.virtual_bench import VirtualBench

DAY_S = 86_400.0
RATE_HZ = 10.0
BAND_UM, MINUTE_BAND_UM = 2.0, 0.5
# kinds of fault: a laser glitch, a lost answer, a network that restarts, a board that restarts
_RESUMES = ("link_lost", "device_silent", "watchdog_tripped", "board_fault")
_FAULTS = (("no_light", 3.0), ("silent", 0.2), ("unreachable", 20.0), ("power", 0.0))
LASER_LOST_S, LASER_BACK_S = 120.0, 130.0

Take = Callable[[VirtualTick], None]


@dataclass
class Means:
    """Streaming means over a window; counts how many are in a band.
    Memory does not grow with time.
    """

    window: int
    band_um: float
    count: int = 0
    inside: int = 0
    worst_um: float = 0.0
    _sum_um: float = 0.0
    _n: int = 0

    def add(self, error_um: float) -> None:
        """Take one tick."""
        self._sum_um += error_um
        self._n += 1
        if self._n == self.window:
            mean_um = self._sum_um / self.window
            self.count += 1
            self.inside += abs(mean_um) <= self.band_um
            self.worst_um = max(self.worst_um, abs(mean_um))
            self.restart()

    def restart(self) -> None:
        """Begin a new window."""
        self._sum_um, self._n = 0.0, 0

    @property
    def fraction(self) -> float:
        """Share inside the band."""
        return self.inside / self.count if self.count else 0.0


@dataclass
class SoakTally:
    """The statistics of a soak."""

    second: Means = field(default_factory=lambda: Means(round(RATE_HZ), BAND_UM))
    minute: Means = field(default_factory=lambda: Means(round(60 * RATE_HZ), MINUTE_BAND_UM))
    events: Counter[str] = field(default_factory=Counter)
    event_bytes: int = 0
    held_s: float = 0.0
    square_um2: float = 0.0
    ticks: int = 0
    rss_after_hour_mb: float = 0.0
    rss_mb: float = 0.0
    days: float = 0.0
    wall_s: float = 0.0


def soak_config(seed: int) -> Config:
    """The defaults at 10 Hz; the faults of the soak may resume automatically."""
    return Config(
        loop=LoopConfig(rate_hz=RATE_HZ),
        twin=TwinConfig(seed=seed),
        states=StatesConfig(stay_after_trip=True),
        resume=ResumeConfig(faults=_RESUMES, most_per_day=24),
    )


def soak(
    days: float,
    seed: int,
    faults: bool = True,
    events: tuple[BenchEvent, ...] = (),
    take: Take | None = None,
) -> SoakTally:
    """Hold for `days` or until Ctrl-C; with `faults` something goes wrong six times a day. `take`
    gets every tick.
    """
    config = soak_config(seed)
    bench = VirtualBench(Plant(config.twin, config.pump, events))
    run = VirtualRun(config, bench, zernike_projection(), TruthShape(bench, config, seed))
    upsets = _upsets(seed) if faults else iter(())
    due_s, name, lasts_s = next(upsets, (np.inf, "", 0.0))
    until_s, tally, start_s = np.inf, SoakTally(), time.process_time()
    tick = run.run_tick((Command("hold", "soak"),))
    with contextlib.suppress(KeyboardInterrupt):
        while run.now_s < days * DAY_S and run.finished is None:
            if tick is not None:
                _count(tick, tally)
                if take is not None:
                    take(tick)
            if run.now_s >= due_s:
                _switch(bench, name, True)
                until_s = run.now_s + lasts_s
                due_s, following, after_s = next(upsets)
            if run.now_s >= until_s:
                _switch(bench, name, False)
                until_s, name, lasts_s = np.inf, following, after_s
            tick = run.run_tick()
    tally.days = run.now_s / DAY_S
    tally.rss_mb, tally.wall_s = rss_mb(), time.process_time() - start_s
    return tally


def _count(tick: VirtualTick, tally: SoakTally) -> None:
    row = tick.row
    if row.state == State.HOLD:
        error_um = row.truth_displacement_um - row.target_um
        tally.held_s += row.dt_s
        tally.ticks += 1
        tally.square_um2 += error_um**2
        tally.second.add(error_um)
        tally.minute.add(error_um)
    else:
        tally.second.restart()
        tally.minute.restart()
    for event in tick.events:
        tally.events[event.kind] += 1
        tally.event_bytes += len(str(event.to_dict()))
    if not tally.rss_after_hour_mb and row.mono_s > 3600:
        tally.rss_after_hour_mb = rss_mb()


def _upsets(seed: int) -> Iterator[tuple[float, str, float]]:
    """Which fault begins when, and for how long."""
    rng = np.random.default_rng(seed)
    at_s = 3600.0
    while True:
        at_s += float(rng.uniform(2.0, 6.0)) * 3600
        name, lasts_s = _FAULTS[int(rng.integers(len(_FAULTS)))]
        yield at_s, name, lasts_s


def _switch(bench: VirtualBench, name: str, on: bool) -> None:
    if name != "power":
        setattr(bench.wrong, name, on)
    elif on:
        bench.power_cycle()


def rss_mb() -> float:
    """Memory of this process."""
    pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1])
    return pages * resource.getpagesize() / 1e6


def dropout_excursions_um(seeds: range = range(12)) -> list[float]:
    """Excursion of the true centre in 10 s without a laser,
    one figure a seed of typical weather.
    """
    return [_dropout_excursion_um(seed) for seed in seeds]


def _dropout_excursion_um(seed: int) -> float:
    config = Config(loop=LoopConfig(rate_hz=RATE_HZ), twin=TwinConfig(seed=seed))
    plant = Plant(
        config.twin, config.pump, (LaserDropout(LASER_LOST_S, LASER_BACK_S - LASER_LOST_S),)
    )
    run = VirtualRun(config, VirtualBench(plant), zernike_projection())
    run.run_tick((Command("hold", "soak"),))
    worst_um = 0.0
    while run.now_s < LASER_BACK_S + 1.0:
        tick = run.run_tick()
        if tick is not None and run.now_s >= LASER_LOST_S:
            worst_um = max(worst_um, abs(tick.row.truth_displacement_um - tick.row.target_um))
    return worst_um


def everything(seed: int) -> tuple[BenchEvent, ...]:
    """A day's temperature and the pressure of passing weather, on top of the scenario's own."""
    return (DailyTemperature(1.0), PressureWeather(700.0, seed))
