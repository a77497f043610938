"""The fitted plant as a bench: what a proposal does on it with the real one-sided pump, before anything is applied.

Linear prediction knows nothing of a pump that only adds gas, stalls and starts. Here the real loop drives a pump with
the configured curve in front of the identified delay, lag, gain and leak, in the identified weather.
"""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.config.schema import LoopConfig, PumpConfig
from membrane_ctrl.control.experiments.machine import BenchSample
from tuning.identification import loop_model, records
from tuning.identification.disturbance import DisturbanceModel
from tuning.proposal.candidates import RECOVERED_UM
from tuning.rig import Rig

_SUBSTEPS = 4  # a tick: a dead time is then met within 2.5 ms at 50 Hz
_SETTLE_S = 30.0
_LEVEL_PA, _LEVEL_C = 101_325.0, 23.0  # any: only changes count


class ModelBench:
    """A simulated bench made of what was identified; equal seeds give equal weather.

    `leak_step` has the time in s and the size in um/s of a step of the leak.
    """

    def __init__(
        self,
        model: loop_model.PlantModel,
        disturbance: DisturbanceModel,
        pump: PumpConfig,
        seed: int,
        leak_step: tuple[float, float] = (math.inf, 0.0),
    ) -> None:
        self._model, self._disturbance, self._pump = model, disturbance, pump
        self._leak_step = leak_step
        self._rng = np.random.default_rng(seed)
        self._dt_s = disturbance.rest.dt_s
        self._step_s = self._dt_s / _SUBSTEPS
        flow = model.holding_flow_um_per_s
        self._tube = deque([flow] * (1 + round(model.dead_time_s / self._step_s)))
        self._arriving = flow
        self._running = True
        self._way_um = 0.0
        # walks: fast, slow rest, what the slow one reaches, barometer, air, gas
        self._walks = np.zeros(6)
        self._ticks = 0
        self.true_um: list[float] = []

    def exchange(self, pump_fraction: float, vent_fraction: float) -> BenchSample:
        """One tick. The vent stands where it stood when the leak was identified."""
        pump = self._pump
        self._running = pump_fraction >= (pump.stall_fraction if self._running else pump.start_fraction)
        share = (pump_fraction - pump.dead_fraction) / (1 - pump.dead_fraction)
        flow = pump.flow_full_um_per_s * max(0.0, share) if self._running else 0.0
        at_s, size = self._leak_step
        leak = self._model.leak_um_per_s + (size if self._ticks * self._dt_s >= at_s else 0.0)
        follow = -math.expm1(-self._step_s / self._model.lag_s)
        for _ in range(_SUBSTEPS):
            self._tube.append(flow)
            self._arriving += (self._tube.popleft() - self._arriving) * follow
            self._way_um += (self._model.gain * self._arriving - leak) * self._step_s
        return self._read(self._weather_um())

    def _weather_um(self) -> float:
        """Advance the weather by a tick; how far it has moved the centre."""
        of, walks = self._disturbance, self._walks
        barometer, air = of.barometer, of.air
        kicks = (of.rest.fast, of.rest.slow, 0.0, barometer.walk if barometer else 0.0, air.walk if air else 0.0, 0.0)
        walks += np.sqrt(np.array(kicks) * self._dt_s) * self._rng.standard_normal(6)
        for source, target, lag_s in ((1, 2, of.rest.slow_s), (4, 5, air.lag_s if air else 1.0)):
            walks[target] -= math.expm1(-self._dt_s / lag_s) * (walks[source] - walks[target])
        moved = walks[0] + walks[2]
        moved += barometer.gain * walks[3] if barometer else 0.0
        moved += air.gain * walks[5] if air else 0.0
        return float(moved)

    def _read(self, weather_um: float) -> BenchSample:
        of = self._disturbance
        true_um = self._way_um + weather_um
        self.true_um.append(true_um)
        self._ticks += 1
        laser, pressure, temperature = self._rng.standard_normal(3).tolist()
        return BenchSample(
            true_um + of.laser_um * laser,
            _LEVEL_PA + self._walks[3] + of.barometer.noise * pressure if of.barometer else math.nan,
            _LEVEL_C + self._walks[4] + of.air.noise * temperature if of.air else math.nan,
        )


@dataclass(frozen=True, slots=True)
class Preview:
    """What the fitted twin did."""

    std_um: float  # of the true centre
    bias_um: float
    # After a step of the leak, weather off: furthest excursion, and time until the centre stays within `RECOVERED_UM`
    load_peak_um: float
    recovery_s: float


def preview(
    loop: LoopConfig,
    pump: PumpConfig,
    model: loop_model.PlantModel,
    disturbance: DisturbanceModel,
    seed: int = 1,
    duration_s: float = 180.0,
    load_step_um_per_s: float = 0.6,
) -> Preview:
    """Hold on the fitted twin in its weather, and once more without weather for a step of the leak."""
    true_um = _held(loop, pump, model, ModelBench(model, disturbance, pump, seed), duration_s)
    calm = _without_weather(disturbance)
    stepped = ModelBench(model, calm, pump, seed, (_SETTLE_S, load_step_um_per_s))
    answer_um = _held(loop, pump, model, stepped, 120.0)
    away = np.flatnonzero(np.abs(answer_um) > RECOVERED_UM)
    return Preview(
        std_um=float(true_um.std()),
        bias_um=float(true_um.mean()),
        load_peak_um=float(np.abs(answer_um).max()),
        recovery_s=float((away[-1] + 1) / loop.rate_hz) if away.size else 0.0,
    )


def _held(
    loop: LoopConfig, pump: PumpConfig, model: loop_model.PlantModel, bench: ModelBench, duration_s: float
) -> records.Series:
    """True centre after settling."""
    rig = Rig(bench, loop, pump, model.holding_flow_um_per_s)
    rig.hold(_SETTLE_S + duration_s)
    return np.array(bench.true_um)[round(_SETTLE_S * loop.rate_hz) :]


def _without_weather(disturbance: DisturbanceModel) -> DisturbanceModel:
    rest = disturbance.rest
    still = type(rest)(rest.white * 1e-3, 0.0, 0.0, rest.slow_s, 0.0, 0.0, 0.0, rest.dt_s)
    return DisturbanceModel(still, None, None)
