"""Sensor fusion: one estimate of the mirror's centre, by a Kalman filter with delayed readings.

Pure. docs/explanation/estimator.md derives it.

    centre  c = z + g_p p + g_T T_gas           z: the gas in the mirror, as height of the centre
            + g_p e_p (p - p_0) + g_T e_T (T_gas - T_0)
    dz/dt   = q - leak                          q: the pump's flow, after dead time and lag
    dT_gas/dt = (T_air - T_gas) / T_g
    laser   = c + mount      optics = c - zero       barometer = p      thermometer = T_air

z, leak, p, T_air and mount are random walks; e_p and e_T, the shares by which the configured gains
are wrong, forget within hours; `zero` is by how much the optics' zero differs from the laser's at
lock. p_0 and T_0 follow p and T_gas slowly, so that a changed e does not move the centre by the
weather of hours ago. A frame shows the centre of some time ago: the centre at each of the last
ticks is a state of its own (a clone), so a late reading is exact, whenever it comes.
"""

import math
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from pydantic import Field

from membrane_ctrl.config.control import EstimatorConfig, LoopConfig
from membrane_ctrl.control import gas_transit
from membrane_ctrl.control.centre_estimate import (
    CentreEstimate,
    CentreReadings,
    Sensor,
    SensorView,
)
from membrane_ctrl.control.filters import lag_step_fraction
from membrane_ctrl.control.gas_transit import Transit
from membrane_ctrl.control.innovation_ramp import InnovationRamp
from membrane_ctrl.control.leak_walk import LeakWalk
from membrane_ctrl.control.noise_learning import LearnedFactor, ReadingNoise, configured_walk
from membrane_ctrl.control.weather_limits import discard_impossible_weather
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.state_tree import ArrayShape, Count, StateNode

_GAS, _LEAK, _AMBIENT, _AIR, _WARMTH, _MOUNT, _OPTICS_ZERO, _PRESSURE_ERROR, _WARMTH_ERROR = range(
    9
)
_PLANT = 9  # states before the clones
CLONES = 64  # 1.3 s at 50 Hz
_CLONE_S = 0.02  # least time between clones
# Share by which the effect of pressure and temperature may differ from the configured gains, 1
# sigma, and the time in which it may change
_GAIN_ERROR = 0.2
_GAIN_MEMORY_S = 86_400.0
_GAINS_FROM_S = 30.0  # after the start, they are learned
# The pressure and temperature from which the gains' errors count follow within this time
_WEATHER_MEMORY_S = 100.0
# squared sigmas: weighed less beyond the first, dropped beyond the second
_HUBER2 = 9.0
_FAR2 = 25.0
_FAR_COUNT = 3
LOCK_FRAMES = 5  # from then on the optics alone could hold the mirror
# The optics' zero is locked once its standard deviation, by the laser's mean, is this small, or so
# long after the first frame
_LOCK_SIGMA_UM = 0.03
_LOCK_MOST_S = 60.0
# How long after its last accepted reading a sensor still counts as seeing the mirror, at most.
FRESH_S = {Sensor.LASER: 0.5, Sensor.OPTICS: 5.0, Sensor.BAROMETER: 5.0, Sensor.THERMOMETER: 5.0}
_FRAMES_LOST = 3  # after this many missing frames the optics are gone
_INTERVAL_SHARE = 0.2  # of a new interval in their mean
_IMPOSSIBLE = 1e4  # µm, Pa or K: no film, weather or mount moves that far in a hold
_UNKNOWN_UM2 = 1e6  # variance of the optics' zero before lock
# at the start
_LEAK_STD_UM_PER_S = 0.3
_WARMTH_STD_K = 0.02
_AMBIENT_STD_PA = 1.0
_SHARE_S = 2.0  # memory of the sensors' weights
# Of a leak's ramp in laser or optics, in standard deviations: seldom by chance where the noise is
# large
_RUN = 10.0, 8.0
# a jump that the optics see and the laser's noise hides is the film's, most likely
_OPTICS_JUMP_SHARE = 0.3
# Swings of the film behind a door stay below this; if laser and optics are further apart, the gauge
# decides (shape.disagreement_max_um)
_SWING_MOST_UM = 10.0
# a reading's expectation is a sum of states: one of them, as a row
_ONE: FloatArray = np.eye(_PLANT + CLONES)
_STATES = _PLANT + CLONES


@dataclass(slots=True)
class SensorWatch(StateNode):
    """State of one sensor in the filter."""

    seen_s: float = -math.inf  # arrival of the last accepted reading
    taken_s: float = -math.inf  # when it was taken
    innovation: float = math.nan
    pull: float = 0.0  # recent sum of gains on the centre
    far: Count = 0  # readings in a row beyond the outer limit
    far_since_s: float = math.nan


@dataclass(slots=True)
class CentreOrigin(StateNode):
    """The first values, less which the filter takes the later ones: numbers stay small."""

    ambient_pressure_pa: float = math.nan
    air_temperature_c: float = math.nan
    sag_um: float = math.nan
    # Slow means of the states, from which the errors of the gains count
    mean_pressure_pa: float = 0.0
    mean_warmth_k: float = 0.0
    # The gains of the states, µm/Pa and µm/K
    pressure_gain: float = math.nan
    warmth_gain: float = math.nan


@dataclass(slots=True)
class CentreState(StateNode):
    """The filter's memory: the states, their covariance, and what was learned of the noise."""

    x: Annotated[FloatArray, ArrayShape((_STATES,))] = field(
        default_factory=lambda: np.zeros(_STATES)
    )
    p: Annotated[FloatArray, ArrayShape((_STATES, _STATES))] = field(
        default_factory=lambda: np.zeros((_STATES, _STATES))
    )
    # when each clone was made
    times: Annotated[FloatArray, ArrayShape((CLONES,))] = field(
        default_factory=lambda: np.full(CLONES, -np.inf)
    )
    count: Count = 0  # ticks
    origin: CentreOrigin = field(default_factory=CentreOrigin)
    # by sensor
    watches: Annotated[list[SensorWatch], Field(min_length=len(Sensor), max_length=len(Sensor))] = (
        field(default_factory=lambda: [SensorWatch() for _ in Sensor])
    )
    noises: Annotated[list[ReadingNoise], Field(min_length=len(Sensor), max_length=len(Sensor))] = (
        field(
            default_factory=lambda: [
                ReadingNoise.of_reading(stated=sensor == Sensor.OPTICS) for sensor in Sensor
            ]
        )
    )
    # of centre, pressure, air, and the laser's mount
    walks: Annotated[list[LearnedFactor], Field(min_length=4, max_length=4)] = field(
        default_factory=lambda: [configured_walk() for _ in range(4)]
    )
    leak_walk: LeakWalk = field(default_factory=LeakWalk)
    # of laser and optics
    ramps: Annotated[list[InnovationRamp], Field(min_length=len(_RUN), max_length=len(_RUN))] = (
        field(default_factory=lambda: [InnovationRamp() for _ in _RUN])
    )
    transit: gas_transit.TransitState = field(default_factory=gas_transit.TransitState)
    frames: Count = 0  # of the optics since they began to be used
    first_frame_s: float = math.nan
    locked: bool = False  # the optics' zero is known
    frame_interval_s: float = FRESH_S[Sensor.OPTICS]
    last_frame_s: float = -math.inf


class CentreFilter:
    """Estimates the centre; `start` it, then call `step` on every tick."""

    def __init__(
        self, config: EstimatorConfig, loop: LoopConfig, memory: CentreState | None = None
    ) -> None:
        self._config = config
        self._rate_hz = loop.rate_hz
        self._take_gains(loop)
        self._every = max(1, round(_CLONE_S * loop.rate_hz))
        self.memory = memory or CentreState()
        self._transit = self._make_transit()
        self._judged = True
        self._jumped: list[str] = []
        self._jumped_sensors: list[Sensor] = []

    def _make_transit(self) -> Transit:
        config = self._config
        return Transit(
            config.pump_delay_s, config.pump_lag_s, 1 / self._rate_hz, self.memory.transit
        )

    @property
    def frames(self) -> int:
        """Frames of the optics since they began to be used."""
        return self.memory.frames

    def set_gains(self, loop: LoopConfig) -> None:
        """Set how pressure and temperature of the air move the centre.

        Parameters
        ----------
        loop : LoopConfig
            Gains in µm/Pa and µm/K, the lag of the gas behind the air, and which sensors are used.
        """
        x, p, origin = self.memory.x, self.memory.p, self.memory.origin
        centre_um = self._compute_centre_um()
        self._take_gains(loop)
        gains = self._pressure_gain, self._warmth_gain
        if gains == (origin.pressure_gain, origin.warmth_gain) or math.isnan(origin.pressure_gain):
            return
        # Other gains: their errors are unknown again, and the centre stays
        origin.pressure_gain, origin.warmth_gain = gains
        for error in (_PRESSURE_ERROR, _WARMTH_ERROR):
            x[error] = 0.0
            p[error] = p[:, error] = 0.0
            p[error, error] = _GAIN_ERROR**2
        x[_GAS] += centre_um - self._compute_centre_um()

    def _take_gains(self, loop: LoopConfig) -> None:
        self._pressure_gain = loop.barometer_gain_um_per_pa
        self._warmth_gain = loop.temperature_gain_um_per_k
        self._gas_follows_air_s = loop.gas_follows_air_s
        self._uses = (loop.feedforward_barometer, loop.feedforward_temperature)

    def start(
        self,
        displacement_um: float,
        flow_um_per_s: float,
        mount_um: float,
        sag_zero_um: float = math.nan,
    ) -> None:
        """Begin at a displacement, a flow that balances the leak, and a known mount.

        Parameters
        ----------
        displacement_um : float
            The laser's reading.
        flow_um_per_s : float
            Mean flow of the pump, the first value of the leak.
        mount_um : float
            Known displacement of the laser's mount.
        sag_zero_um : float
            The sag at displacement 0, of a bench without a laser; NaN: the first frames lock it.
        """
        config, memory = self._config, self.memory
        memory.start_afresh()
        # The states, and how little is known of each.
        memory.x[_GAS] = displacement_um - mount_um
        memory.x[_LEAK] = flow_um_per_s
        memory.x[_MOUNT] = mount_um
        variances = (
            config.laser_noise_um**2,
            _LEAK_STD_UM_PER_S**2,
            _AMBIENT_STD_PA**2,
            _WARMTH_STD_K**2,
            _WARMTH_STD_K**2,
            0.0,
            _UNKNOWN_UM2,
            _GAIN_ERROR**2,
            _GAIN_ERROR**2,
        )
        memory.origin.pressure_gain = self._pressure_gain
        memory.origin.warmth_gain = self._warmth_gain
        for i, variance in enumerate(variances):
            memory.p[i, i] = variance
        # The pump has given this flow for long; a known zero of the optics locks them at once.
        self._transit = self._make_transit()
        self._transit.place(flow_um_per_s)
        if math.isfinite(sag_zero_um):
            memory.origin.sag_um = sag_zero_um
            memory.p[_OPTICS_ZERO, _OPTICS_ZERO] = 0.0
            memory.frames = LOCK_FRAMES
            memory.locked = True

    def relock(self) -> None:
        """Take the optics' next readings as a new zero."""
        memory = self.memory
        memory.p[_OPTICS_ZERO] = memory.p[:, _OPTICS_ZERO] = 0.0
        memory.p[_OPTICS_ZERO, _OPTICS_ZERO] = _UNKNOWN_UM2
        memory.x[_OPTICS_ZERO] = 0.0
        memory.origin.sag_um = math.nan
        memory.frames = 0
        memory.locked = False
        memory.watches[Sensor.OPTICS] = SensorWatch()

    def undo_optics_jump(self, mount_um: float) -> None:
        """Undo what wrong optics did to the mount, and lock them again.

        What the mount has moved from `mount_um` was the centre's motion: it is added to the gas and
        to all clones of the centre.
        """
        x = self.memory.x
        x += (x[_MOUNT] - mount_um) * (_ONE[_GAS] + self._centre_since(-math.inf) - _ONE[_MOUNT])
        self.relock()

    def step(self, given: CentreReadings, dt_s: float) -> CentreEstimate:
        """Run one tick: predict, then use each reading that is new.

        Parameters
        ----------
        given : CentreReadings
            Readings of the tick; NaN for what was not read.
        dt_s : float
            Time since the last tick, above 0.

        Returns
        -------
        CentreEstimate
        """
        self._jumped = []
        self._jumped_sensors = []
        self._judged = given.judged
        self._predict_states(given, dt_s)
        self._clone_centre(given.now_s)
        # The sensors' weights fade
        for watch in self.memory.watches:
            watch.pull *= math.exp(-dt_s / _SHARE_S)
        # Weather first, as changes since the first values; then a late frame; the laser last
        pressure_pa, air_c = discard_impossible_weather(
            given.ambient_pressure_pa, given.air_temperature_c
        )
        config, origin = self._config, self.memory.origin
        uses_pressure, uses_air = self._uses
        if uses_pressure and math.isfinite(pressure_pa):
            if math.isnan(origin.ambient_pressure_pa):
                origin.ambient_pressure_pa = pressure_pa
            change_pa = pressure_pa - origin.ambient_pressure_pa
            variance = config.barometer_noise_pa**2
            self._use_reading(Sensor.BAROMETER, _ONE[_AMBIENT], change_pa, variance, given.now_s)
        if uses_air and math.isfinite(air_c):
            if math.isnan(origin.air_temperature_c):
                origin.air_temperature_c = air_c
            change_k = air_c - origin.air_temperature_c
            variance = config.thermometer_noise_k**2
            self._use_reading(Sensor.THERMOMETER, _ONE[_AIR], change_k, variance, given.now_s)
        if math.isfinite(given.sag_um) and 0.0 <= given.sag_change_sigma_um < _IMPOSSIBLE:
            self._use_frame(given)
        if math.isfinite(given.laser_um):
            row = self._find_centre_row(given.now_s) + _ONE[_MOUNT]
            expected_um = self._compute_centre_um() + float(self.memory.x[_MOUNT])
            # The expectation is not linear in the errors of the gains
            change_um = given.laser_um - expected_um + float(row @ self.memory.x)
            self._use_reading(Sensor.LASER, row, change_um, config.laser_noise_um**2, given.now_s)
        return self._make_estimate(given.now_s)

    def _predict_states(self, given: CentreReadings, dt_s: float) -> None:
        """Advance states and covariance by one tick: x <- F x, p <- F p F^T + Q."""
        x, p, config = self.memory.x, self.memory.p, self._config
        # States: the arriving flow less the leak moves the gas; the gas follows the air
        follow = lag_step_fraction(dt_s, self._gas_follows_air_s)
        x[_GAS] += self._transit.advance(given.flow_um_per_s, dt_s) - x[_LEAK] * dt_s
        x[_WARMTH] += follow * (x[_AIR] - x[_WARMTH])
        # The means move; the gas takes what the gains' errors then no longer contribute
        origin, slowly = self.memory.origin, lag_step_fraction(dt_s, _WEATHER_MEMORY_S)
        pressure_step_pa = float(x[_AMBIENT]) - origin.mean_pressure_pa
        warmth_step_k = float(x[_WARMTH]) - origin.mean_warmth_k
        learns_pressure = self._learns_gain(Sensor.BAROMETER, given.now_s)
        learns_warmth = self._learns_gain(Sensor.THERMOMETER, given.now_s)
        # A gain that is not learned counts from the present weather
        if learns_pressure:
            pressure_step_pa *= slowly
        if learns_warmth:
            warmth_step_k *= slowly
        origin.mean_pressure_pa += pressure_step_pa
        origin.mean_warmth_k += warmth_step_k
        by_pressure_um = self._pressure_gain * pressure_step_pa
        by_warmth_um = self._warmth_gain * warmth_step_k
        x[_GAS] += by_pressure_um * x[_PRESSURE_ERROR] + by_warmth_um * x[_WARMTH_ERROR]
        # The errors of the gains forget
        kept = 1.0 - lag_step_fraction(dt_s, _GAIN_MEMORY_S)
        x[_PRESSURE_ERROR] *= kept
        x[_WARMTH_ERROR] *= kept
        # F p F^T: the same row operations on p and on its transpose (a view)
        for matrix in (p, p.T):
            matrix[_GAS] -= dt_s * matrix[_LEAK]
            if learns_pressure:
                matrix[_GAS] += by_pressure_um * matrix[_PRESSURE_ERROR]
            if learns_warmth:
                matrix[_GAS] += by_warmth_um * matrix[_WARMTH_ERROR]
            matrix[_WARMTH] += follow * (matrix[_AIR] - matrix[_WARMTH])
            matrix[_PRESSURE_ERROR] *= kept
            matrix[_WARMTH_ERROR] *= kept
        # Q: the random walks
        p[_GAS, _GAS] += dt_s * self._centre_walk()
        leak_walk = config.leak_walk_um_per_s_per_root_s**2
        self.memory.leak_walk.predict(dt_s, self._centre_walk(), leak_walk)
        p[_LEAK, _LEAK] += dt_s * self.memory.leak_walk.factor * leak_walk
        for error in (_PRESSURE_ERROR, _WARMTH_ERROR):
            p[error, error] += (1.0 - kept**2) * _GAIN_ERROR**2
        p[_AMBIENT, _AMBIENT] += dt_s * self._pressure_walk()
        p[_AIR, _AIR] += dt_s * self._air_walk()
        # Without optics no reading distinguishes mount from film, and a learned drift of the mount
        # would let the film drift
        drifts = self.memory.walks[3].factor if self._is_fresh(Sensor.OPTICS, given.now_s) else 1.0
        p[_MOUNT, _MOUNT] += dt_s * drifts * config.mount_walk_um_per_root_s**2

    def _clone_centre(self, now_s: float) -> None:
        """Remember the centre of this tick in the oldest clone."""
        memory = self.memory
        memory.count += 1
        if memory.count % self._every:
            return
        slot = memory.count // self._every % CLONES
        memory.times[slot] = now_s
        # Its row and column of the covariance are those of the centre
        slot += _PLANT
        row = self._find_centre_row(now_s)
        memory.p[slot] = memory.p[:, slot] = row @ memory.p
        memory.p[slot, slot] = row @ memory.p[slot]
        memory.x[slot] = self._compute_centre_um()

    def _compute_centre_um(self) -> float:
        """Compute the centre from the states: the first two lines of the module's equations."""
        x, origin = self.memory.x, self.memory.origin
        by_error_um = self._pressure_gain * x[_PRESSURE_ERROR] * (
            x[_AMBIENT] - origin.mean_pressure_pa
        ) + self._warmth_gain * x[_WARMTH_ERROR] * (x[_WARMTH] - origin.mean_warmth_k)
        weather_um = self._pressure_gain * x[_AMBIENT] + self._warmth_gain * x[_WARMTH]
        return float(x[_GAS] + weather_um + by_error_um)

    def _find_centre_row(self, now_s: float) -> FloatArray:
        """Return the centre's derivative by the states, (73,).

        Without its sensor the weather is estimated from the centre, and shows nothing of its gain.
        """
        x, origin = self.memory.x, self.memory.origin
        # dc/dz = 1, dc/dp = g_p (1 + e_p), dc/dT_gas = g_T (1 + e_T)
        row: FloatArray = np.zeros(_STATES)
        row[_GAS] = 1.0
        row[_AMBIENT] = self._pressure_gain * (1.0 + x[_PRESSURE_ERROR])
        row[_WARMTH] = self._warmth_gain * (1.0 + x[_WARMTH_ERROR])
        # dc/de_p = g_p (p - p_0), dc/de_T = g_T (T_gas - T_0): only weather that changes shows them
        if self._learns_gain(Sensor.BAROMETER, now_s):
            row[_PRESSURE_ERROR] = self._pressure_gain * (x[_AMBIENT] - origin.mean_pressure_pa)
        if self._learns_gain(Sensor.THERMOMETER, now_s):
            row[_WARMTH_ERROR] = self._warmth_gain * (x[_WARMTH] - origin.mean_warmth_k)
        return row

    def _use_frame(self, given: CentreReadings) -> None:
        """Use a figure's sag: a reading of the centre at the time at which the frame was taken."""
        memory = self.memory
        times, time_s = memory.times, given.sag_time_s
        # The clones just before and just after that time
        before = np.where(times <= time_s, times, -np.inf)
        after = np.where(times > time_s, times, np.inf)
        early, late = int(before.argmax()), int(after.argmin())
        if not math.isfinite(before[early]) or time_s > given.now_s:
            return  # older than the memory, or from the future
        # Its expectation: the centre then, linear between the two, less the optics' zero
        row = _ONE[_PLANT + early] - _ONE[_OPTICS_ZERO]
        if math.isfinite(after[late]):
            share = float((time_s - times[early]) / (times[late] - times[early]))
            row += share * (_ONE[_PLANT + late] - _ONE[_PLANT + early])
        # The stated noise of the change of sag, and what no covariance contains: motions of the air
        variance = given.sag_change_sigma_um**2 + self._config.optics_noise_um**2
        if math.isnan(memory.origin.sag_um):
            memory.origin.sag_um = given.sag_um
        change_um = given.sag_um - memory.origin.sag_um
        self._use_reading(Sensor.OPTICS, row, change_um, variance, given.now_s, time_s)
        # The mean interval of frames decides when the optics count as lost
        if (interval_s := time_s - memory.last_frame_s) > 0:
            longer_s = min(interval_s, FRESH_S[Sensor.OPTICS]) - memory.frame_interval_s
            memory.frame_interval_s += _INTERVAL_SHARE * longer_s
        memory.last_frame_s = time_s
        # The zero of the optics is locked once it is known well, or cannot become better known
        if not memory.frames:
            memory.first_frame_s = given.now_s
        memory.frames += 1
        zero_sigma_um = math.sqrt(max(0.0, float(memory.p[_OPTICS_ZERO, _OPTICS_ZERO])))
        waited = given.now_s - memory.first_frame_s > _LOCK_MOST_S
        if (
            not memory.locked
            and memory.frames >= LOCK_FRAMES
            and (waited or zero_sigma_um < _LOCK_SIGMA_UM)
        ):
            self._lock_figure()

    def _lock_figure(self) -> None:
        """Make the mean figure so far the one to hold: its uncertainty becomes the laser's.

        The mean of the laser since the start has related the figure to displacement 0. From now on
        the laser's mount may drift, and the figure does not follow it. A change of coordinates:
        with e the error of `zero`, the centre becomes c - e, the mount's displacement mount + e.
        """
        self.memory.locked = True
        for matrix in (self.memory.p, self.memory.p.T):
            matrix[_GAS] -= matrix[_OPTICS_ZERO]
            matrix[_MOUNT] += matrix[_OPTICS_ZERO]
            matrix[_PLANT:] -= matrix[_OPTICS_ZERO]
            matrix[_OPTICS_ZERO] = 0.0

    def _use_reading(
        self,
        sensor: Sensor,
        row: FloatArray,
        value: float,
        variance: float,
        now_s: float,
        taken_s: float = math.nan,
    ) -> None:
        """Use one reading, weighted by how well it fits.

        Parameters
        ----------
        sensor : Sensor
        row : (73,)
            The reading's expectation is this row times the states.
        value, variance : float
            The reading, in its own unit, and the variance stated for it.
        now_s, taken_s : float
            Time of the tick, and when the reading was taken if that was earlier.
        """
        taken_s = now_s if math.isnan(taken_s) else taken_s
        memory = self.memory
        watch, x, p = memory.watches[sensor], memory.x, memory.p
        # The innovation y - h x, in units of its own standard deviation sqrt(h P h^T + r)
        variance *= memory.noises[sensor].factor
        innovation = float(value - row @ x)
        if abs(innovation) > _IMPOSSIBLE:
            return
        ph, spread = self._project_covariance(row, variance)
        squared = innovation**2 / spread
        watch.innovation = innovation / math.sqrt(spread)
        # A run of innovations to one side is a change of the leak; the laser shows one only without
        # optics, as its mount drifts
        leads = sensor != Sensor.LASER or not self._is_fresh(Sensor.OPTICS, now_s)
        ramp = memory.ramps[sensor] if leads and sensor <= Sensor.OPTICS else None
        runs = ramp is not None and ramp.update(watch.innovation, taken_s, _RUN[sensor])
        # A reading far off waits for more of its kind; if they come, the sensor has jumped
        if self._is_doubtful(sensor, squared, taken_s, now_s) and not runs:
            return
        if watch.far >= _FAR_COUNT:
            self._open_jump(sensor, innovation, now_s)
        elif not watch.far:
            self._learn_noise(
                sensor, 1 - variance / spread, min(now_s - watch.seen_s, FRESH_S[sensor]), leads
            )
        # After a jump or a run the states may have changed: widen them, then use the whole reading.
        # Otherwise a reading beyond three sigmas counts less (Huber)
        if ramp is not None and runs:
            self._open_leak(ramp, now_s, math.sqrt(spread))
        if watch.far or runs:
            watch.far = 0
            ph, spread = self._project_covariance(row, variance)
        elif squared > _HUBER2:
            spread *= squared / _HUBER2
        # Kalman update: gain K = P h / s, x <- x + K innovation, P <- P - K (P h)^T
        gain = ph / spread
        x += gain * innovation
        p -= gain[:, None] * ph
        # Bookkeeping: when the sensor was used last, its share of the estimate, and what its
        # innovation shows of the leak's walk
        since_s = min(now_s - watch.seen_s, FRESH_S[sensor])
        watch.seen_s = now_s
        watch.taken_s = taken_s
        if sensor in (Sensor.LASER, Sensor.OPTICS):
            centre_gain = float(self._find_centre_row(now_s) @ gain)
            watch.pull += abs(centre_gain)
            if leads:
                gains = centre_gain, float(gain[_LEAK])
                memory.leak_walk.learn(innovation, variance, gains, since_s)

    def _learn_noise(self, sensor: Sensor, share: float, dt_s: float, leads: bool) -> None:
        """Let a good reading correct the noise levels of the walks that it shows.

        `share` of the innovation's variance is the states', the rest the reading's own noise.
        """
        walks: tuple[tuple[LearnedFactor, float], ...] = ()
        if sensor > Sensor.OPTICS:
            walks = ((self.memory.walks[sensor - 1], 1.0),)
        elif leads:
            # The centre walks by itself, and with the temperature of the gas: in proportion
            by_air = (
                self._air_walk()
                * (self._warmth_gain * lag_step_fraction(dt_s, self._gas_follows_air_s)) ** 2
            )
            centre = self._centre_walk()
            own = centre / (centre + by_air)
            walks = ((self.memory.walks[0], own), (self.memory.walks[2], 1 - own))
        else:
            # A laser beside the optics shows its mount: drift that is not learned as the mount's
            # walk would count as the laser's noise
            walks = ((self.memory.walks[3], 1.0),)
        self.memory.noises[sensor].learn(self.memory.watches[sensor].innovation, share, dt_s, walks)

    def _pressure_walk(self) -> float:
        return self.memory.walks[1].factor * self._config.pressure_walk_pa_per_root_s**2

    def _air_walk(self) -> float:
        return self.memory.walks[2].factor * self._config.air_walk_k_per_root_s**2

    def _centre_walk(self) -> float:
        walk = self._config.centre_walk_um_per_root_s**2
        if not self._learns_gains:
            # What the configured gain misses of the pressure's walk is not predicted
            walk += _GAIN_ERROR**2 * self._pressure_gain**2 * self._pressure_walk()
        return self.memory.walks[0].factor * walk

    @property
    def _learns_gains(self) -> bool:
        """At first the unknown warmth of the gas would be taken for an error of its gain."""
        return self.memory.count >= _GAINS_FROM_S * self._rate_hz

    def _learns_gain(self, sensor: Sensor, now_s: float) -> bool:
        return self._learns_gains and self._is_fresh(sensor, now_s)

    def _project_covariance(self, row: FloatArray, variance: float) -> tuple[FloatArray, float]:
        """Return P h (73,), the covariance of the states with a reading's expectation, and the
        innovation's variance h^T P h + r.
        """
        ph: FloatArray = self.memory.p @ row
        return ph, float(row @ ph) + variance

    def _is_doubtful(self, sensor: Sensor, squared: float, taken_s: float, now_s: float) -> bool:
        """Whether a reading this far off, in squared sigmas, is not to be used yet: it may be a
        single bad one.

        A laser far off waits for a frame that shows whether film or mount has moved.
        """
        watch = self.memory.watches[sensor]
        if squared <= _FAR2:
            watch.far = 0
            return False
        # The time of the first of them: the jump was then, also if it is found later
        if not watch.far:
            watch.far_since_s = taken_s
        watch.far += 1
        waits = sensor == Sensor.LASER and self._is_fresh(Sensor.OPTICS, now_s)
        return watch.far < _FAR_COUNT or (
            waits and self.memory.watches[Sensor.OPTICS].taken_s <= watch.far_since_s
        )

    def _open_jump(self, sensor: Sensor, innovation: float, now_s: float) -> None:
        """Widen the states by a sensor's jump: did the sensor move, or what it measures?

        The states along which the jump is possible get its square as variance, so that the next
        readings of all sensors decide.
        """
        since_s = self.memory.watches[sensor].far_since_s
        self._jumped.append(f"{sensor.name.lower()} {innovation:+.3g}")
        self._jumped_sensors.append(sensor)
        # A film that has moved since then: the gas, and every clone made after the jump
        moved = _ONE[_GAS] + self._centre_since(since_s)
        if sensor == Sensor.THERMOMETER:
            self._widen_states(innovation * _ONE[_AIR])
        elif sensor == Sensor.LASER and self._film_swings(innovation, since_s):
            self._widen_states(innovation * moved)
        elif sensor == Sensor.LASER and self._judged and self._is_fresh(Sensor.OPTICS, now_s):
            # Three sensors are compared, and the optics show no jump: the laser's mount was knocked
            self._widen_states(innovation * _ONE[_MOUNT])
        elif sensor == Sensor.BAROMETER:
            # Either the air's pressure has jumped, and the centre with it, or the barometer alone:
            # the film then has not moved, and the gas makes up for the expected motion
            pressure_gain = self._pressure_gain * (1.0 + float(self.memory.x[_PRESSURE_ERROR]))
            self._widen_states(
                innovation * (_ONE[_AMBIENT] + pressure_gain * self._centre_since(since_s))
            )
            self._widen_states(pressure_gain * innovation * moved)
        elif (
            sensor == Sensor.OPTICS
            and self._laser_agrees(now_s, since_s)
            and not self._is_fresh(sensor, since_s)
        ):
            # The optics return after a gap, in which the mirror followed the laser's mount
            self._widen_states(
                innovation * (_ONE[_GAS] + self._centre_since(-math.inf) - _ONE[_MOUNT])
            )
        else:
            # The film itself, in the usual case. What the other sensor of the centre has missed may
            # be a move of the optics instead: their zero gets a share
            self._widen_states(innovation * moved)
            if sensor == Sensor.LASER and self._is_fresh(Sensor.OPTICS, now_s):
                self.relock()  # the optics missed it: their zero is where the laser shows the film
            elif sensor == Sensor.OPTICS and self._laser_agrees(now_s, since_s):
                self._widen_states(_OPTICS_JUMP_SHARE * innovation * _ONE[_OPTICS_ZERO])

    def _laser_agrees(self, now_s: float, since_s: float) -> bool:
        """Whether no reading of the laser has been far off while the optics were, since a time.

        A film that swings, as behind a door, passes its mean while the optics are far off.
        """
        laser = self.memory.watches[Sensor.LASER]
        was_far = laser.far_since_s >= since_s - self.memory.frame_interval_s
        return self._is_fresh(Sensor.LASER, now_s) and not laser.far and not was_far

    def _film_swings(self, innovation: float, since_s: float) -> bool:
        """Whether a jump of the laser is the film's: the optics were far off, too, or just before.

        They may show another part of a swing then. Of a larger jump the gauge decides.
        """
        optics = self.memory.watches[Sensor.OPTICS]
        run_s = _FAR_COUNT * self.memory.frame_interval_s
        were_far = optics.far > 0 or optics.far_since_s >= since_s - run_s
        return were_far and abs(innovation) < _SWING_MOST_UM

    def _centre_since(self, since_s: float) -> FloatArray:
        """Return a row with 1 for each clone of the centre made at or after a time."""
        return np.concatenate([np.zeros(_PLANT), self.memory.times >= since_s])

    def _widen_states(self, jump: FloatArray) -> None:
        """Add the variance of a possible jump of the states, (73,)."""
        self.memory.p += jump[:, None] * jump

    def _open_leak(self, ramp: InnovationRamp, now_s: float, sigma_um: float) -> None:
        """Add the variance of a leak that changed when the innovations began to run away."""
        # A leak that is smaller by 1 since then has raised the centre by the time since then; the
        # clones made meanwhile by the time until they were made
        jump = (now_s - ramp.since_s) * _ONE[_GAS] - _ONE[_LEAK]
        jump[_PLANT:] = np.maximum(self.memory.times - ramp.since_s, 0.0)
        self._widen_states(ramp.slope * sigma_um * jump)
        self.memory.leak_walk.pause()

    def _is_fresh(self, sensor: Sensor, now_s: float) -> bool:
        limit_s = FRESH_S[sensor]
        # Optics with many figures a second are missed sooner
        if sensor == Sensor.OPTICS:
            limit_s = min(
                limit_s, max(FRESH_S[Sensor.LASER], _FRAMES_LOST * self.memory.frame_interval_s)
            )
        return now_s - self.memory.watches[sensor].seen_s <= limit_s

    def _make_estimate(self, now_s: float) -> CentreEstimate:
        """The estimate of this tick, in the laser's coordinates, with prediction, leak and
        sensors.
        """
        x, row = self.memory.x, self._find_centre_row(now_s)
        # The centre drifts by the leak, and by gas that warms towards the air.
        drift = float(x[_LEAK])
        if self._gas_follows_air_s > 0:
            gain = self._warmth_gain * (1.0 + x[_WARMTH_ERROR])
            drift -= float(gain * (x[_AIR] - x[_WARMTH]) / self._gas_follows_air_s)
        # In the laser's coordinates: the setpoint is one of the laser, and the trim is the mount
        um = self._compute_centre_um() + float(x[_MOUNT])
        pulls = sum(watch.pull for watch in self.memory.watches)
        return CentreEstimate(
            um=um,
            sigma_um=math.sqrt(max(0.0, self._project_covariance(row, 0.0)[1])),
            mount_um=float(x[_MOUNT]),
            ahead_um=um + self._transit.coming_um(drift),
            due_um_per_s=self._transit.due_um_per_s() - drift,
            leak_um_per_s=float(x[_LEAK]),
            drift_um_per_s=drift,
            sensors=tuple(
                SensorView(
                    self._is_fresh(sensor, now_s),
                    watch.innovation,
                    watch.pull / pulls if pulls > 0 else 0.0,
                )
                for sensor, watch in zip(Sensor, self.memory.watches, strict=True)
            ),
            jumped=tuple(self._jumped),
            jumped_sensors=tuple(self._jumped_sensors),
        )
