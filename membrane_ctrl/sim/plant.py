"""The simulated bench: films, gas, pump, vent, leak, surroundings and sensors, advanced in fixed
steps.

Plain floats in a plain loop: a step is some 30 operations, which NumPy would make slower, and a
compiled kernel would add its start-up to every process for a plant that is already 1000 times
faster than real time. NumPy computes what does not depend on the state (surroundings, creep) for a
block of steps ahead.
"""

import math
import struct
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, fields

import numpy as np

from firmware_iface.emulators.pump_board import BoardSample
from membrane_ctrl.config.schema import PumpConfig, TwinConfig
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.sim import film
from membrane_ctrl.sim.surroundings import BenchEvent, Disturbance

# The true state, for the recording and the optics, never for the controller.


@dataclass(frozen=True, slots=True)
class Truth:
    """State of the simulated bench at one moment."""

    time_s: float  # plant time; on the run's clock once the bench process has published it
    # mirror centre from its nominal sag (600 Pa, settled), positive when the bowl deepens
    displacement_um: float
    sag_mm: float  # depth of the mirror film
    back_sag_mm: float  # depth of the other film
    gauge_pressure_pa: float
    ambient_pressure_pa: float
    air_temperature_c: float
    gas_temperature_c: float
    laser_bias_um: float  # error of the laser due to its mount
    laser_lost: float  # 1 while the laser receives no light
    leak_um_per_s: float  # speed at which the leak alone lowers the centre
    pump_um_per_s: float  # speed at which the pump's flow lifts it
    vent_um_per_s: float

    def pack(self) -> bytes:
        """The fields as doubles in their order."""
        return _STRUCT.pack(*astuple(self))

    @classmethod
    def unpack(cls, message: bytes) -> "Truth":
        """Inverse of `pack`. Raises struct.error on a message of another length."""
        return cls(*_STRUCT.unpack(message))


_STRUCT = struct.Struct(f"<{len(fields(Truth))}d")
TRUTH_BYTES = _STRUCT.size


GAUGE_NOISE_PA = 0.5  # a +-1 kPa differential sensor (assumed): 10 µm of centre, so a monitor only
LASER_GOOD = 0
LASER_NO_LIGHT = 1


class Sensors:
    """Laser, barometer, gauge and thermometers with independent noise in each sample."""

    def __init__(self, config: TwinConfig, rng: np.random.Generator) -> None:
        self._config = config
        self._rng = rng
        self._counter = 0

    def read(self, truth: Truth) -> BoardSample:
        """A new sample; the counter advances by one. Without light the displacement is NaN, its
        quality not 0.
        """
        config = self._config
        laser, gauge, ambient, air, gas = self._rng.standard_normal(5).tolist()
        lost = truth.laser_lost > 0 or not config.laser
        reading_um = truth.displacement_um + truth.laser_bias_um + config.laser_noise_um * laser
        self._counter += 1
        return BoardSample(
            displacement_um=float("nan")
            if lost
            else _quantised(reading_um, config.laser_resolution_um),
            displacement_quality=LASER_NO_LIGHT if lost else LASER_GOOD,
            gauge_pressure_pa=truth.gauge_pressure_pa + GAUGE_NOISE_PA * gauge,
            ambient_pressure_pa=truth.ambient_pressure_pa + config.barometer_noise_pa * ambient,
            air_temperature_c=truth.air_temperature_c + config.thermometer_noise_k * air,
            gas_temperature_c=truth.gas_temperature_c + config.thermometer_noise_k * gas,
            sample_counter=self._counter,
            device_time_s=truth.time_s,
        )


def _quantised(value: float, resolution: float) -> float:
    return round(value / resolution) * resolution if resolution > 0 else value


# The diaphragm pump: adds gas only, sticks at low commands, responds late.


_LEVELS = 4096  # of a tabulated curve: 12 bits


class PumpModel:
    """q = q_full (d - dead) / (1 - dead) once running; starts at `start_fraction`, stalls below
    `stall_fraction`.

    Or a curve through the configuration's points, or of `twin.pump_shape`; two branches give the
    flow play. Raises ValueError if the pump delivers nothing at any command.
    """

    def __init__(
        self,
        config: PumpConfig,
        flow_full_ml_per_s: float,
        step_s: float,
        twin: TwinConfig | None = None,
    ) -> None:
        if config.dead_fraction >= 1:
            raise ValueError(
                "pump.dead_fraction = 1: a pump that never delivers; it must be below 1"
            )
        twin = twin or TwinConfig()
        self._dead = config.dead_fraction
        self._start = config.start_fraction
        self._stall = config.stall_fraction
        self._ml_per_s_per_fraction = flow_full_ml_per_s / (1 - config.dead_fraction)
        self._branches = _branches(config, twin.pump_shape, flow_full_ml_per_s)
        self._play_ml_per_s = 0.0
        self._follow = -math.expm1(-step_s / twin.pump_lag_s)
        self._running = False
        self._flow_ml_per_s = 0.0
        self._tube = deque([0.0] * round(twin.pump_delay_s / step_s))

    def hold(self, flow_ml_per_s: float) -> float:
        """Settle at the command that delivers this flow, and return it.

        The pump stays off if the flow is too small to keep it running.
        """
        command = self._dead + flow_ml_per_s / self._ml_per_s_per_fraction
        if self._branches is not None:
            rising = self._branches[0]
            command = bisect_left(rising, flow_ml_per_s) / _LEVELS
        self._running = self._stall <= command <= 1
        self._flow_ml_per_s = self._play_ml_per_s = flow_ml_per_s if self._running else 0.0
        self._tube = deque([self._flow_ml_per_s] * len(self._tube))
        return command if self._running else 0.0

    def step(self, command: float) -> float:
        """One time step with the command 0..1; the flow that reaches the films in it, mL/s."""
        self._running = command >= (self._stall if self._running else self._start)
        if self._branches is None:
            delivers = self._running and command > self._dead
            target = self._ml_per_s_per_fraction * (command - self._dead) if delivers else 0.0
        else:
            rising, falling = self._branches
            level = round(command * _LEVELS)
            target = (
                min(max(self._play_ml_per_s, rising[level]), falling[level])
                if self._running
                else 0.0
            )
            self._play_ml_per_s = target
        self._flow_ml_per_s += (target - self._flow_ml_per_s) * self._follow
        self._tube.append(self._flow_ml_per_s)
        return self._tube.popleft()


_PLAY_FRACTION = 0.04  # of the hysteretic pump, either way
# Share of the full flow against the share of the command beyond `dead_fraction`
_SHAPES: dict[str, Callable[[FloatArray], FloatArray]] = {
    "quadratic": np.square,
    "root": np.sqrt,
    "s-shaped": lambda x: x**2 * (3 - 2 * x),
    "saturating": lambda x: np.minimum(x / 0.6, 1.0),
    "hysteretic": lambda x: x,
    "pwm": lambda x: np.floor(x * 255) / 255,
}


def _branches(
    config: PumpConfig, shape: str, full_ml_per_s: float
) -> tuple[list[float], list[float]] | None:
    """Flow in mL/s at each level of the command, rising and falling; None for the straight line."""
    command = np.arange(_LEVELS + 1) / _LEVELS
    if shape != "configured":
        play = _PLAY_FRACTION if shape == "hysteretic" else 0.0
        shares = [
            (command + shift - config.dead_fraction) / (1 - config.dead_fraction)
            for shift in (-play, play)
        ]
        rising, falling = (
            full_ml_per_s * _SHAPES[shape](np.clip(share, 0.0, 1.0)) for share in shares
        )
        falling[0] = 0.0
        return rising.tolist(), falling.tolist()
    if not config.curve_fraction:
        return None
    from scipy.interpolate import PchipInterpolator

    points = np.array(config.curve_fraction)
    scale = full_ml_per_s / config.flow_full_um_per_s
    within = np.clip(command, points[0], points[-1])
    rising, falling = (
        np.where(
            command < points[0], 0.0, scale * PchipInterpolator(points, np.array(flows))(within)
        )
        for flows in (config.curve_um_per_s, config.curve_falling_um_per_s or config.curve_um_per_s)
    )
    return rising.tolist(), falling.tolist()


STEP_S = 0.005  # a thirtieth of the pump's lag, a fifteenth of its transport
ZERO_C_K = 273.15
# fully open at the nominal pressure (assumed): down by the whole sag within minutes
VENT_OPEN_UM_PER_S = 100.0
_BLOCK_STEPS = 2000

_NOMINAL_VOLUME = float(
    film.MIRROR_FILM.volume_m3_per_root_pa(film.SETTLED_S)
    + film.BACK_FILM.volume_m3_per_root_pa(film.SETTLED_S)
)
_NOMINAL_GAS = film.filled(
    film.NOMINAL_PRESSURE_PA, film.REFERENCE_K, film.STANDARD_AMBIENT_PA, _NOMINAL_VOLUME
)
NOMINAL_UM_PER_ML = (
    1e3
    * float(film.MIRROR_FILM.sag_mm_per_root_pa(film.SETTLED_S))
    * _NOMINAL_GAS.root_pa_per_ml(film.STANDARD_AMBIENT_PA, _NOMINAL_VOLUME)
)


def gas_compliance_ml_per_pa() -> float:
    """C = dV_gas/dp = V/(3p) + V/P of the nominal mirror, the basis of the leak's time constant."""
    volume_ml = 1e6 * _NOMINAL_VOLUME * _NOMINAL_GAS.root_pa
    return volume_ml / (3 * film.NOMINAL_PRESSURE_PA) + volume_ml / (
        film.STANDARD_AMBIENT_PA + film.NOMINAL_PRESSURE_PA
    )


class Plant:
    """The bench without its protocol; equal seeds and equal calls give equal samples.

    It starts inflated, `start_error_um` off its nominal sag, films settled for a day and the pump
    just holding; or flat and fresh, the pump off (`from_flat`). Events are in plant time. Commands
    hold until the next `actuate`. Truth does not depend on how often it is sampled, nor on how time
    is cut into calls of `advance`.
    """

    def __init__(
        self, twin: TwinConfig, pump: PumpConfig, events: Sequence[BenchEvent] = ()
    ) -> None:
        chance, noise = np.random.default_rng(twin.seed).spawn(2)
        self._sensors = Sensors(twin, noise)
        self._disturbance = Disturbance(twin, events, STEP_S, chance)
        self._leak_ml_per_s_per_pa = gas_compliance_ml_per_pa() / twin.leak_time_constant_s
        self._vent_ml_per_s_per_pa = (
            VENT_OPEN_UM_PER_S / NOMINAL_UM_PER_ML / film.NOMINAL_PRESSURE_PA
        )
        self._pump = PumpModel(pump, pump.flow_full_um_per_s / NOMINAL_UM_PER_ML, STEP_S, twin)
        self._loaded_s = 0.0 if twin.from_flat else film.SETTLED_S
        self._steps = 0
        self._rest = 0.0
        self._pump_fraction = self._vent_fraction = self._inflow_ml_per_s = 0.0
        self._load_block()
        self._index = 0
        if twin.from_flat:
            self._gas = film.Gas(0.0, self._air_k[0], 0.0)
            return
        gauge_pa = ((film.NOMINAL_SAG_MM + 1e-3 * twin.start_error_um) / self._sag[0]) ** 3
        self._gas = film.filled(gauge_pa, self._air_k[0], self._ambient_pa[0], self._volume[0])
        self._inflow_ml_per_s = self._leak_ml_per_s_per_pa * self._leak[0] * gauge_pa
        self._pump_fraction = self._pump.hold(self._inflow_ml_per_s)

    @property
    def time_s(self) -> float:
        """Plant time."""
        return self._steps * STEP_S

    def actuate(self, pump_fraction: float, vent_fraction: float) -> None:
        """Set the commands. Raises ValueError unless both are 0..1."""
        if not (0 <= pump_fraction <= 1 and 0 <= vent_fraction <= 1):
            raise ValueError(
                f"pump {pump_fraction:g} and vent {vent_fraction:g} must be fractions 0..1"
            )
        self._pump_fraction = pump_fraction
        self._vent_fraction = vent_fraction

    def advance(self, duration_s: float) -> None:
        """Advance time in whole steps; the rest of a step is kept for the next call."""
        due = self._rest + duration_s / STEP_S
        steps = math.floor(due + 1e-6)  # 0.02 s is four steps despite binary rounding
        self._rest = due - steps
        while steps > 0:
            if self._index + 1 == _BLOCK_STEPS:
                self._load_block()
            now = min(steps, _BLOCK_STEPS - 1 - self._index)
            self._run(self._index + 1, self._index + 1 + now)
            steps -= now

    def sample(self) -> BoardSample:
        """A sample of the sensors now; each call has its own noise."""
        return self.sample_of(self.truth())

    def sample_of(self, truth: Truth) -> BoardSample:
        """A sample from a known truth."""
        return self._sensors.read(truth)

    def truth(self) -> Truth:
        """The true state."""
        i = self._index
        gas, ambient_pa = self._gas, self._ambient_pa[i]
        gauge_pa = gas.gauge_pressure_pa
        sag_mm = self._sag[i] * gas.root_pa
        um_per_ml = 1e3 * self._sag[i] * gas.root_pa_per_ml(ambient_pa, self._volume[i])
        return Truth(
            time_s=self.time_s,
            displacement_um=1e3 * (sag_mm - film.NOMINAL_SAG_MM),
            sag_mm=sag_mm,
            back_sag_mm=self._back_sag[i] * gas.root_pa,
            gauge_pressure_pa=gauge_pa,
            ambient_pressure_pa=ambient_pa,
            air_temperature_c=self._air_k[i] - ZERO_C_K,
            gas_temperature_c=gas.temperature_k - ZERO_C_K,
            laser_bias_um=self._laser_bias_um[i],
            laser_lost=self._laser_lost[i],
            leak_um_per_s=um_per_ml * self._leak_ml_per_s_per_pa * self._leak[i] * gauge_pa,
            pump_um_per_s=um_per_ml * self._inflow_ml_per_s,
            vent_um_per_s=um_per_ml * self._vent_ml_per_s_per_pa * self._vent_fraction * gauge_pa,
        )

    def _run(self, start: int, stop: int) -> None:
        """Steps `start` to `stop` of the block."""
        gas_step, gas, pump_step, pump = (
            self._gas.step,
            self._gas,
            self._pump.step,
            self._pump_fraction,
        )
        leak, vent = self._leak_ml_per_s_per_pa, self._vent_ml_per_s_per_pa * self._vent_fraction
        follow = -math.expm1(-STEP_S / film.GAS_FOLLOWS_AIR_S)
        inflow = self._inflow_ml_per_s
        for i in range(start, stop):
            inflow = pump_step(pump)
            outflow = (leak * self._leak[i] + vent) * gas.root_pa**3
            gas_step(
                (inflow - outflow) * STEP_S,
                follow,
                self._ambient_pa[i],
                self._air_k[i],
                self._volume[i],
            )
        self._inflow_ml_per_s = inflow
        self._steps += stop - start
        self._index = stop - 1

    def _load_block(self) -> None:
        """Surroundings and creep of the next block, as lists: indexing them gives plain floats."""
        block = self._disturbance.block(_BLOCK_STEPS)
        age_s = self._loaded_s + block.time_s
        self._ambient_pa: list[float] = block.ambient_pa.tolist()
        self._air_k: list[float] = block.air_k.tolist()
        self._leak: list[float] = block.leak_factor.tolist()
        self._laser_bias_um: list[float] = block.laser_bias_um.tolist()
        self._laser_lost: list[float] = block.laser_lost.tolist()
        self._sag: list[float] = film.MIRROR_FILM.sag_mm_per_root_pa(age_s).tolist()
        self._back_sag: list[float] = film.BACK_FILM.sag_mm_per_root_pa(age_s).tolist()
        volume = film.MIRROR_FILM.volume_m3_per_root_pa(
            age_s
        ) + film.BACK_FILM.volume_m3_per_root_pa(age_s)
        self._volume: list[float] = volume.tolist()
        self._index = -1
