"""What a design will do: the predicted standard deviations, the lower bound for any controller, and
a preview.

Predicted: the true centre is S d - T n for a disturbance d and laser noise n; its variance is the
integral of its spectrum. Bound: no controller acts before the dead time, so the error is at least
that of the best prediction of the disturbance over it (Astrom, Introduction to Stochastic Control
Theory, 1970, chapter 6). The pump's lag is no limit: it can be inverted. Preview: the real
one-sided pump on the fitted plant.
"""

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import expm, solve_discrete_are
from scipy.special import ndtr

from membrane_ctrl.config.schema import LoopConfig, PumpConfig
from membrane_ctrl.control import pump_curve
from membrane_ctrl.control.experiments.experiment import BenchSample
from membrane_ctrl.model.arrays import FloatArray
from tuning.identification import loop_model
from tuning.identification.disturbance import DisturbanceModel
from tuning.rig import Rig

Matrix = FloatArray


@dataclass(frozen=True, slots=True)
class Predicted:
    """Standard deviations: of the true centre, of the feedback's flow, and of its change from tick
    to tick.
    """

    std_um: float
    flow_std_um_per_s: float
    flow_step_std_um_per_s: float


def predict(
    gains: loop_model.Gains,
    model: loop_model.PlantModel,
    disturbance: DisturbanceModel,
    loop: LoopConfig,
) -> Predicted:
    """Of a stable loop; the pump's limits count as they do on average (`limited`)."""
    dt_s = disturbance.rest.dt_s
    w = loop_model.frequencies(dt_s)
    model, moving = limited(gains, model, disturbance, loop, w)
    sensitivity, noise = (
        1 / (1 + loop_model.loop_response(gains, model, w, dt_s)),
        disturbance.rest.white_psd,
    )
    centre = np.abs(sensitivity) ** 2 * moving + np.abs(1 - sensitivity) ** 2 * noise
    flow = np.abs(loop_model.controller_response(gains, w) * sensitivity) ** 2 * (moving + noise)
    change = flow * np.abs(2 * np.sin(w * dt_s / 2)) ** 2
    return Predicted(*(math.sqrt(_variance(spectrum, w)) for spectrum in (centre, flow, change)))


def _variance(psd: FloatArray, w: FloatArray) -> float:
    return float(np.trapezoid(psd * w, np.log(w))) / math.pi


# of the swing and what the limits leave of it, each from the other: within 1 % of the preview's
_ROUNDS = 4


def limited(
    gains: loop_model.Gains,
    model: loop_model.PlantModel,
    disturbance: DisturbanceModel,
    loop: LoopConfig,
    w: FloatArray,
) -> tuple[loop_model.PlantModel, FloatArray]:
    """The plant as a pump with limits drives it, and the spectrum of the centre without feedback at
    `w`, µm^2 s.

    The pump gives no less than nothing and no more than `loop.flow_max_um_per_s`. Statistical
    linearisation (Gelb and Vander Velde, Multiple-Input Describing Functions, 1968, chapter 7): of
    a flow that swings like a Gaussian, the limits leave a share, and add noise of their own, whose
    correlation is the square of the flow's.
    """
    dt_s, noise = disturbance.rest.dt_s, disturbance.rest.white_psd
    controller, forward = (
        loop_model.controller_response(gains, w),
        disturbance.feedforward_psd(w, loop),
    )
    plant, moving = model, disturbance.psd(w, model, loop)
    for _ in range(_ROUNDS):
        sensitivity = 1 / (1 + loop_model.loop_response(gains, plant, w, dt_s))
        flow = np.abs(controller * sensitivity) ** 2 * (moving + noise) + forward
        variance = _variance(flow, w)
        share, rest = _clipped(
            math.sqrt(variance), model.holding_flow_um_per_s, loop.flow_max_um_per_s
        )
        if share > 1 - 1e-3:
            break
        memory_s = _variance(flow**2, w) / variance**2
        plant = replace(model, gain=model.gain * share)
        added = rest * memory_s / (1 + (w * memory_s / 2) ** 2)
        moving = (
            disturbance.psd(w, plant, loop)
            + added * np.abs(loop_model.pump_response(model, w, dt_s) / w) ** 2
        )
    return plant, moving


def _clipped(std: float, mean: float, most: float) -> tuple[float, float]:
    """What limits of 0 and `most` leave of a Gaussian's small changes, and the variance that they
    add.

    `mean` is that of the clipped flow; an integrator finds the unclipped one, as Newton's method
    does here.
    """
    before = mean = min(max(mean, 1e-3 * most), 0.999 * most)
    for _ in range(20):
        low, high = -before / std, (most - before) / std
        inside, above = ndtr(high) - ndtr(low), most * ndtr(-high)
        density = [math.exp(-0.5 * at * at) / math.sqrt(2 * math.pi) for at in (low, high)]
        after = before * inside + std * (density[0] - density[1]) + above
        if abs(after - mean) < 1e-3 * mean:
            break
        before += (mean - after) / max(inside, 1e-3)
    square = (
        (before**2 + std**2) * inside
        + std * (before * density[0] - (before + most) * density[1])
        + most * above
    )
    return float(inside), float(max(0.0, square - after**2 - (inside * std) ** 2))


def least_std_um(
    model: loop_model.PlantModel,
    disturbance: DisturbanceModel,
    loop: LoopConfig,
    write_s: float = 0.0,
) -> float:
    """Bound for the sensors that the loop's feed-forward uses; unused weather counts as
    disturbance.

    `write_s` is the time from a reading to its command, if the model's dead time does not include
    it.
    """
    moving = Walks.of(disturbance)
    centre = moving.centre
    readings, noises = [centre], [disturbance.rest.white**2]
    for reading, weather, used in (
        (moving.barometer, disturbance.barometer, loop.feedforward_barometer),
        (moving.air, disturbance.air, loop.feedforward_temperature),
    ):
        if weather is not None and used:
            readings.append(reading)
            noises.append(weather.noise**2)
    c, r = np.array(readings), np.diag(noises)
    transition, kicks = moving.over(disturbance.rest.dt_s)
    before = solve_discrete_are(transition.T, c.T, kicks, r)
    after = before - before @ c.T @ np.linalg.solve(c @ before @ c.T + r, c @ before)
    transition, kicks = moving.over(model.dead_time_s + write_s + disturbance.rest.dt_s / 2)
    return float(np.sqrt(centre @ (transition @ after @ transition.T + kicks) @ centre))


# A walk that returns after an hour is equivalent for the loop, and bounds what the laser cannot
# distinguish.
_RETURN_S = 3600.0
# Intensity of an unseen walk, µm^2/s: 1 nm in a second; zero would leave the filter without a
# solution.
_UNSEEN = 1e-6


@dataclass(frozen=True, slots=True)
class Walks:
    """The disturbance as states: their drift (n, n) and diffusion (n, n), and three sums of them
    (n,).
    """

    drift: Matrix
    diffusion: Matrix
    barometer: FloatArray
    air: FloatArray
    centre: FloatArray

    @classmethod
    def of(cls, disturbance: DisturbanceModel) -> "Walks":
        """States: barometer, air, gas, fast rest, slow rest, what it reaches; two more for each
        colour.
        """
        barometer, air, rest = disturbance.barometer, disturbance.air, disturbance.rest
        colours = [
            (source, *colour)
            for source, of in enumerate((barometer, air, rest))
            if of
            for colour in of.coloured
        ]
        n = 6 + 2 * len(colours)
        drift, diffusion = -np.eye(n) / _RETURN_S, np.zeros((n, n))
        air_s = air.lag_s if air is not None else rest.slow_s
        walks = (barometer.walk if barometer else _UNSEEN, air.walk if air else _UNSEEN)
        np.fill_diagonal(
            diffusion[:6, :6], [*walks, 0.0, max(rest.fast, _UNSEEN), max(rest.slow, _UNSEEN), 0.0]
        )
        sums = np.zeros((3, n))
        sums[0, 0] = sums[1, 1] = sums[2, 3] = sums[2, 5] = 1.0
        for first, (source, tau_s, intensity) in zip(range(6, n, 2), colours, strict=True):
            drift[first, first] = drift[first + 1, first + 1] = -1 / tau_s
            drift[first + 1, first] = 1 / tau_s
            diffusion[first, first] = intensity / tau_s**2
            sums[source, first + 1] = 1.0
        drift[2] += sums[1] / air_s
        drift[2, 2] = -1 / air_s
        drift[5, 4:6] = 1 / rest.slow_s, -1 / rest.slow_s
        centre = sums[2] + (barometer.gain if barometer else 0.0) * sums[0]
        centre[2] = air.gain if air else 0.0
        return cls(drift, diffusion, sums[0], sums[1], centre)

    def over(self, step_s: float) -> tuple[Matrix, Matrix]:
        """Transition and noise covariance over a step (Van Loan 1978), doubled from one shorter
        than every lag.
        """
        n = len(self.drift)
        doublings = max(0, math.ceil(math.log2(step_s * np.abs(self.drift).max())))
        block = np.block([[-self.drift, self.diffusion], [np.zeros((n, n)), self.drift.T]])
        block = expm(block * (step_s / 2**doublings))  # over many lags it would overflow
        transition = block[n:, n:].T
        covariance = transition @ block[:n, n:]
        for _ in range(doublings):
            covariance = covariance + transition @ covariance @ transition.T
            transition = transition @ transition
        return transition, covariance


# The fitted plant as a bench: previews a proposal with the real one-sided pump before anything is
# applied.
#
# Linear prediction ignores that the pump only adds gas, stalls and starts. Here the real loop
# drives a pump with the configured curve in front of the identified delay, lag, gain and leak, in
# the identified
# weather.

_SUBSTEPS = 4  # per tick: resolves a dead time to 2.5 ms at 50 Hz
_SETTLE_S, _START_S = 30.0, 10.0
_LEVEL_PA, _LEVEL_C = 101_325.0, 23.0  # arbitrary: only changes matter


class _Driven:
    """Way of the centre for the commands of a pump, through the identified delay and lag, with unit
    leak left out.
    """

    def __init__(
        self, model: loop_model.PlantModel, pump: PumpConfig, flow_um_per_s: float, dt_s: float
    ) -> None:
        self._model, self._pump = model, pump
        self._curve = pump_curve.branch(pump, pump.curve_um_per_s)
        self._step_s = dt_s / _SUBSTEPS
        self._tube = deque([flow_um_per_s] * (1 + round(model.dead_time_s / self._step_s)))
        self._arriving = flow_um_per_s
        self._running = True
        self.way_um = 0.0

    def step(self, pump_fraction: float) -> float:
        """Run one tick; return the way since the start, without the leak's."""
        pump = self._pump
        self._running = pump_fraction >= (
            pump.stall_fraction if self._running else pump.start_fraction
        )
        flow = self._curve.flow(pump_fraction) if self._running else 0.0
        follow = -math.expm1(-self._step_s / self._model.lag_s)
        for _ in range(_SUBSTEPS):
            self._tube.append(flow)
            self._arriving += (self._tube.popleft() - self._arriving) * follow
            self.way_um += self._model.gain * self._arriving * self._step_s
        return self.way_um


class ModelBench:
    """A simulated bench made from the identified models; equal seeds give equal weather.

    `leak_step` has the time in s and the size in µm/s of a step of the leak.
    """

    def __init__(
        self,
        model: loop_model.PlantModel,
        disturbance: DisturbanceModel,
        pump: PumpConfig,
        seed: int,
        leak_step: tuple[float, float] = (math.inf, 0.0),
    ) -> None:
        self._model, self._disturbance = model, disturbance
        self._leak_step = leak_step
        self._rng = np.random.default_rng(seed)
        self._dt_s = disturbance.rest.dt_s
        self._driven = _Driven(model, pump, model.holding_flow_um_per_s, self._dt_s)
        self._leaked_um = 0.0
        self._walks = Walks.of(disturbance)
        self._transition, kicks = self._walks.over(self._dt_s)
        sizes, ways = np.linalg.eigh(kicks)
        self._kicks = ways * np.sqrt(np.maximum(sizes, 0.0))
        self._weather = np.zeros(len(kicks))
        self._ticks = 0
        self.true_um: list[float] = []

    def exchange(self, pump_fraction: float, vent_fraction: float) -> BenchSample:
        """Run one tick. The vent is assumed as during the identification of the leak."""
        at_s, size = self._leak_step
        leak = self._model.leak_um_per_s + (size if self._ticks * self._dt_s >= at_s else 0.0)
        self._leaked_um += leak * self._dt_s
        self._driven.step(pump_fraction)
        self._weather = self._transition @ self._weather + self._kicks @ self._rng.standard_normal(
            self._weather.size
        )
        return self._read()

    def _read(self) -> BenchSample:
        of, walks = self._disturbance, self._walks
        true_um = self._driven.way_um - self._leaked_um + float(walks.centre @ self._weather)
        self.true_um.append(true_um)
        self._ticks += 1
        laser, pressure, temperature = self._rng.standard_normal(3).tolist()
        return BenchSample(
            true_um + of.laser_um * laser,
            _LEVEL_PA + float(walks.barometer @ self._weather) + of.barometer.noise * pressure
            if of.barometer
            else math.nan,
            _LEVEL_C + float(walks.air @ self._weather) + of.air.noise * temperature
            if of.air
            else math.nan,
        )


class _ReplayBench:
    """The readings of a record with the motion by its own pump
    replaced by that for other commands.
    """

    def __init__(
        self,
        record: loop_model.Record,
        off_um: loop_model.Series,
        model: loop_model.PlantModel,
        pump: PumpConfig,
    ) -> None:
        self.flow_um_per_s = float(record.part(0.0, _START_S).flow_um_per_s.mean())
        flows = np.append(self.flow_um_per_s, record.flow_um_per_s)
        own_um = (
            model.gain
            * loop_model.driven_um(flows, model.dead_time_s, model.lag_s, record.dt_s)[1:]
        )
        columns = (off_um - own_um, record.ambient_pressure_pa, record.air_temperature_c)
        self._rest = zip(*(column.tolist() for column in columns), strict=True)
        self._driven = _Driven(model, pump, self.flow_um_per_s, record.dt_s)

    def exchange(self, pump_fraction: float, vent_fraction: float) -> BenchSample:
        """Run one tick, with the vent as it was."""
        way_um = self._driven.step(pump_fraction)
        rest_um, ambient_pressure_pa, air_temperature_c = next(self._rest)
        return BenchSample(rest_um + way_um, ambient_pressure_pa, air_temperature_c)


def replayed_um(
    record: loop_model.Record,
    off_um: loop_model.Series,
    model: loop_model.PlantModel,
    loop: LoopConfig,
    pump: PumpConfig,
) -> loop_model.Series:
    """What would have been read, less the setpoint, (n - 1,), had another loop held the mirror.

    With the limits of pump and loop: weather that asks for less than no flow is as hard for it as
    for the one that held. `off_um` (n,) are the record's readings less its setpoint.
    """
    bench = _ReplayBench(record, off_um, model, pump)
    return (
        Rig(bench, loop, pump, bench.flow_um_per_s)
        .hold(record.duration_s - record.dt_s)
        .displacement_um
    )


@dataclass(frozen=True, slots=True)
class Preview:
    """Result on the fitted twin."""

    std_um: float  # of the true centre
    bias_um: float  # target minus true centre
    # After a step of the leak, weather off: furthest excursion, and time until the centre stays
    # within `RECOVERED_UM`
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
    """Hold on the fitted twin in its weather, and once more without
    weather for a step of the leak.
    """
    true_um = _held(loop, pump, model, ModelBench(model, disturbance, pump, seed), duration_s)
    noise = replace(
        disturbance.rest, white=disturbance.rest.white * 1e-3, fast=0.0, slow=0.0, coloured=()
    )
    calm = DisturbanceModel(noise, None, None)
    stepped = ModelBench(model, calm, pump, seed, (_SETTLE_S, load_step_um_per_s))
    answer_um = _held(loop, pump, model, stepped, 120.0)
    away = np.flatnonzero(np.abs(answer_um) > loop_model.RECOVERED_UM)
    return Preview(
        std_um=float(true_um.std()),
        bias_um=-float(true_um.mean()),
        load_peak_um=float(np.abs(answer_um).max()),
        recovery_s=float((away[-1] + 1) / loop.rate_hz) if away.size else 0.0,
    )


def _held(
    loop: LoopConfig,
    pump: PumpConfig,
    model: loop_model.PlantModel,
    bench: ModelBench,
    duration_s: float,
) -> loop_model.Series:
    """True centre after settling."""
    rig = Rig(bench, loop, pump, model.holding_flow_um_per_s)
    rig.hold(_SETTLE_S + duration_s)
    return np.array(bench.true_um)[round(_SETTLE_S * loop.rate_hz) :]
