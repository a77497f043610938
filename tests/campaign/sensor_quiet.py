"""Nights in which no sensor fails and much else happens: any alarm is false."""

from __future__ import annotations

from dataclasses import dataclass
from unittest.mock import patch

import numpy as np
from sensor_faults import Lying, LyingPlant

from membrane_ctrl.config.schema import Config, LoopConfig, PumpConfig, TwinConfig
from membrane_ctrl.controller.command import Command
from membrane_ctrl.hold.virtual_run import TruthShape, VirtualRun
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.events import Fault
from membrane_ctrl.sim import film as film_module
from membrane_ctrl.sim import sensors
from membrane_ctrl.sim.bench_events import (
    AmbientChange,
    BenchEvent,
    DailyTemperature,
    LaserDrift,
    LaserDropout,
    LeakChange,
    PressureWeather,
)
from membrane_ctrl.sim.film import Film
from membrane_ctrl.sim.virtual_bench import VirtualBench

_DROPOUT = "displacement_missing"  # five seconds without light are a true alarm


@dataclass(frozen=True)
class QuietHours:
    """A day in which no sensor fails, and much happens.

    Attributes
    ----------
    hours : float
    alarms : tuple of str
        Reported faults, with what was seen.
    """

    hours: float
    alarms: tuple[str, ...]


def quiet_hours(seed: int, other_world: bool, hours: float, rate_hz: float = 5.0) -> QuietHours:
    """Weather, doors, a leak that doubles, setpoints, inflations, a laser that drifts, with and
    without a camera.

    The other bench has another film (thinner, and stretched before it was inflated), a leak twice
    as large, a pump that gives a quarter more than the configuration says, and sensors with twice
    the noise.
    """
    if not other_world:
        return _quiet_hours(seed, hours, rate_hz, PumpConfig(), TwinConfig(seed=seed), 0.0)
    twin = TwinConfig(seed=seed, leak_time_constant_s=5000.0, barometer_noise_pa=0.1)
    thin = Film(thickness_um=42.0, creep_per_decade=0.02)
    with (
        patch.object(film_module, "MIRROR_FILM", thin),
        patch.object(sensors, "GAUGE_NOISE_PA", 1.0),
    ):
        return _quiet_hours(
            seed, hours, rate_hz, PumpConfig(flow_full_um_per_s=5.3 * 1.25), twin, 0.3
        )


def _quiet_hours(
    seed: int, hours: float, rate_hz: float, pump: PumpConfig, twin: TwinConfig, linear: float
) -> QuietHours:
    chance = np.random.default_rng(seed)
    end_s = 3600.0 * hours
    twin = twin.model_copy(update={"scenario": "gusty" if seed % 2 else "typical"})
    camera = seed % 4 < 2
    drift_s = float(chance.uniform(0.2, 0.5)) * end_s
    events: list[BenchEvent] = [
        DailyTemperature(1.0),
        PressureWeather(700.0, seed),
        LeakChange(float(chance.uniform(0.3, 0.7)) * end_s, 2.0),
        LaserDrift(drift_s, 2.0, 2400.0 if camera else 1200.0),
        *(
            AmbientChange(at_s, float(chance.choice([-20.0, 20.0])))
            for at_s in _moments(chance, end_s, 3600.0)
        ),
        *(LaserDropout(at_s, 5.0) for at_s in _moments(chance, end_s, 10_000.0)),
    ]
    lying = Lying(())
    bench = VirtualBench(LyingPlant(twin, pump, events, lying, linear))
    config = Config(loop=LoopConfig(rate_hz=rate_hz), twin=twin)
    shape = TruthShape(bench, config, seed) if camera else None
    run = VirtualRun(config, bench, zernike_projection(), shape)
    asked = [(0.0, Command("hold", "campaign"))]
    asked += [
        (at_s, Command("setpoint", "campaign", value=float(chance.uniform(-300.0, 300.0))))
        for at_s in _moments(chance, end_s, 7200.0)
    ]
    for at_s in _moments(chance, end_s, 20_000.0):
        asked += [(at_s, Command("lower", "campaign")), (at_s + 400.0, Command("hold", "campaign"))]
    asked.sort(key=lambda pair: pair[0])
    alarms: list[str] = []
    while run.finished is None and run.now_s < end_s:
        due = tuple(command for at_s, command in asked if at_s <= run.now_s)
        asked = asked[len(due) :]
        tick = run.run_tick(due)
        faults = (
            [event for event in tick.events if isinstance(event, Fault)] if tick is not None else []
        )
        alarms += [f"{event.name}: {event.seen}" for event in faults if event.name != _DROPOUT]
    return QuietHours(run.now_s / 3600.0, tuple(alarms))


def _moments(chance: np.random.Generator, end_s: float, every_s: float) -> list[float]:
    """At random, so often on average; not in the first ten minutes."""
    return sorted(chance.uniform(600.0, end_s, round(end_s / every_s)).tolist())
