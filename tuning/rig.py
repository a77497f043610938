"""A bench under the tuner's hand: holds and experiments on one loop, without a bump between them, each a record."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np

from membrane_ctrl.config import LoopConfig, PumpConfig
from membrane_ctrl.control.experiments.machine import Around, ExcursionGuard, Experiment, Finished
from membrane_ctrl.control.experiments.measurement import Measurement
from membrane_ctrl.control.experiments.spec import ExperimentSpec
from membrane_ctrl.control.experiments.trial import Trial
from membrane_ctrl.control.inner_loop import InnerLoop, LoopInput, LoopOutput
from membrane_ctrl.control.pump_curve import PumpCurve
from tuning.records import Record

Tick = Callable[[LoopOutput], None]


class Bench(Protocol):
    """What a rig drives: the twin, a fitted model, or a live hold in its `tune` state."""

    def exchange(self, pump_fraction: float, vent_fraction: float) -> Measurement:
        """Put out the commands, wait for the next tick, and return its reading."""
        ...


class Rig:
    """One loop on one bench, in ticks.

    Parameters
    ----------
    bench : Bench
    loop : LoopConfig
    pump : PumpConfig
    leak_um_per_s : float
        Flow to begin with.
    """

    def __init__(self, bench: Bench, loop: LoopConfig, pump: PumpConfig, leak_um_per_s: float) -> None:
        self._bench = bench
        self._config, self._pump = loop, pump
        self._loop = InnerLoop(loop, pump)
        self.dt_s = 1 / loop.rate_hz
        self._last = bench.exchange(self._fraction(leak_um_per_s), loop.bleed_fraction)
        self._loop.start(self._last.displacement_um, leak_um_per_s)

    def set_gains(self, loop: LoopConfig) -> None:
        """Bumpless."""
        self._config = loop
        self._loop.set_gains(loop)

    def hold(self, duration_s: float, target_um: float = 0.0) -> Record:
        """Hold at a target."""
        flows: list[float] = []
        samples: list[Measurement] = []
        for _ in range(round(duration_s / self.dt_s)):
            out = self._loop.step(self._given(target_um), self.dt_s)
            flows.append(out.flow_um_per_s)
            samples.append(self._last)
            self._last = self._bench.exchange(out.pump_fraction, self._config.bleed_fraction)
        return Record.from_samples(self.dt_s, flows, samples)

    def perform(self, spec: ExperimentSpec) -> tuple[Record, Finished]:
        """Run an experiment about 0 until it says that it is finished; the loop may hold from there on."""
        return self._run(Trial(spec, self._config, self._pump, 0.0), spec.holding_flow_um_per_s)

    def run(self, experiment: Experiment, around: Around, centre_um: float) -> tuple[Record, Finished]:
        """The same for an experiment of one's own, inside the guard."""
        return self._run(ExcursionGuard(experiment, around, centre_um, 1 / self.dt_s), around.holding_flow_um_per_s)

    def _run(self, guard: Experiment, holding_flow_um_per_s: float) -> tuple[Record, Finished]:
        flows: list[float] = []
        samples: list[Measurement] = []
        while True:
            wanted = guard.step(self._last, self.dt_s)
            if isinstance(wanted, Finished):
                self._loop.follow(self._given(0.0), holding_flow_um_per_s, self.dt_s)
                return Record.from_samples(self.dt_s, flows, samples), wanted
            out = self._loop.follow(self._given(0.0), wanted, self.dt_s)
            flows.append(out.flow_um_per_s)
            samples.append(self._last)
            self._last = self._bench.exchange(out.pump_fraction, self._config.bleed_fraction)

    def around(self, held: Record, limit_um: float = 10.0) -> Around:
        """The frame of an experiment, from a hold before it."""
        return around_of(held, self._config, self._pump, limit_um)

    def _given(self, target_um: float) -> LoopInput:
        now = self._last
        return LoopInput(target_um, 0.0, now.displacement_um, now.ambient_pressure_pa, now.air_temperature_c)

    def _fraction(self, flow_um_per_s: float) -> float:
        return PumpCurve(self._pump).command(flow_um_per_s, self.dt_s) if flow_um_per_s > 0 else 0.0


def around_of(held: Record, loop: LoopConfig, pump: PumpConfig, limit_um: float) -> Around:
    """The frame of an experiment: what a hold before it shows, and the pump's range."""
    return Around(
        holding_flow_um_per_s=float(held.flow_um_per_s.mean()),
        least_flow_um_per_s=PumpCurve(pump).least_flow_um_per_s,
        full_flow_um_per_s=min(pump.flow_full_um_per_s, loop.flow_max_um_per_s),
        laser_um=laser_noise_um(held),
        limit_um=limit_um,
    )


def laser_noise_um(record: Record) -> float:
    """Standard deviation of a reading: of two in a row, over sqrt(2), for the mirror hardly moves in a tick.

    A median, so that a jump does not count. Raises ValueError without two readings.
    """
    steps_um = np.diff(record.displacement_um[np.isfinite(record.displacement_um)])
    if steps_um.size == 0:
        raise ValueError("no laser reading in the record")
    return float(np.median(np.abs(steps_um)) / 0.6745 / math.sqrt(2))
