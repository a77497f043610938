"""One estimate of the mirror's centre from everything that sees it: a Kalman filter with a memory. Pure.

    centre  c = z + g_p p + g_T T_gas           z: the gas in the mirror, as height of the centre
    dz/dt   = q - leak                          q: the pump's flow, after dead time and lag
    dT_gas/dt = (T_air - T_gas) / T_g
    laser   = c + mount      optics = c - stand      barometer = p      thermometer = T_air

z, leak, p, T_air and mount are random walks; `stand` is what the optics' zero differs from the laser's at lock. A
frame shows the centre of some time ago: the centre at each of the last ticks is a state of its own (a clone), so a
late reading is exact, whenever it comes.
"""

import math
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.config.control import EstimatorConfig, LoopConfig
from membrane_ctrl.control.centre_estimate import FRESH_S, CentreEstimate, CentreReadings, Sensor, SensorView, Transit
from membrane_ctrl.control.filters import LearnedFactor, Ramp, ReadingNoise, configured_walk, smoothing
from membrane_ctrl.control.gas import believed_weather
from membrane_ctrl.model.arrays import FloatArray

_GAS, _LEAK, _AMBIENT, _AIR, _WARMTH, _MOUNT, _STAND = range(7)
_PLANT = 7  # states before the clones
CLONES = 64  # 1.3 s at 50 Hz
_CLONE_S = 0.02  # least time between clones
_GAIN_ERROR = 0.2  # share of the barometer's effect that its configured gain may miss
_HUBER2, _FAR2, _FAR_COUNT = 9.0, 25.0, 3  # squared sigmas: weighed less beyond the first, dropped beyond the second
LOCK_FRAMES = 5
_FRAMES_LOST = 3  # after this many missing frames the optics are gone
_INTERVAL_SHARE = 0.2  # of a new interval in their mean
_IMPOSSIBLE = 1e4  # um, Pa or K: no film, weather or mount moves that far in a hold
_UNKNOWN_UM2 = 1e6  # variance of the optics' zero before lock
_LEAK_STD_UM_PER_S, _WARMTH_STD_K, _AMBIENT_STD_PA = 0.3, 0.02, 1.0  # at the start
_SHARE_S = 2.0  # memory of the sensors' weights
# Of a leak's ramp in laser or optics, in standard deviations: seldom by chance where the noise is large
_RUN = 14.0, 8.0
_OPTICS_JUMP_SHARE = 0.3  # a jump that the optics see and the laser's noise hides is the film's, most likely
_ONE: FloatArray = np.eye(_PLANT + CLONES)  # a reading's expectation is a sum of states: one of them, as a row


@dataclass(slots=True)
class _Watch:
    """What the filter knows of one sensor."""

    seen_s: float = -math.inf  # arrival of the last accepted reading
    taken_s: float = -math.inf  # when it was taken
    innovation: float = math.nan
    pull: float = 0.0  # recent sum of gains on the centre
    far: int = 0  # readings in a row beyond the outer limit
    far_since_s: float = math.nan


class CentreFilter:
    """Estimates the centre; `start` it, then call `step` on every tick."""

    def __init__(self, config: EstimatorConfig, loop: LoopConfig) -> None:
        self._config, self._rate_hz = config, loop.rate_hz
        self.set_gains(loop)
        self._every = max(1, round(_CLONE_S * loop.rate_hz))
        self.start(0.0, 0.0, 0.0)

    def set_gains(self, loop: LoopConfig) -> None:
        """Take what barometer and thermometer mean for the centre."""
        self._pressure_gain = loop.barometer_gain_um_per_pa
        self._warmth_gain = loop.temperature_gain_um_per_k
        self._gas_follows_air_s = loop.gas_follows_air_s
        weather: FloatArray = self._pressure_gain * _ONE[_AMBIENT] + self._warmth_gain * _ONE[_WARMTH]
        self._centre: FloatArray = _ONE[_GAS] + weather
        self._uses = (loop.feedforward_barometer, loop.feedforward_temperature)

    def start(
        self, displacement_um: float, flow_um_per_s: float, mount_um: float, sag_zero_um: float = math.nan
    ) -> None:
        """Begin at a displacement, a flow that balances the leak, and a known displacement of the laser's mount.

        `sag_zero_um`: the sag at displacement 0, of a bench without a laser; otherwise the first frames lock it.
        """
        config, rate_hz = self._config, self._rate_hz
        self._x: FloatArray = np.zeros(_PLANT + CLONES)
        self._p: FloatArray = np.zeros((_PLANT + CLONES, _PLANT + CLONES))
        self._times: FloatArray = np.full(CLONES, -np.inf)
        self._count = 0
        self._x[_GAS], self._x[_LEAK], self._x[_MOUNT] = displacement_um - mount_um, flow_um_per_s, mount_um
        variances = (
            config.laser_noise_um**2, _LEAK_STD_UM_PER_S**2, _AMBIENT_STD_PA**2, _WARMTH_STD_K**2, _WARMTH_STD_K**2,
            0.0, _UNKNOWN_UM2,
        )  # fmt: skip
        for i, variance in enumerate(variances):
            self._p[i, i] = variance
        self._origin = [math.nan, math.nan, math.nan]  # first pressure, air temperature, sag
        self._watches = [_Watch() for _ in Sensor]
        self._noises = [ReadingNoise(stated=sensor == Sensor.OPTICS) for sensor in Sensor]
        self._walks = [configured_walk() for _ in range(4)]  # of centre, pressure, air, and the laser's mount
        self._ramps = [Ramp(limit) for limit in _RUN]
        self._transit = Transit(config.pump_delay_s, config.pump_lag_s, 1 / rate_hz)
        self._transit.place(flow_um_per_s)
        self._jumped: list[str] = []
        self._jumped_sensors: list[Sensor] = []
        self._judged = True
        self.frames = 0  # of the optics since lock
        self._frame_interval_s = FRESH_S[Sensor.OPTICS]
        self._last_frame_s = -math.inf
        if math.isfinite(sag_zero_um):
            self._origin[2], self._p[_STAND, _STAND], self.frames = sag_zero_um, 0.0, LOCK_FRAMES

    def relock(self) -> None:
        """Take the optics' next readings as a new zero."""
        self._p[_STAND] = self._p[:, _STAND] = 0.0
        self._p[_STAND, _STAND], self._x[_STAND] = _UNKNOWN_UM2, 0.0
        self._origin[2] = math.nan
        self.frames = 0
        self._watches[Sensor.OPTICS] = _Watch()

    def blame_optics(self, mount_um: float) -> None:
        """The optics were wrong: what the mount has moved from there was the centre's motion. They lock anew."""
        self._x += (self._x[_MOUNT] - mount_um) * (_ONE[_GAS] + self._centre_since(-math.inf) - _ONE[_MOUNT])
        self.relock()

    def step(self, given: CentreReadings, dt_s: float) -> CentreEstimate:
        """One tick: predict, then take what was read. `dt_s` must exceed 0."""
        self._jumped, self._jumped_sensors, self._judged = [], [], given.judged
        self._predict(given, dt_s)
        self._clone(given.now_s)
        for watch in self._watches:
            watch.pull *= math.exp(-dt_s / _SHARE_S)
        pressure_pa, air_c = believed_weather(given.ambient_pressure_pa, given.air_temperature_c)
        config = self._config
        weather = (_AMBIENT, pressure_pa, config.barometer_noise_pa), (_AIR, air_c, config.thermometer_noise_k)
        for n, (state, value, noise) in enumerate(weather):
            if self._uses[n] and math.isfinite(value):
                sensor = Sensor(Sensor.BAROMETER + n)
                self._take(sensor, _ONE[state], self._from_origin(n, value), noise**2, given.now_s)
        if math.isfinite(given.sag_um) and 0.0 <= given.sag_sigma_um < _IMPOSSIBLE:
            self._take_frame(given)
        if math.isfinite(given.laser_um):
            row = self._centre + _ONE[_MOUNT]
            self._take(Sensor.LASER, row, given.laser_um, config.laser_noise_um**2, given.now_s)
        return self._estimate(given.now_s)

    def _from_origin(self, which: int, value: float) -> float:
        """The value less the first one: numbers stay small."""
        if math.isnan(self._origin[which]):
            self._origin[which] = value
        return value - self._origin[which]

    def _predict(self, given: CentreReadings, dt_s: float) -> None:
        x, p, config = self._x, self._p, self._config
        follow = smoothing(dt_s, self._gas_follows_air_s)
        x[_GAS] += self._transit.advance(given.flow_um_per_s, dt_s) - x[_LEAK] * dt_s
        x[_WARMTH] += follow * (x[_AIR] - x[_WARMTH])
        for matrix in (p, p.T):
            matrix[_GAS] -= dt_s * matrix[_LEAK]
            matrix[_WARMTH] += follow * (matrix[_AIR] - matrix[_WARMTH])
        p[_GAS, _GAS] += dt_s * self._centre_walk()
        p[_LEAK, _LEAK] += dt_s * config.leak_walk_um_per_s_per_root_s**2
        p[_AMBIENT, _AMBIENT] += dt_s * self._pressure_walk()
        p[_AIR, _AIR] += dt_s * self._air_walk()
        # without optics no reading tells mount from film, and what was learned of a drift would let the film drift
        drifts = self._walks[3].factor if self._fresh(Sensor.OPTICS, given.now_s) else 1.0
        p[_MOUNT, _MOUNT] += dt_s * drifts * config.mount_walk_um_per_root_s**2

    def _clone(self, now_s: float) -> None:
        """Remember the centre of this tick in the oldest clone."""
        self._count += 1
        if self._count % self._every:
            return
        slot = self._count // self._every % CLONES
        self._times[slot] = now_s
        slot += _PLANT
        self._p[slot] = self._p[:, slot] = self._centre @ self._p
        self._p[slot, slot] = self._centre @ self._p[slot]
        self._x[slot] = self._centre @ self._x

    def _take_frame(self, given: CentreReadings) -> None:
        times, time_s = self._times, given.sag_time_s
        before, after = np.where(times <= time_s, times, -np.inf), np.where(times > time_s, times, np.inf)
        early, late = int(before.argmax()), int(after.argmin())
        if not math.isfinite(before[early]) or time_s > given.now_s:
            return  # older than the memory, or from the future
        row = _ONE[_PLANT + early] - _ONE[_STAND]
        if math.isfinite(after[late]):
            share = float((time_s - times[early]) / (times[late] - times[early]))
            row += share * (_ONE[_PLANT + late] - _ONE[_PLANT + early])
        variance = given.sag_sigma_um**2 + self._config.optics_noise_um**2
        self._take(Sensor.OPTICS, row, self._from_origin(2, given.sag_um), variance, given.now_s, time_s)
        if (interval_s := time_s - self._last_frame_s) > 0:
            longer_s = min(interval_s, FRESH_S[Sensor.OPTICS]) - self._frame_interval_s
            self._frame_interval_s += _INTERVAL_SHARE * longer_s
        self._last_frame_s = time_s
        self.frames += 1
        if self.frames == LOCK_FRAMES:
            self._lock()

    def _lock(self) -> None:
        """Declare the figure seen so far the one to hold: what was uncertain of it is the laser's from now on.

        A change of coordinates: with e the error of `stand`, the centre becomes c - e, the mount's displacement
        mount + e.
        """
        for matrix in (self._p, self._p.T):
            matrix[_GAS] -= matrix[_STAND]
            matrix[_MOUNT] += matrix[_STAND]
            matrix[_PLANT:] -= matrix[_STAND]
            matrix[_STAND] = 0.0

    def _take(
        self, sensor: Sensor, row: FloatArray, value: float, variance: float, now_s: float, taken_s: float = math.nan
    ) -> None:
        """Use one reading, whose expectation is a row times the states, by how well it fits."""
        taken_s = now_s if math.isnan(taken_s) else taken_s
        watch, x, p = self._watches[sensor], self._x, self._p
        variance *= self._noises[sensor].factor
        innovation = float(value - row @ x)
        if abs(innovation) > _IMPOSSIBLE:
            return
        ph, spread = self._spread(row, variance)
        squared = innovation**2 / spread
        watch.innovation = innovation / math.sqrt(spread)
        leads = sensor != Sensor.LASER or not self._fresh(Sensor.OPTICS, now_s)
        ramp = self._ramps[sensor] if leads and sensor <= Sensor.OPTICS else None
        runs = ramp is not None and ramp.update(watch.innovation, taken_s)
        if self._doubted(sensor, squared, taken_s, now_s) and not runs:
            return
        if watch.far >= _FAR_COUNT:
            self._open(sensor, innovation, now_s)
        elif not watch.far:
            self._learn(sensor, 1 - variance / spread, min(now_s - watch.seen_s, FRESH_S[sensor]), leads)
        if ramp is not None and runs:
            self._widen_leak(ramp, now_s, math.sqrt(spread))
        if watch.far or runs:
            watch.far = 0
            ph, spread = self._spread(row, variance)
        elif squared > _HUBER2:
            spread *= squared / _HUBER2
        gain = ph / spread
        x += gain * innovation
        p -= gain[:, None] * ph
        watch.seen_s, watch.taken_s = now_s, taken_s
        if sensor in (Sensor.LASER, Sensor.OPTICS):
            watch.pull += abs(float(self._centre @ gain))

    def _learn(self, sensor: Sensor, share: float, dt_s: float, leads: bool) -> None:
        """Let a good reading correct the noise levels; the centre walks by itself, and by what warms the gas."""
        walks: tuple[tuple[LearnedFactor, float], ...] = ()
        if sensor > Sensor.OPTICS:
            walks = ((self._walks[sensor - 1], 1.0),)
        elif leads:
            by_air = self._air_walk() * (self._warmth_gain * smoothing(dt_s, self._gas_follows_air_s)) ** 2
            own = (centre := self._centre_walk()) / (centre + by_air)
            walks = ((self._walks[0], own), (self._walks[2], 1 - own))
        else:  # a laser beside the optics shows its mount: drift that is not its walk would count as its noise
            walks = ((self._walks[3], 1.0),)
        self._noises[sensor].learn(self._watches[sensor].innovation, share, dt_s, walks)

    def _pressure_walk(self) -> float:
        return self._walks[1].factor * self._config.pressure_walk_pa_per_root_s**2

    def _air_walk(self) -> float:
        return self._walks[2].factor * self._config.air_walk_k_per_root_s**2

    def _centre_walk(self) -> float:
        missed = _GAIN_ERROR**2 * self._pressure_gain**2 * self._pressure_walk()
        return self._walks[0].factor * (self._config.centre_walk_um_per_root_s**2 + missed)

    def _spread(self, row: FloatArray, variance: float) -> tuple[FloatArray, float]:
        """Covariance of all states with a reading's expectation, and the variance of its innovation."""
        ph: FloatArray = self._p @ row
        return ph, float(row @ ph) + variance

    def _doubted(self, sensor: Sensor, squared: float, taken_s: float, now_s: float) -> bool:
        """Whether a reading this far off, in squared sigmas, is not to be used yet: it may be a single bad one.

        A laser far off waits for a frame that shows whether film or mount has moved.
        """
        watch = self._watches[sensor]
        if squared <= _FAR2:
            watch.far = 0
            return False
        watch.far_since_s = watch.far_since_s if watch.far else taken_s
        watch.far += 1
        waits = sensor == Sensor.LASER and self._fresh(Sensor.OPTICS, now_s)
        return watch.far < _FAR_COUNT or (waits and self._watches[Sensor.OPTICS].taken_s <= watch.far_since_s)

    def _open(self, sensor: Sensor, innovation: float, now_s: float) -> None:
        """A sensor has moved and stays there: let the others say whether it moved, or what it sees."""
        since_s = self._watches[sensor].far_since_s
        self._jumped.append(f"{sensor.name.lower()} {innovation:+.3g}")
        self._jumped_sensors.append(sensor)
        moved = _ONE[_GAS] + self._centre_since(since_s)
        if sensor == Sensor.THERMOMETER:
            self._widen(innovation * _ONE[_AIR])
        elif sensor == Sensor.LASER and self._judged and self._fresh(Sensor.OPTICS, now_s):
            self._widen(innovation * _ONE[_MOUNT])
        elif sensor == Sensor.BAROMETER:
            self._widen(innovation * (_ONE[_AMBIENT] + self._pressure_gain * self._centre_since(since_s)))
            self._widen(self._pressure_gain * innovation * moved)
        elif sensor == Sensor.OPTICS and self._laser_agrees(now_s) and not self._fresh(sensor, since_s):
            # they are back, and the mirror has followed the laser's mount meanwhile
            self._widen(innovation * (_ONE[_GAS] + self._centre_since(-math.inf) - _ONE[_MOUNT]))
        else:
            self._widen(innovation * moved)
            if sensor == Sensor.LASER and self._fresh(Sensor.OPTICS, now_s):
                self.relock()  # optics that missed it count from where the laser sees the film
            elif sensor == Sensor.OPTICS and self._laser_agrees(now_s):
                self._widen(_OPTICS_JUMP_SHARE * innovation * _ONE[_STAND])

    def _laser_agrees(self, now_s: float) -> bool:
        return self._fresh(Sensor.LASER, now_s) and not self._watches[Sensor.LASER].far

    def _centre_since(self, since_s: float) -> FloatArray:
        return np.concatenate([np.zeros(_PLANT), self._times >= since_s])

    def _widen(self, jump: FloatArray) -> None:
        """The states may have jumped by some such amounts."""
        self._p += jump[:, None] * jump

    def _widen_leak(self, ramp: Ramp, now_s: float, sigma_um: float) -> None:
        """The leak may have changed when the innovations began to run away."""
        jump = (now_s - ramp.since_s) * _ONE[_GAS] - _ONE[_LEAK]
        jump[_PLANT:] = np.maximum(self._times - ramp.since_s, 0.0)
        self._widen(ramp.slope * sigma_um * jump)

    def _fresh(self, sensor: Sensor, now_s: float) -> bool:
        limit_s = FRESH_S[sensor]
        if sensor == Sensor.OPTICS:
            limit_s = min(limit_s, max(FRESH_S[Sensor.LASER], _FRAMES_LOST * self._frame_interval_s))
        return now_s - self._watches[sensor].seen_s <= limit_s

    def _estimate(self, now_s: float) -> CentreEstimate:
        x = self._x
        drift = float(x[_LEAK])
        if self._gas_follows_air_s > 0:
            drift -= float(self._warmth_gain * (x[_AIR] - x[_WARMTH]) / self._gas_follows_air_s)
        um = float(self._centre @ x + x[_MOUNT])
        pulls = sum(watch.pull for watch in self._watches)
        return CentreEstimate(
            um=um,
            sigma_um=math.sqrt(max(0.0, self._spread(self._centre, 0.0)[1])),
            mount_um=float(x[_MOUNT]),
            ahead_um=um + self._transit.coming_um(drift),
            due_um_per_s=self._transit.due_um_per_s() - drift,
            leak_um_per_s=float(x[_LEAK]),
            drift_um_per_s=drift,
            sensors=tuple(
                SensorView(self._fresh(sensor, now_s), watch.innovation, watch.pull / pulls if pulls > 0 else 0.0)
                for sensor, watch in zip(Sensor, self._watches, strict=True)
            ),
            jumped=tuple(self._jumped),
            jumped_sensors=tuple(self._jumped_sensors),
        )
