"""Drawn benches of the second world: the estimate of the centre against the PID on the laser, in
the same weather.

Both get what a session of `tune` finds: dead time, lag and curve of the pump, noise of the
laser, effect of the weather. The PID is the best of six, chosen afterwards: SIMC with tc of 1, 2
and 4 effective dead times (0.5 s at least), with and without the feed-forward of barometer and
thermometer.

python -m benchmarks.control.centre_benches [--benches 100]
"""

from __future__ import annotations

import argparse
import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from benchmarks.tuning.benches import DrawnBench, drawn
from membrane_ctrl.config.schema import EstimatorConfig, LoopConfig, PumpConfig
from membrane_ctrl.control.centre import CentreFilter
from membrane_ctrl.control.centre_estimate import CentreReadings
from membrane_ctrl.control.inner_loop import InnerLoop, LoopInput
from tests.studies.held_centre import Optics
from tests.worlds.foreign_plant import CURVES

SETTLED_S, LOCK_S = 60.0, 5.0
SAG_UM = 37_100.0
PID_TIMES = (1.0, 2.0, 4.0)
EQUAL = 1.02  # two runs of one loop differ by that


def pump_of(bench: DrawnBench) -> PumpConfig:
    """The pump as a survey of it would tell."""
    pump = bench.plant(2).pump
    top = next(
        d for d in np.linspace(0, 1, 201) if CURVES[bench.shape](d) >= CURVES[bench.shape](1.0)
    )
    bottom = next(d for d in np.linspace(0, 1, 201) if CURVES[bench.shape](d) > 0)
    bottom = max(bottom, 0.12) if bench.shape == "bottom unreachable" else bottom
    commands = np.linspace(bottom, top, 25)
    rising = [pump.settled(d) for d in commands]
    falling = [pump.settled(0.0, min(d + bench.play, 1.0)) for d in commands]
    configured = {
        "curve_fraction": commands.tolist(),
        "curve_um_per_s": rising,
        "flow_full_um_per_s": rising[-1],
        "start_fraction": bench.start,
        "stall_fraction": bench.stall,
    }
    return PumpConfig.model_validate(
        configured | ({"curve_falling_um_per_s": falling} if bench.play else {})
    )


def loop_of(bench: DrawnBench, times: float, weather: bool) -> LoopConfig:
    """The loop of a bench, with a closed loop of so many effective dead times, with or without
    weather sensors.
    """
    theta_s = bench.delay_s + bench.lag_s / 2 + 0.2 + 0.5 / bench.rate_hz  # with the filter
    tc_s = max(0.5, times * theta_s)
    return LoopConfig(
        rate_hz=bench.rate_hz,
        kp_per_s=1 / (tc_s + theta_s),
        ti_s=4 * (tc_s + theta_s),
        flow_max_um_per_s=bench.full_um_per_s,
        barometer_gain_um_per_pa=-0.36,
        temperature_gain_um_per_k=124.0,
        gas_follows_air_s=0.0,
        feedforward_barometer=weather,
        feedforward_temperature=weather,
    )


def held_um(
    bench: DrawnBench, by: str, duration_s: float, times: float = 1.0, weather: bool = True
) -> float:
    """Standard deviation of the true centre; `by`: "pid", "laser" (the estimate, of it alone) or
    "all".
    """
    plant, pump, optics = bench.plant(2), pump_of(bench), Optics()
    loop = loop_of(bench, times, weather and bench.barometer)
    configured = EstimatorConfig(
        pump_delay_s=bench.delay_s, pump_lag_s=bench.lag_s, laser_noise_um=bench.laser_um
    )
    controller, centre = InnerLoop(loop, pump, configured), CentreFilter(configured, loop)
    dt_s, rng = 1 / bench.rate_hz, np.random.default_rng([bench.seed, 7])
    first_um = plant.truth().displacement_um
    controller.start(first_um, bench.leak_um_per_s)
    centre.start(first_um, bench.leak_um_per_s, 0.0)
    flow, true_um = bench.leak_um_per_s, []
    frames: deque[tuple[float, float, float]] = deque()
    next_s = LOCK_S
    for _ in range(round((SETTLED_S + duration_s) * bench.rate_hz)):
        now_s, truth = plant.time_s, plant.truth()
        sample = plant.sample_of(truth)
        true_um.append(truth.displacement_um)
        sag = (math.nan, math.nan, math.nan)
        if by == "all" and now_s >= next_s - 1e-9:
            next_s += 1 / optics.rate_hz
            seen_um = SAG_UM + truth.displacement_um + optics.sigma_um * rng.standard_normal()
            frames.append((now_s + optics.age_s, seen_um, now_s))
        while frames and frames[0][0] <= now_s + 1e-9:
            _, seen_um, taken_s = frames.popleft()
            sag = (seen_um, optics.sigma_um, taken_s)
        laser, pressure, air = (
            sample.displacement_um,
            sample.ambient_pressure_pa,
            sample.air_temperature_c,
        )
        estimate = (
            None
            if by == "pid"
            else centre.step(CentreReadings(now_s, flow, laser, pressure, air, *sag), dt_s)
        )
        trim_um = 0.0 if estimate is None else estimate.mount_um
        out = controller.step(LoopInput(0.0, trim_um, laser, pressure, air, estimate), dt_s)
        flow = out.flow_um_per_s
        plant.actuate(out.pump_fraction, 0.0)
        plant.advance(dt_s)
    return float(np.std(true_um[round(SETTLED_S * bench.rate_hz) :]))


@dataclass(frozen=True)
class Compared:
    """A bench held three ways, standard deviations of the true centre."""

    bench: DrawnBench
    pid_um: float
    laser_um: float
    all_um: float

    def __str__(self) -> str:
        """A row of a table."""
        bench, worse = self.bench, self.all_um > EQUAL * self.pid_um
        weather = f"{bench.weather:.1f}{', gusty' if bench.gusts else ''}{'' if bench.barometer else ', no barometer'}"  # noqa: E501
        return (
            f"| {bench.seed}: {bench.shape}, {bench.full_um_per_s:.1f} against "
            f"{bench.leak_um_per_s:.1f} µm/s, "
            f"{bench.delay_s:.2f} + {bench.lag_s:.2f} s, laser {bench.laser_um:.1f} µm, "
            f"{bench.rate_hz:g} Hz, "
            f"weather {weather} | {self.pid_um:.3f} | {self.laser_um:.3f} | "
            f"{self.all_um:.3f} |{' worse' * worse}"
        )


def compared(seed: int, duration_s: float) -> Compared:
    """One drawn bench."""
    bench = drawn(seed)
    weathers = (True, False) if bench.barometer else (False,)
    pid_um = min(
        held_um(bench, "pid", duration_s, times, with_) for times in PID_TIMES for with_ in weathers
    )
    return Compared(
        bench, pid_um, held_um(bench, "laser", duration_s), held_um(bench, "all", duration_s)
    )


def main() -> None:
    """Print a row for each bench, then how many were held as well or better."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--benches", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument(
        "--duration", type=float, default=120.0, help="seconds of each hold, after a minute"
    )
    options = parser.parse_args()
    rows = []
    for seed in range(options.first, options.first + options.benches):
        rows.append(compared(seed, options.duration))
        print(rows[-1], flush=True)
    for name in ("laser_um", "all_um"):
        ratios = np.array([getattr(row, name) / row.pid_um for row in rows])
        print(
            f"{name} over that of the PID: at most {EQUAL} on {np.mean(ratios <= EQUAL):.0%}, "
            f"median {np.median(ratios):.2f}, worst {ratios.max():.2f}"
        )


if __name__ == "__main__":
    main()
