"""The simulated bench: films, gas, pump, vent, leak, surroundings and sensors, advanced in fixed
steps.

Plain floats in a plain loop: a step is some 30 operations, which NumPy would make slower, and a
compiled kernel would add its start-up to every process for a plant that is already 1000 times
faster than real time. NumPy computes what does not depend on the state (surroundings, creep) for a
block of steps ahead.
"""

import math
from collections.abc import Sequence

import numpy as np

from firmware_iface.emulators.pump_board import BoardSample
from membrane_ctrl.config.schema import PumpConfig, TwinConfig
from membrane_ctrl.sim import film
from membrane_ctrl.sim.bench_events import BenchEvent
from membrane_ctrl.sim.climate import ClimateBlock, Room
from membrane_ctrl.sim.gas import GAS_FOLLOWS_AIR_S, REFERENCE_K, STANDARD_AMBIENT_PA, Gas, fill_gas
from membrane_ctrl.sim.pump_model import PumpModel
from membrane_ctrl.sim.sensors import Sensors
from membrane_ctrl.sim.surroundings import Disturbance
from membrane_ctrl.sim.truth import Truth

STEP_S = 0.005  # a thirtieth of the pump's lag, a fifteenth of its transport
ZERO_C_K = 273.15
# fully open at the nominal pressure (assumed): down by the whole sag within minutes
VENT_OPEN_UM_PER_S = 100.0
_BLOCK_STEPS = 2000

_NOMINAL_VOLUME = float(
    film.MIRROR_FILM.volume_m3_per_root_pa(film.SETTLED_S)
    + film.BACK_FILM.volume_m3_per_root_pa(film.SETTLED_S)
)
_NOMINAL_GAS = fill_gas(film.NOMINAL_PRESSURE_PA, REFERENCE_K, STANDARD_AMBIENT_PA, _NOMINAL_VOLUME)
NOMINAL_UM_PER_ML = (
    1e3
    * float(film.MIRROR_FILM.sag_mm_per_root_pa(film.SETTLED_S))
    * _NOMINAL_GAS.root_pa_per_ml(STANDARD_AMBIENT_PA, _NOMINAL_VOLUME)
)


def gas_compliance_ml_per_pa() -> float:
    """C = dV_gas/dp = V/(3p) + V/P of the nominal mirror, the basis of the leak's time constant."""
    volume_ml = 1e6 * _NOMINAL_VOLUME * _NOMINAL_GAS.root_pa
    return volume_ml / (3 * film.NOMINAL_PRESSURE_PA) + volume_ml / (
        STANDARD_AMBIENT_PA + film.NOMINAL_PRESSURE_PA
    )


class Plant:
    """The bench without its protocol; equal seeds and equal calls give equal samples.

    It starts inflated, `start_error_um` off its nominal sag, films settled for a day and the pump
    just holding; or flat and fresh, the pump off (`from_flat`). Commands hold until the next
    `actuate`. Truth does not depend on how often it is sampled, nor on how time is cut into calls
    of `advance`.

    Parameters
    ----------
    twin : TwinConfig
        Weather, climate, sensors, leak, start and seed.
    pump : PumpConfig
        The pump's curve; `flow_full_um_per_s` is that of the nominal mirror.
    events : sequence of BenchEvent
        What happens to the bench, in plant time.
    """

    def __init__(
        self, twin: TwinConfig, pump: PumpConfig, events: Sequence[BenchEvent] = ()
    ) -> None:
        # Weather and noise have random numbers of their own: one changes without the other.
        chance, noise = np.random.default_rng(twin.seed).spawn(2)
        self._sensors = Sensors(twin, noise)
        self._room = Room(twin)
        self._disturbance = Disturbance(twin, events, STEP_S, chance)

        # Leak and vent as conductances: the leak empties the mirror with its time constant, the
        # vent moves the nominal centre at its speed.
        self._leak_ml_per_s_per_pa = gas_compliance_ml_per_pa() / twin.leak_time_constant_s
        self._vent_ml_per_s_per_pa = (
            VENT_OPEN_UM_PER_S / NOMINAL_UM_PER_ML / film.NOMINAL_PRESSURE_PA
        )
        self._pump = PumpModel(pump, pump.flow_full_um_per_s / NOMINAL_UM_PER_ML, STEP_S, twin)

        # Time in steps, commands, and the first block of surroundings.
        self._loaded_s = film.SETTLED_S
        if twin.from_flat:
            self._loaded_s = 0.0
        self._steps = 0
        self._rest = 0.0
        self._pump_fraction = 0.0
        self._vent_fraction = 0.0
        self._inflow_ml_per_s = 0.0
        self._climate: ClimateBlock | None = None
        self._load_block()
        self._index = 0

        # From flat films without gas, or at the setpoint with the pump at the flow that holds it.
        if twin.from_flat:
            self._gas = Gas(0.0, self._air_k[0], 0.0)
            return
        gauge_pa = ((film.NOMINAL_SAG_MM + 1e-3 * twin.start_error_um) / self._sag[0]) ** 3
        self._gas = fill_gas(gauge_pa, self._air_k[0], self._ambient_pa[0], self._volume[0])
        self._inflow_ml_per_s = self._leak_ml_per_s_per_pa * self._leak[0] * gauge_pa
        self._pump_fraction = self._pump.settle_at_flow(self._inflow_ml_per_s)

    @property
    def time_s(self) -> float:
        """Plant time."""
        return self._steps * STEP_S

    def actuate(self, pump_fraction: float, vent_fraction: float) -> None:
        """Set the commands of pump and vent.

        Parameters
        ----------
        pump_fraction, vent_fraction : float
            From 0 to 1.

        Raises
        ------
        ValueError
            One is not.
        """
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
            self._run_steps(self._index + 1, self._index + 1 + now)
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
        # Depth by the pressure, and its change per amount of gas, by which flows become speeds.
        gas = self._gas
        ambient_pa = self._ambient_pa[i]
        gauge_pa = gas.gauge_pressure_pa
        sag_mm = self._sag[i] * gas.root_pa
        um_per_ml = 1e3 * self._sag[i] * gas.root_pa_per_ml(ambient_pa, self._volume[i])
        climate = {} if self._climate is None else self._climate.truth_at(i)
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
            **climate,
        )

    def _run_steps(self, start: int, stop: int) -> None:
        """Steps `start` to `stop` of the block.

        The gas is one state, the cube root of its gauge pressure. Leak and vent are laminar: their
        flow is in proportion to the pressure.
        """
        gas_step = self._gas.step
        gas = self._gas
        leak = self._leak_ml_per_s_per_pa
        vent = self._vent_ml_per_s_per_pa * self._vent_fraction
        follow = -math.expm1(-STEP_S / GAS_FOLLOWS_AIR_S)
        inflows = self._pump.run_steps(self._pump_fraction, stop - start)
        for i, inflow in enumerate(inflows, start):
            outflow = (leak * self._leak[i] + vent) * gas.root_pa**3
            gas_step(
                (inflow - outflow) * STEP_S,
                follow,
                self._ambient_pa[i],
                self._air_k[i],
                self._volume[i],
            )
        self._inflow_ml_per_s = inflows[-1]
        self._steps += stop - start
        self._index = stop - 1

    def _load_block(self) -> None:
        """Surroundings and creep of the next block, as lists: indexing them gives plain floats."""
        # Surroundings and the films' age at each step.
        block = self._disturbance.next_steps(_BLOCK_STEPS)
        age_s = self._loaded_s + block.time_s
        self._ambient_pa: list[float] = block.ambient_pa.tolist()
        self._air_k: list[float] = block.air_k.tolist()
        self._leak: list[float] = block.leak_factor.tolist()
        self._laser_bias_um: list[float] = block.laser_bias_um.tolist()
        self._laser_lost: list[float] = block.laser_lost.tolist()
        # Sag and volume of the films over the cube root of the pressure, as they creep.
        mirror_m3 = film.MIRROR_FILM.volume_m3_per_root_pa(age_s)
        back_m3 = film.BACK_FILM.volume_m3_per_root_pa(age_s)
        self._sag: list[float] = film.MIRROR_FILM.sag_mm_per_root_pa(age_s).tolist()
        self._back_sag: list[float] = film.BACK_FILM.sag_mm_per_root_pa(age_s).tolist()
        self._volume: list[float] = (mirror_m3 + back_m3).tolist()
        self._index = -1
        if self._room.is_steady:
            return

        # The room's climate: warmer air, and films whose strain scales sag and volume.
        time_s = np.asarray(block.time_s, dtype=np.float64)
        weather = self._room.make_block(time_s)
        self._climate = weather
        self._air_k = (block.air_k + weather.air_k).tolist()
        self._sag = (np.asarray(self._sag) * weather.mirror_factor).tolist()
        self._back_sag = (np.asarray(self._back_sag) * weather.back_factor).tolist()
        volume_m3 = mirror_m3 * weather.mirror_factor + back_m3 * weather.back_factor
        self._volume = volume_m3.tolist()
