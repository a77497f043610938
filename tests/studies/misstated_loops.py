"""A loop whose statements about its bench are wrong, and the same bench held by state feedback.

The bench is this module's own: gas, air pressure, air temperature, a pump with dead time and lag,
and noise, in steps of 5 ms. What the loop is told differs from it by a `Misstatement`. Two laws
hold it: the product's estimate with its loop, and an LQG regulator that python-control designs,
which feeds back the measured weather as well and so knows what the gas will do.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import control
import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.config.schema import EstimatorConfig, LoopConfig, PumpConfig
from membrane_ctrl.control.centre import CentreFilter
from membrane_ctrl.control.centre_estimate import CentreReadings
from membrane_ctrl.control.inner_loop import InnerLoop, LoopInput

Array = NDArray[np.float64]

RATE_HZ = 50.0
SETTLED_S = 60.0  # the filter has learned the gains from 30 s on
_STEPS = 4  # of the bench in a tick
_STEP_S = 1 / (RATE_HZ * _STEPS)
# A filter that no longer knows where the mirror is, or a loop that swings
UNSTABLE_UM = 20.0
# Bounds of a joint draw, as shares of what is stated
_DELAY_OFF, _GAIN_OFF, _WARMTH_OFF, _FLOW_OFF, _NOISE_OFF = 0.3, 0.2, 0.15, 0.2, 0.3
# Weights of the change of the flow in a tick, against the square of the error in µm; of each bench
# the best of them is chosen afterwards
LQG_WEIGHTS = (0.0003, 0.003, 0.03)
# Random walk of the leak that the regulator assumes, and the time in which it forgets: without one
# the leak is an integrator that no flow controls
_LQG_LEAK_WALK, _LQG_LEAK_MEMORY_S = 0.003, 1e4
_LQG_CENTRE_WALK_UM = 0.01  # per root second, as the product assumes


@dataclass(frozen=True)
class LoopBench:
    """What is true of a bench, or stated of it.

    Attributes
    ----------
    delay_s, lag_s, full_um_per_s : float
        Of the pump.
    leak_um_per_s : float
    pressure_pa, pressure_s, air_k, air_s : float
        Standard deviation and correlation time of the air's pressure and temperature.
    pressure_gain_um_per_pa, warmth_gain_um_per_k, gas_s : float
        How they move the centre; the gas follows the air with a lag.
    laser_um, barometer_pa, thermometer_k : float
        Noises of a reading.
    """

    delay_s: float = 0.08
    lag_s: float = 0.15
    full_um_per_s: float = 5.3
    leak_um_per_s: float = 1.24
    pressure_pa: float = 1.2
    pressure_s: float = 30.0
    air_k: float = 0.05
    air_s: float = 300.0
    pressure_gain_um_per_pa: float = -0.358
    warmth_gain_um_per_k: float = 123.0
    gas_s: float = 12.0
    laser_um: float = 1.0
    barometer_pa: float = 0.05
    thermometer_k: float = 0.002


def draw_misstatement(bench: LoopBench, seed: int) -> LoopBench:
    """What is stated of a bench: every figure of pump, gains and noises is wrong at once.

    Dead time and lag by up to 30 %, the gains of pressure and temperature by 20 and 15 %, the
    pump's flow by 20 %, the noises by 30 %, each uniformly.
    """
    rng = np.random.default_rng([20261127, seed])

    def state(true: float, most: float) -> float:
        return true * (1.0 + float(rng.uniform(-most, most)))

    return replace(
        bench,
        delay_s=state(bench.delay_s, _DELAY_OFF),
        lag_s=state(bench.lag_s, _DELAY_OFF),
        pressure_gain_um_per_pa=state(bench.pressure_gain_um_per_pa, _GAIN_OFF),
        warmth_gain_um_per_k=state(bench.warmth_gain_um_per_k, _WARMTH_OFF),
        full_um_per_s=state(bench.full_um_per_s, _FLOW_OFF),
        laser_um=state(bench.laser_um, _NOISE_OFF),
        barometer_pa=state(bench.barometer_pa, _NOISE_OFF),
        thermometer_k=state(bench.thermometer_k, _NOISE_OFF),
    )


def draw_bench(seed: int) -> LoopBench:
    """A bench at random: pump, leak, weather and noises, each over a factor of 3 to 10."""
    rng = np.random.default_rng([20261128, seed])

    def log(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(math.log(low), math.log(high))))

    leak = log(0.4, 3.0)
    return LoopBench(
        delay_s=log(0.04, 0.4),
        lag_s=log(0.05, 0.8),
        full_um_per_s=leak * log(2.5, 10.0),
        leak_um_per_s=leak,
        pressure_pa=log(0.4, 4.0),
        air_k=log(0.02, 0.1),
        gas_s=log(4.0, 40.0),
        laser_um=log(0.1, 3.0),
        barometer_pa=log(0.02, 0.2),
        thermometer_k=log(0.001, 0.005),
    )


@dataclass(frozen=True)
class Readings:
    """What the law reads in a tick."""

    laser_um: float
    pressure_pa: float
    air_c: float


Law = Callable[[float, Readings], float]
"""Time and readings of a tick to the pump's flow, as share of its full flow."""


def simulate_bench(bench: LoopBench, law: Law, seed: int, duration_s: float) -> Array:
    """True centre in µm at each tick, held by a law."""
    rng = np.random.default_rng([seed, 49])
    ticks = round(duration_s * RATE_HZ)
    pressure_pa = _draw_weather(rng, bench.pressure_pa, bench.pressure_s, ticks)
    air_k = _draw_weather(rng, bench.air_k, bench.air_s, ticks)
    noise = rng.standard_normal((ticks, 3)) * (
        bench.laser_um,
        bench.barometer_pa,
        bench.thermometer_k,
    )
    gas_um, gas_k = 0.0, float(air_k[0])
    first_um = bench.pressure_gain_um_per_pa * pressure_pa[0] + bench.warmth_gain_um_per_k * gas_k
    in_tube = deque([bench.leak_um_per_s] * max(1, round(bench.delay_s / _STEP_S)))
    arriving = bench.leak_um_per_s
    follow = -math.expm1(-_STEP_S / bench.lag_s)
    warm = -math.expm1(-_STEP_S / bench.gas_s)
    centre_um = np.empty(ticks)
    for tick in range(ticks):
        weather_um = bench.pressure_gain_um_per_pa * pressure_pa[tick]
        weather_um += bench.warmth_gain_um_per_k * gas_k - first_um
        centre_um[tick] = gas_um + weather_um
        readings = Readings(
            centre_um[tick] + noise[tick, 0],
            98_400.0 + pressure_pa[tick] + noise[tick, 1],
            22.0 + air_k[tick] + noise[tick, 2],
        )
        share = min(max(law(tick / RATE_HZ, readings), 0.0), 1.0)
        for _ in range(_STEPS):
            in_tube.append(share * bench.full_um_per_s)
            arriving += follow * (in_tube.popleft() - arriving)
            gas_um += (arriving - bench.leak_um_per_s) * _STEP_S
            gas_k += warm * (air_k[tick] - gas_k)
        if not abs(centre_um[tick]) < 1e3:
            centre_um[tick:] = math.inf
            break
    return centre_um


def _draw_weather(rng: np.random.Generator, std: float, memory_s: float, ticks: int) -> Array:
    """Noise that forgets exponentially, at each tick."""
    keep = math.exp(-1 / (RATE_HZ * memory_s))
    steps = math.sqrt(1 - keep**2) * std * rng.standard_normal(ticks)
    value, found = std * float(rng.standard_normal()), np.empty(ticks)
    for tick, step in enumerate(steps):
        value = keep * value + step
        found[tick] = value
    return found


def make_product_law(stated: LoopBench) -> Law:
    """The product's filter and loop, told what is stated."""
    loop = LoopConfig(
        rate_hz=RATE_HZ,
        flow_max_um_per_s=stated.full_um_per_s,
        barometer_gain_um_per_pa=stated.pressure_gain_um_per_pa,
        temperature_gain_um_per_k=stated.warmth_gain_um_per_k,
        gas_follows_air_s=stated.gas_s,
    )
    estimator = EstimatorConfig(
        pump_delay_s=stated.delay_s,
        pump_lag_s=stated.lag_s,
        laser_noise_um=stated.laser_um,
        barometer_noise_pa=stated.barometer_pa,
        thermometer_noise_k=stated.thermometer_k,
    )
    # The pump of the bench gives its flow in proportion to the command, without a dead zone
    pump = PumpConfig(
        flow_full_um_per_s=stated.full_um_per_s,
        dead_fraction=0.0,
        start_fraction=0.0,
        stall_fraction=0.0,
    )
    regulator, centre = InnerLoop(loop, pump, estimator), CentreFilter(estimator, loop)
    regulator.start(0.0, stated.leak_um_per_s)
    centre.start(0.0, stated.leak_um_per_s, 0.0)
    flow = stated.leak_um_per_s

    def law(now_s: float, given: Readings) -> float:
        nonlocal flow
        readings = CentreReadings(now_s, flow, given.laser_um, given.pressure_pa, given.air_c)
        estimate = centre.step(readings, 1 / RATE_HZ)
        output = regulator.step(
            LoopInput(0.0, 0.0, given.laser_um, given.pressure_pa, given.air_c, estimate),
            1 / RATE_HZ,
        )
        flow = output.flow_um_per_s
        return output.pump_fraction

    return law


def make_lqg_law(stated: LoopBench, weight: float) -> Law:
    """A linear quadratic Gaussian regulator, designed by python-control for what is stated.

    States: gas, leak, pressure and temperature of the air, temperature of the gas, flow behind the
    lag, and the flow in each tick of the dead time, the last one being the present command.
    """
    dt_s = 1 / RATE_HZ
    delay = max(1, round(stated.delay_s * RATE_HZ))
    size = 6 + delay
    gas, leak, pressure, air, warmth, arriving, tube = range(7)
    newest = size - 1
    a = np.eye(size)
    a[gas, arriving], a[gas, leak] = dt_s, -dt_s
    a[leak, leak] = math.exp(-dt_s / _LQG_LEAK_MEMORY_S)
    a[pressure, pressure] = math.exp(-dt_s / stated.pressure_s)
    a[air, air] = math.exp(-dt_s / stated.air_s)
    warm = -math.expm1(-dt_s / stated.gas_s)
    a[warmth, warmth], a[warmth, air] = 1 - warm, warm
    follow = -math.expm1(-dt_s / stated.lag_s)
    a[arriving, arriving], a[arriving, tube] = 1 - follow, follow
    for place in range(tube, newest):
        a[place, place], a[place, place + 1] = 0.0, 1.0
    b = np.zeros((size, 1))  # the input is the change of the command
    b[newest] = 1.0
    centre = np.zeros((1, size))
    centre[0, [gas, pressure, warmth]] = (
        1.0,
        stated.pressure_gain_um_per_pa,
        stated.warmth_gain_um_per_k,
    )
    feedback, _, _ = control.dlqr(a, b, centre.T @ centre, np.array([[weight]]))
    walks = np.zeros(size)
    walks[gas] = _LQG_CENTRE_WALK_UM**2 * dt_s
    walks[leak] = _LQG_LEAK_WALK**2 * dt_s
    walks[pressure] = stated.pressure_pa**2 * (1 - a[pressure, pressure] ** 2)
    walks[air] = stated.air_k**2 * (1 - a[air, air] ** 2)
    seen = np.zeros((3, size))
    seen[0] = centre
    seen[1, pressure] = seen[2, air] = 1.0
    noises = np.array([stated.laser_um, stated.barometer_pa, stated.thermometer_k]) ** 2
    gain, _, _ = control.dlqe(a, np.eye(size), seen, np.diag(walks), np.diag(noises))
    state: Array = np.zeros(size)
    state[[leak, arriving]] = stated.leak_um_per_s
    state[tube:] = stated.leak_um_per_s
    zeros: Array | None = None

    def law(_: float, given: Readings) -> float:
        nonlocal state, zeros
        read = np.array([given.laser_um, given.pressure_pa, given.air_c])
        if zeros is None:
            zeros = np.array([0.0, given.pressure_pa, given.air_c])
        state = state + gain @ (read - zeros - seen @ state)
        wanted = state[newest] - float((feedback @ state)[0])
        # The filter knows the flow after its limits
        flow = min(max(wanted, 0.0), stated.full_um_per_s)
        state = a @ state
        state[newest] = flow
        return float(flow / stated.full_um_per_s)

    return law


def measure_std(bench: LoopBench, law: Law, seed: int, duration_s: float) -> float:
    """Standard deviation of the true centre after settling; infinite if the loop is unstable."""
    centre_um = simulate_bench(bench, law, seed, SETTLED_S + duration_s)
    late_um = centre_um[round(SETTLED_S * RATE_HZ) :]
    if not np.abs(late_um).max() < UNSTABLE_UM:
        return math.inf
    return float(np.sqrt(np.mean(late_um**2)))


def measure_best_lqg(bench: LoopBench, stated: LoopBench, seed: int, duration_s: float) -> float:
    """The least standard deviation of the regulators of all weights."""
    return min(
        measure_std(bench, make_lqg_law(stated, weight), seed, duration_s) for weight in LQG_WEIGHTS
    )
