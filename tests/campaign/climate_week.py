"""Weeks in which no sensor fails and the room's climate moves film and gauge: any fault is false.

The film becomes longer with humidity (7e-6 per % of relative humidity) and where it is warmer than
its ring (17e-6 per kelvin; the ring follows the air within hours), the gauge's zero drifts by 1
Pa/K, and the film creeps. Each day the hold is paused, driven by hand, tuned, moved to another
setpoint, lowered and inflated again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from campaign_run import relay_about

from firmware_iface.emulators.pump_board import BoardSample
from membrane_ctrl.config.schema import (
    Config,
    EstimatorConfig,
    LoopConfig,
    PumpConfig,
    ShapeConfig,
    TwinConfig,
)
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.duties import ProcessValue
from membrane_ctrl.hold.virtual_run import TruthShape, VirtualRun
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.events import Fault, Maintenance
from membrane_ctrl.sim.bench_events import BenchEvent, DailyTemperature
from membrane_ctrl.sim.film import NOMINAL_SAG_MM
from membrane_ctrl.sim.plant import STEP_S, Plant
from membrane_ctrl.sim.truth import Truth
from membrane_ctrl.sim.virtual_bench import VirtualBench

DAY_S = 86_400.0
RATE_HZ = 2.0
LOOP = LoopConfig(rate_hz=RATE_HZ, measurement_filter_s=0.5)
HUMIDITY_UM = 235.0  # of the centre at constant pressure, for 10 % of relative humidity
FILM_UM_PER_K = 57.0  # of the centre, for a film warmer than its ring
RING_FOLLOWS_S = 7200.0
GAUGE_PA_PER_K = 1.0


@dataclass(frozen=True)
class Climate:
    """Daily sines of temperature and relative humidity, with their phases."""

    temperature_k: float = 2.0
    humidity_percent: float = 10.0
    temperature_phase: float = 0.0
    humidity_phase: float = 0.0

    def air_k(self, time_s: float) -> float:
        """Deviation of the air's temperature, and of the gauge's and the film's."""
        return self.temperature_k * math.cos(2 * math.pi * time_s / DAY_S + self.temperature_phase)

    def film_um(self, time_s: float) -> float:
        """How much deeper the film is at constant pressure."""
        angle = 2 * math.pi * time_s / DAY_S
        humid = HUMIDITY_UM / 10.0 * self.humidity_percent * math.cos(angle + self.humidity_phase)
        # a ring that follows the air as a lag: what the film is warmer is the lag's high-pass
        lag = 2 * math.pi * RING_FOLLOWS_S / DAY_S
        share, lead = lag / math.hypot(1.0, lag), math.atan2(1.0, lag)
        warmer_k = self.temperature_k * share * math.cos(angle + self.temperature_phase + lead)
        return humid + FILM_UM_PER_K * warmer_k


class ClimatePlant(Plant):
    """The twin in a room whose climate moves the film and the gauge's zero."""

    def __init__(
        self, twin: TwinConfig, pump: PumpConfig, events: Sequence[BenchEvent], climate: Climate
    ) -> None:
        self._climate = climate
        super().__init__(twin, pump, events)

    def _load_block(self) -> None:
        super()._load_block()
        begins_s = self._steps * STEP_S
        for coefficients in (self._sag, self._volume):
            for index, value in enumerate(coefficients):
                film_um = self._climate.film_um(begins_s + index * STEP_S)
                coefficients[index] = value * (1.0 + 1e-3 * film_um / NOMINAL_SAG_MM)

    def sample_of(self, truth: Truth) -> BoardSample:
        """The sensors' readings, the gauge with its drifting zero."""
        sample = super().sample_of(truth)
        zero_pa = GAUGE_PA_PER_K * self._climate.air_k(truth.time_s)
        return replace(sample, gauge_pressure_pa=sample.gauge_pressure_pa + zero_pa)


@dataclass(frozen=True)
class Week:
    """What happened.

    Attributes
    ----------
    days : float
    faults : tuple of str
    notices : tuple of str
        Names of the maintenance notices.
    held_share : float
        Share of the ticks in a moving state.
    """

    days: float
    faults: tuple[str, ...]
    notices: tuple[str, ...]
    held_share: float


def run_week(process_value: ProcessValue, climate: Climate, seed: int, days: float) -> Week:
    """Hold the mirror for days in which no sensor fails."""
    by_optics = process_value is ProcessValue.OPTICS
    twin = TwinConfig(seed=seed, scenario="quiet", start_error_um=-5.0, laser=not by_optics)
    config = Config(
        loop=LOOP,
        shape=ShapeConfig(mode="track", track_rate_hz=RATE_HZ),
        estimator=EstimatorConfig(process_value=process_value.value),
        twin=twin,
    )
    air = DailyTemperature(
        climate.temperature_k, warmest_s=-climate.temperature_phase * DAY_S / (2 * math.pi)
    )
    bench = VirtualBench(ClimatePlant(twin, config.pump, (air,), climate))
    figures = TruthShape(bench, config, seed, 0.036)
    run = VirtualRun(config, bench, zernike_projection(), figures)
    asked = _plan(seed, days * DAY_S)
    faults: list[str] = []
    notices: list[str] = []
    held = ticks = 0
    while run.finished is None and run.now_s < days * DAY_S:
        due = tuple(command for at_s, command in asked if at_s <= run.now_s)
        asked = asked[len(due) :]
        tick = run.run_tick(due)
        assert tick is not None
        ticks += 1
        held += int(math.isfinite(tick.row.setpoint_um))
        faults += [
            f"{e.name} at {run.now_s / 3600:.2f} h: {e.seen}"
            for e in tick.events
            if isinstance(e, Fault)
        ]
        notices += [event.name for event in tick.events if isinstance(event, Maintenance)]
    return Week(run.now_s / DAY_S, tuple(faults), tuple(notices), held / ticks)


def _plan(seed: int, end_s: float) -> list[tuple[float, Command]]:
    """Commands of each day at times drawn from the seed, in order."""
    chance = np.random.default_rng(seed)
    plan = [(0.0, Command("hold", "campaign"))]
    for day in range(math.ceil(end_s / DAY_S)):
        hours = np.sort(chance.choice(np.arange(1, 23), 6, replace=False)).tolist()
        at_s = [DAY_S * day + 3600.0 * hour for hour in hours]
        plan += [
            (at_s[0], Command("pause", "campaign")),
            (at_s[0] + 240.0, Command("resume", "campaign")),
            (at_s[1], Command("manual", "campaign", value=1.24)),
            (at_s[2], Command("tune", "campaign", experiment=relay_about(1.24))),
            (at_s[3], Command("setpoint", "campaign", value=float(chance.uniform(-100.0, 100.0)))),
            (at_s[4], Command("lower", "campaign")),
            (at_s[4] + 120.0, Command("hold", "campaign")),
            (
                at_s[5],
                Command(
                    "gains", "campaign", value=300.0, loop=LOOP.model_copy(update={"kp_per_s": 0.5})
                ),
            ),
        ]
    return [(at_s, command) for at_s, command in plan if at_s < end_s]
