"""Eleven benches of the second world: other pumps, lasers and weather than the twin's.

The pumps share no code with `membrane_ctrl.sim`; what a lab knows of each is in `Bench.config`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from firmware_iface.emulators.pump_board import BoardSample
from membrane_ctrl.config.schema import Config, PumpConfig
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from tests.worlds.foreign_plant import (
    STEP_S,
    ForeignPlant,
    ForeignPump,
    ForeignTruth,
    foreign_config,
)

_SAG_UM = 37_100.0
_TERMS = 36


@dataclass
class FanPump(ForeignPump):
    """A fan: its rotor is a second lag, and its flow rises with the square root of the command."""

    rotor_s: float = 0.4
    _speed: float = 0.0

    def balance(self, flow_um_per_s: float) -> None:
        super().balance(flow_um_per_s)
        self._speed = flow_um_per_s

    def step(self, command: float) -> float:
        driven = super().step(command)
        self._speed -= (driven - self._speed) * math.expm1(-STEP_S / self.rotor_s)
        return self._speed


@dataclass
class PeristalticPump(ForeignPump):
    """Rollers: the flow pulsates with a frequency that rises with it."""

    depth: float = 0.3
    _phase: float = 0.0

    def step(self, command: float) -> float:
        flow = super().step(command)
        self._phase += 2 * math.pi * STEP_S * (1.0 + 2.0 * flow / self.full_um_per_s)
        return flow * (1.0 + self.depth * math.sin(self._phase))


@dataclass
class SupplyValve(ForeignPump):
    """A proportional valve with play, on a supply whose pressure falls."""

    falls_per_h: float = 0.2
    _time_s: float = 0.0

    def step(self, command: float) -> float:
        self._time_s += STEP_S
        return super().step(command) * (1.0 - self.falls_per_h * self._time_s / 3600.0)


@dataclass
class WarmingPump(ForeignPump):
    """A diaphragm pump whose threshold sinks while it warms up."""

    sinks: float = 0.04
    _time_s: float = 0.0

    def step(self, command: float) -> float:
        self._time_s += STEP_S
        warm = -math.expm1(-self._time_s / 300.0)
        return super().step(command + self.sinks * warm if command > 0 else 0.0)


class FlawedLaserPlant(ForeignPlant):
    """A laser with 1/f noise, coarse steps, a pace of its own and lost samples."""

    def sample_of(self, truth: ForeignTruth) -> BoardSample:
        sample = super().sample_of(truth)
        if not hasattr(self, "_walks"):
            self._walks = [0.0, 0.0, 0.0]
        rng = self._rng
        for number, memory_s in enumerate((0.5, 5.0, 50.0)):
            share = STEP_S / memory_s
            noise_um = 0.15 * math.sqrt(2 * share) * float(rng.standard_normal())
            self._walks[number] += -share * self._walks[number] + noise_um
        um = round((sample.displacement_um + sum(self._walks)) / 0.5) * 0.5
        lost = rng.random() < 0.01
        return replace(sample, displacement_um=um, displacement_quality=1 if lost else 0)


@dataclass(frozen=True)
class Bench:
    """A bench, and what its configuration states.

    Attributes
    ----------
    name : str
    pump : callable
        Makes the pump.
    leak_um_per_s, laser_um, weather : float
    rate_hz : float
    gusts, barometer, flawed_laser : bool
    """

    name: str
    pump: Callable[[], ForeignPump]
    leak_um_per_s: float = 1.24
    laser_um: float = 1.0
    weather: float = 1.0
    rate_hz: float = 50.0
    gusts: bool = False
    barometer: bool = True
    flawed_laser: bool = False
    pump_config: PumpConfig = field(default_factory=PumpConfig)

    def plant(self, seed: int) -> ForeignPlant:
        kind = FlawedLaserPlant if self.flawed_laser else ForeignPlant
        return kind(
            self.pump(),
            seed,
            self.weather,
            self.leak_um_per_s,
            self.gusts,
            self.laser_um,
            self.barometer,
        )

    def config(self) -> Config:
        """What a lab knows: the rate, and which sensors there are."""
        base = foreign_config(
            rate_hz=self.rate_hz,
            feedforward_barometer=self.barometer,
            feedforward_temperature=self.barometer,
        )
        return base.model_copy(update={"pump": self.pump_config})


BENCHES = (
    Bench("quick pump", ForeignPump),
    Bench("quadratic pump", lambda: ForeignPump("quadratic")),
    Bench("s-shaped pump", lambda: ForeignPump("s-shaped", delay_s=0.15, lag_s=0.25)),
    Bench("pump with a dead zone", lambda: ForeignPump("dead zone", delay_s=0.2, lag_s=0.2)),
    Bench("slow pump", lambda: ForeignPump(delay_s=0.4, lag_s=0.8)),
    Bench("tight mirror, slow", lambda: ForeignPump("root", 3.0, 0.3, 0.3), leak_um_per_s=0.5),
    Bench(
        "fan with inertia",
        lambda: FanPump("quadratic", delay_s=0.2, lag_s=0.4, rotor_s=0.5),
        gusts=True,
    ),
    Bench(
        "valve with backlash, supply falls",
        lambda: SupplyValve("straight", delay_s=0.1, lag_s=0.2, play=0.03),
    ),
    Bench("peristaltic pump", lambda: PeristalticPump("straight", delay_s=0.05, lag_s=0.1)),
    Bench(
        "diaphragm pump that warms up",
        lambda: WarmingPump("straight", delay_s=0.1, lag_s=0.15, start=0.2, stall=0.14),
        rate_hz=25.0,
        barometer=False,
    ),
    Bench("flawed laser, gusts", ForeignPump, gusts=True, flawed_laser=True),
)


@dataclass
class ForeignCamera:
    """Figures of a foreign plant for `VirtualRun`, each one interval late."""

    plant: ForeignPlant
    seed: int
    sigma_um: float = 0.036
    coming: deque[ShapeEstimate] = field(default_factory=deque)

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng([self.seed, 7])
        self._cycle = 0

    def __call__(self, now_s: float) -> ShapeEstimate | None:
        self._cycle += 1
        moved_um = self.plant.truth().displacement_um
        sag_um = _SAG_UM + moved_um + self.sigma_um * float(self._rng.standard_normal())
        figure = ShapeEstimate(
            time_s=now_s,
            kind="track",
            coeffs_um=np.zeros(_TERMS),
            hencky_um=0.0,
            covariance_um2=self.sigma_um**2 * np.eye(_TERMS),
            sag_um=sag_um,
            sag_change_sigma_um=self.sigma_um,
            displacement_um=math.nan,
            slope_residual_urad=1.0,
            valid_fraction=1.0,
            modulation_median_adu=80.0,
            saturated_fraction=0.0,
            verdict="ok",
            cycle=self._cycle,
        )
        self.coming.append(figure)
        return self.coming.popleft() if len(self.coming) > 1 else None
