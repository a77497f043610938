"""What the filter of the mirror's centre takes and gives; the gas between pump and mirror; the
optics' stand.
"""

import math
from collections import deque
from dataclasses import dataclass, field
from enum import IntEnum
from itertools import islice

from membrane_ctrl.config.control import EstimatorConfig
from membrane_ctrl.control.filters import LowPass, smoothing
from membrane_ctrl.model.state_tree import StateNode


class Sensor(IntEnum):
    """What sees the centre, or what moves it."""

    LASER = 0
    OPTICS = 1
    BAROMETER = 2
    THERMOMETER = 3


# How long after its last accepted reading a sensor still counts as seeing the mirror, at most.
FRESH_S = {Sensor.LASER: 0.5, Sensor.OPTICS: 5.0, Sensor.BAROMETER: 5.0, Sensor.THERMOMETER: 5.0}


@dataclass(frozen=True, slots=True)
class CentreReadings:
    """Readings of one tick; NaN for missing ones."""

    now_s: float
    flow_um_per_s: float  # commanded since the last tick
    laser_um: float
    ambient_pressure_pa: float
    air_temperature_c: float
    sag_um: float = math.nan
    sag_sigma_um: float = math.nan
    sag_time_s: float = math.nan
    # a third witness will tell whether a jump of the laser was its mount's or the film's
    judged: bool = True


@dataclass(frozen=True, slots=True)
class SensorView(StateNode):
    """One sensor's part in the estimate."""

    fresh: bool  # the estimate follows it
    innovation: (
        float  # last reading minus expectation, in standard deviations; NaN before the first
    )
    share: float  # of the corrections of the centre, 0..1


@dataclass(frozen=True, slots=True)
class CentreEstimate(StateNode):
    """The centre in µm, as the laser would read it without noise.

    Attributes
    ----------
    µm, sigma_um : float
        Centre plus mount, and the standard deviation of the centre.
    mount_um : float
        Displacement of the laser's mount: the true centre is `um - mount_um`.
    ahead_um : float
        Where the gas in transit takes it, if the pump from now on balances `drift_um_per_s`.
    due_um_per_s : float
        Flow at the end of the dead time, less `drift_um_per_s`.
    leak_um_per_s, drift_um_per_s : float
        Loss of gas, and that less the lift of the warming gas.
    sensors : tuple of SensorView
        By `Sensor`.
    jumped, jumped_sensors : tuple
        Sensors whose readings have jumped in this tick, in words and as such.
    """

    um: float
    sigma_um: float
    mount_um: float
    ahead_um: float
    due_um_per_s: float
    leak_um_per_s: float
    drift_um_per_s: float
    sensors: tuple[SensorView, ...]
    jumped: tuple[str, ...] = ()
    jumped_sensors: tuple[Sensor, ...] = ()

    def telemetry(self) -> dict[str, float]:
        """What a telemetry row says of it."""
        told = {
            f"{sensor.name.lower()}_innovation": view.innovation
            for sensor, view in zip(Sensor, self.sensors, strict=True)
            if view.fresh
        }
        return {
            "estimate_sigma_um": self.sigma_um,
            "optics_share": self.sensors[Sensor.OPTICS].share,
            **told,
        }


@dataclass(slots=True)
class StandGrowthState(StateNode):
    """Temperatures of the stand: the present one, and at the lock."""

    stand_c: LowPass = field(default_factory=LowPass)
    locked_c: float = math.nan


class StandGrowth:
    """The sag that the optics see too much because their stand has become warmer since the lock.

    Nothing on the bench sees it: laser and optics differ by the laser's mount, too, and a gauge's
    zero drifts more. What is known of it comes from the air's temperature, which the stand follows
    late.
    """

    def __init__(self, config: EstimatorConfig, memory: StandGrowthState | None = None) -> None:
        self._um_per_k, self._sigma_um_per_k = config.stand_um_per_k, config.stand_sigma_um_per_k
        self._follows_air_s = config.stand_follows_air_s
        self.memory = memory or StandGrowthState()

    def lock(self) -> None:
        """From now on the present temperature is that of the reference."""
        self.memory.locked_c = self.memory.stand_c.value

    def step(self, air_c: float, dt_s: float) -> None:
        """Follow the air's temperature; NaN without a good reading."""
        if math.isfinite(air_c):
            self.memory.stand_c.update(air_c, dt_s, self._follows_air_s)
            if math.isnan(self.memory.locked_c):
                self.lock()

    @property
    def warmed_k(self) -> float:
        """By how much the stand is warmer than at the lock; 0 if unknown."""
        locked_c = self.memory.locked_c
        return 0.0 if math.isnan(locked_c) else self.memory.stand_c.value - locked_c

    @property
    def um(self) -> float:
        """What the sag shows too much."""
        return self._um_per_k * self.warmed_k

    @property
    def sigma_um(self) -> float:
        """Standard deviation of that."""
        return self._sigma_um_per_k * abs(self.warmed_k)


@dataclass(slots=True)
class TransitState(StateNode):
    """The gas on its way."""

    flows: deque[float] = field(default_factory=deque)  # of the last ticks, newest first
    arriving: float = 0.0


class Transit:
    """Gas between pump and mirror: a dead time, then a lag, in ticks of `period_s`."""

    def __init__(
        self, delay_s: float, lag_s: float, period_s: float, memory: TransitState | None = None
    ) -> None:
        self._ticks = int(delay_s / period_s + 1e-9)
        self._rest = max(0.0, delay_s / period_s - self._ticks)
        self._delay_s, self._lag_s, self._period_s = delay_s, lag_s, period_s
        self.memory = memory or TransitState()
        if not self.memory.flows:
            self.memory.flows.extend([0.0] * (self._ticks + 2))

    def place(self, flow_um_per_s: float) -> None:
        """Everything flows at this rate."""
        for place in range(len(self.memory.flows)):
            self.memory.flows[place] = flow_um_per_s
        self.memory.arriving = flow_um_per_s

    def advance(self, flow_um_per_s: float, dt_s: float) -> float:
        """Pump at a rate for a step; returns the rise of the centre in it, µm."""
        memory = self.memory
        for _ in range(max(1, round(dt_s / self._period_s))):
            memory.flows.appendleft(flow_um_per_s)
            memory.flows.pop()
        late = (1 - self._rest) * memory.flows[self._ticks] + self._rest * memory.flows[
            self._ticks + 1
        ]
        moved = smoothing(dt_s, self._lag_s) * (late - memory.arriving)
        memory.arriving += moved
        return late * dt_s - self._lag_s * moved

    def coming_um(self, drift_um_per_s: float) -> float:
        """Rise still to come, if from now on the pump gives the drift."""
        flows = self.memory.flows
        pending = self._period_s * (
            sum(islice(flows, self._ticks)) + self._rest * flows[self._ticks]
        )
        return (
            pending
            - drift_um_per_s * self._delay_s
            + self._lag_s * (self.memory.arriving - drift_um_per_s)
        )

    def due_um_per_s(self) -> float:
        """Flow at the end of the dead time: what the pump now receives comes on top of it."""
        flow = self.memory.arriving
        for late in range(self._ticks, -1, -1):
            step_s = self._period_s * (self._rest if late == self._ticks else 1.0)
            flow += smoothing(step_s, self._lag_s) * (self.memory.flows[late] - flow)
        return flow
