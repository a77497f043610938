"""The inner loop on the simulated bench, in virtual time: the true motion of the centre."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.config.schema import LoopConfig, PumpConfig, TwinConfig
from membrane_ctrl.control.inner_loop import InnerLoop, LoopInput, LoopOutput
from membrane_ctrl.sim.bench_events import AmbientChange, BenchEvent, LeakChange
from membrane_ctrl.sim.plant import Plant
from tests.studies.minimum_variance import WRITE_S, least_std_um

SETTLED_S = 40.0
SCENARIOS = ("quiet", "typical", "gusty")
SENSORS = {
    "laser": (False, False),
    "barometer": (True, False),
    "barometer and thermometer": (True, True),
}
LEAK_TIME_CONSTANTS_S = (1e4, 2e4, 3e4, 5e4, 1e5)

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class HeldRun:
    """A run, one row a tick: `true_um` is the true centre, `leak_um_per_s` the estimate."""

    time_s: Array
    true_um: Array
    setpoint_um: Array
    flow_um_per_s: Array
    leak_um_per_s: Array
    too_tight: NDArray[np.bool_]

    def after(self, time_s: float) -> Array:
        """True centre from a time on."""
        return self.true_um[self.time_s >= time_s]


def hold(
    loop: LoopConfig,
    twin: TwinConfig,
    duration_s: float,
    events: Sequence[BenchEvent] = (),
    lost_s: tuple[float, float] = (np.inf, np.inf),
    target_um: Callable[[float], float] = lambda time_s: 0.0,
    true_pump: PumpConfig = PumpConfig(),  # noqa: B008 (frozen)
) -> HeldRun:
    """Hold the simulated mirror; `lost_s` is a span without readings, `true_pump` a pump unknown to
    the loop.
    """
    plant, controller = Plant(twin, true_pump, events), InnerLoop(loop, PumpConfig())
    dt_s = 1 / loop.rate_hz
    controller.start(plant.sample().displacement_um, plant.truth().leak_um_per_s)
    rows = []
    for _ in range(round(duration_s * loop.rate_hz)):
        now_s, sample = plant.time_s, plant.sample()
        out: LoopOutput
        if lost_s[0] <= now_s < lost_s[1]:
            out = controller.step_without_reading(LoopInput(0.0, 0.0, np.nan, np.nan, np.nan), dt_s)
        else:
            reading = sample.displacement_um, sample.ambient_pressure_pa, sample.air_temperature_c
            out = controller.step(LoopInput(target_um(now_s), 0.0, *reading), dt_s)
        plant.advance(WRITE_S)
        plant.actuate(out.pump_fraction, loop.bleed_fraction)
        true_um = plant.truth().displacement_um
        plant.advance(dt_s - WRITE_S)
        rows.append(
            (now_s, true_um, out.setpoint_um, out.flow_um_per_s, out.leak_um_per_s, out.too_tight)
        )
    columns = np.array(rows).T
    return HeldRun(*columns[:5], too_tight=columns[5].astype(bool))


def _configs(sensors: str, scenario: str, seed: int, **twin: Any) -> tuple[LoopConfig, TwinConfig]:
    barometer, thermometer = SENSORS[sensors]
    loop = LoopConfig(feedforward_barometer=barometer, feedforward_temperature=thermometer)
    return loop, TwinConfig.model_validate(
        {"scenario": scenario, "seed": seed, "start_error_um": 0.0} | twin
    )


def steady(
    sensors: str, scenario: str, seeds: Sequence[int], duration_s: float, **twin: Any
) -> dict[str, float]:
    """Statistics of the true centre after settling; the bias is setpoint minus truth, as
    everywhere.
    """
    runs = []
    for seed in seeds:
        loop, bench = _configs(sensors, scenario, seed, **twin)
        held = hold(loop, bench, duration_s + SETTLED_S)
        true_um = held.after(SETTLED_S)
        ticks = round(loop.rate_hz)
        means_um = true_um[: true_um.size // ticks * ticks].reshape(-1, ticks).mean(axis=1)
        runs.append(
            (true_um.std(), -true_um.mean(), np.mean(np.abs(means_um) <= 2.0), held.too_tight[-1])
        )
    std_um, bias_um, in_band, too_tight = np.array(runs, dtype=float).T
    return {
        "std_um": float(np.sqrt(np.mean(std_um**2))),
        "worst_std_um": float(std_um.max()),
        "bias_um": float(bias_um.mean()),
        "worst_bias_um": float(np.abs(bias_um).max()),
        "in_band_1s_fraction": float(in_band.min()),
        "too_tight_fraction": float(too_tight.mean()),
        "least_std_um": least_std_um(loop, bench),
    }


def answer(
    sensors: str, event: BenchEvent, seeds: Sequence[int], near_um: float
) -> dict[str, float]:
    """Peak of the true centre after an event at 60 s, and the time until it stays near."""
    peaks_um, back_s = [], []
    for seed in seeds:
        held = hold(*_configs(sensors, "quiet", seed), 120.0, [event])
        true_um = held.after(60.0)
        away = np.flatnonzero(np.abs(true_um) > near_um)
        peaks_um.append(np.abs(true_um).max())
        back_s.append(0.0 if away.size == 0 else (away[-1] + 1) / 50.0)
    return {
        "peak_um": float(np.mean(peaks_um)),
        "worst_peak_um": float(max(peaks_um)),
        "back_s": float(max(back_s)),
    }


def lost_reading(sensors: str, seeds: Sequence[int], seconds: float = 10.0) -> dict[str, float]:
    """Largest excursion of the true centre when the reading is lost in typical weather."""
    peaks_um = []
    for seed in seeds:
        held = hold(
            *_configs(sensors, "typical", seed), 70.0 + seconds, lost_s=(60.0, 60.0 + seconds)
        )
        peaks_um.append(float(np.abs(held.after(60.0)).max()))
    return {"mean_um": float(np.mean(peaks_um)), "worst_um": max(peaks_um)}


def start_up(seeds: Sequence[int]) -> dict[str, float]:
    """From 25 µm off: time until the true centre stays within 2 µm, and the overshoot."""
    times_s, over_um = [], []
    for seed in seeds:
        held = hold(
            *_configs("barometer and thermometer", "typical", seed, start_error_um=-25.0), 40.0
        )
        away = np.flatnonzero(np.abs(held.true_um) > 2.0)
        times_s.append(held.time_s[away[-1]])
        over_um.append(held.true_um.max())
    return {"within_2um_s": float(max(times_s)), "overshoot_um": float(max(over_um))}


def run(seeds: int = 4, duration_s: float = 300.0) -> dict[str, Any]:
    """All figures; `seeds` runs of each case (five times as many of the short ones)."""
    few, many = range(1, seeds + 1), range(1, 5 * seeds + 1)
    return {
        "steady": {s: {k: steady(k, s, few, duration_s) for k in SENSORS} for s in SCENARIOS},
        "leak doubled": {k: answer(k, LeakChange(60.0), few, 0.5) for k in SENSORS},
        "door +20 Pa": {k: answer(k, AmbientChange(60.0, 20.0), few, 2.0) for k in SENSORS},
        "door -20 Pa": {k: answer(k, AmbientChange(60.0, -20.0), few, 2.0) for k in SENSORS},
        "10 s without a reading": {k: lost_reading(k, many) for k in SENSORS},
        "start": start_up(few),
        "tight": {
            f"{1.24e4 / t:.2f}": steady(
                list(SENSORS)[2], "typical", few, duration_s, leak_time_constant_s=t
            )
            for t in LEAK_TIME_CONSTANTS_S
        },
    }
