"""The sensors of a held mirror: which one is wrong by the others and the film, what wears out, which ones hold it."""

import math
from collections import deque
from collections.abc import Collection
from dataclasses import dataclass, replace

from membrane_ctrl.config.schema import Config, LoopConfig, PumpConfig, ShapeConfig
from membrane_ctrl.control import film, film_health, gas, inner_loop
from membrane_ctrl.control.centre import LOCK_FRAMES, CentreFilter
from membrane_ctrl.control.centre_estimate import CentreEstimate, CentreReadings, Sensor, StandGrowth
from membrane_ctrl.control.filters import LowPass
from membrane_ctrl.controller import safety
from membrane_ctrl.controller.protection import FilmSensor
from membrane_ctrl.controller.redundancy import RedundancyWatch
from membrane_ctrl.controller.scene import Scene
from membrane_ctrl.controller.tick import TickInputs
from membrane_ctrl.model.events import Event, HeldBy, Maintenance, MaintenanceOver, Plausibility, PumpLearned
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.telemetry import ShapeState, State

_WEATHER_STANDS_S = 10.0  # a single bad answer is not reported
# No two cycles have the same noise; a shape that appears twice may be a repeated message
_REPEATS = 3


@dataclass(frozen=True, slots=True)
class HoldStatus:
    """State of the held mirror."""

    # NaN for old, bad or stuck readings and jumps: a mean over ten seconds must not include a bit error
    laser_um: float
    gauge_pressure_pa: float
    setpoint_um: float  # as commanded
    trim_um: float  # by the shape loop
    # the rest of the setpoint's ramp. The camera lags by a cycle, and the gauge is linear only near its reference: on
    # a long ramp they would contradict a correct laser
    ramp_left_um: float
    leak_um_per_s: float  # as the inner loop estimates it; NaN without
    flow_um_per_s: float  # of the pump; NaN without
    bleed_fraction: float  # of the vent, held open on purpose
    optics_hold: bool = False  # they see the centre, and its estimate is held: a laser that moved is known
    sag_um: float = math.nan  # by the newest figure; NaN without a usable one
    optics_usable: bool = True  # the estimate, or the shape loop, uses the figures
    figure: ShapeEstimate | None = None  # that arrived in this tick and may be used


def hold_status(
    scene: Scene, last: inner_loop.LoopOutput, optics_hold: bool, optics_usable: bool = True
) -> HoldStatus:
    """The mirror after the tick's reading was taken; `last` is what the loop gave in the tick before."""
    return HoldStatus(
        laser_um=scene.observer.moving_laser_um,
        gauge_pressure_pa=scene.observer.gauge_pressure_pa,
        setpoint_um=scene.setpoint_um,
        trim_um=scene.trim_um,
        ramp_left_um=scene.setpoint_um + scene.trim_um - last.setpoint_um,
        leak_um_per_s=last.leak_um_per_s,
        flow_um_per_s=last.flow_um_per_s,
        bleed_fraction=scene.loop_config.bleed_fraction,
        optics_hold=optics_hold,
        sag_um=scene.observer.figures.sag_um,
        figure=scene.observer.figures.accepted,
        optics_usable=optics_usable,
    )


# A figure is made of frames of up to a cycle ago, and takes this long to compute and arrive.
_FIGURE_TAKES_S = 0.5


def _find_figure_lag_s(config: Config) -> float:
    """By how much a figure may be older than the laser's reading of the same tick."""
    shape = config.shape
    interval_s = 1 / shape.track_rate_hz if shape.mode == "track" else shape.period_s
    return interval_s + _FIGURE_TAKES_S


# An answer of the laser counts as much as so many ticks without one.
_ANSWER_COUNTS = 4.0
# So that a laser that is back is used after a second.
_MISSING_MAX_S = 4.0
# Within this time a knock or two are possible; a sensor that jumps more often is unsteady.
_UNSTEADY_S = 600.0
_VERDICTS_MAX, _OPTICS_JUMPS_MAX = 2, 5


class RecentCount:
    """Counts events of the last ten minutes."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._times_s: deque[float] = deque(maxlen=most + 1)

    def add(self, now_s: float) -> None:
        """Count one."""
        self._times_s.append(now_s)

    def too_many(self, now_s: float) -> bool:
        """Whether there were more than allowed."""
        return len(self._times_s) > self._most and now_s - self._times_s[0] <= _UNSTEADY_S


class SensorConsistency:
    """Consulted on every tick, before safety judges.

    Attributes
    ----------
    laser_lies, laser_gauge_apart, gas_excess : str
        As in `Observation`.
    camera_lies : str
        Readings of laser, gauge and camera, if the camera is wrong: a reason for the shape loop.
    laser_moved : bool
        From this tick on the laser is believed in its new place; the shape loop must lock anew.
    """

    def __init__(self, config: Config) -> None:
        self._plausibility = film.PlausibilityCheck(
            config.shape.disagreement_max_um, 1e3 * config.optics.mirror.sag_mm, _find_figure_lag_s(config)
        )
        self._far_um = config.shape.disagreement_max_um
        self._health = film_health.FilmHealth(config.loop.flow_most_um_per_s(config.pump))
        self._pump = film_health.PumpHealth(config.pump.change_max)
        self._laser_film = film.FilmMonitor(config.limits, config.optics.mirror)
        self._optics_film = film.FilmMonitor(config.limits, config.optics.mirror, "optics")
        self._nominal_sag_um = 1e3 * config.optics.mirror.sag_mm
        self._by_optics = config.by_optics
        self._follows_optics = config.estimator.process_value != "laser"
        self._redundancy = RedundancyWatch(config)
        self._laser_missing_s = 0.0
        self._doubted = self._drift_noticed = False
        self._growth = film.LeakGrowth()
        self._leak_growth_max = config.limits.leak_growth_max
        self._fresh_s = config.shape.fresh_s
        self._camera_s = -math.inf
        self._sag_um, self._repeats = math.nan, 0
        self._setpoint_um, self._bleed_fraction = config.loop.setpoint_um, config.loop.bleed_fraction
        self._liar = film.Liar.NOBODY
        self._lies_s, self.laser_moved = 0.0, False
        self._laser_verdicts = RecentCount(_VERDICTS_MAX)
        self._weather_s = 0.0
        self._weather_told = False
        self.laser_lies = self.camera_lies = self.laser_gauge_apart = self.gas_excess = ""

    def ask(self, inputs: TickInputs, state: State, dt_s: float, held: HoldStatus) -> list[Event]:
        """Observe a tick and return its new events; judges only a held mirror."""
        laser_um, gauge_pa = held.laser_um, held.gauge_pressure_pa
        if held.setpoint_um != self._setpoint_um:
            self._setpoint_um = held.setpoint_um
            self._health.setpoint_moved()
        if state != State.HOLD or held.bleed_fraction != self._bleed_fraction:
            self._bleed_fraction = held.bleed_fraction
            self._growth.reset()
        # A laser that answers now and then counts as missing; one that misses a reading now and then does not.
        change_s = -_ANSWER_COUNTS * dt_s if math.isfinite(laser_um) else dt_s
        self._laser_missing_s = min(max(self._laser_missing_s + change_s, 0.0), _MISSING_MAX_S)
        self._compare_with_gauge(state, dt_s, held)
        events = self._doubt_sag(state) + self._notice_drift(state)
        events += self._watch_redundancy(inputs.now_s, state, held)
        if state not in safety.ESTIMATED:
            return events + self._rest()
        moves = state not in (State.SETTLE, State.HOLD) or abs(held.ramp_left_um) > self._far_um
        if moves:
            self._growth.moves()
            self.gas_excess = ""
        self._look_at_camera(held.figure)
        events += self._judge_weather(inputs, dt_s)
        blind = not inputs.now_s - self._camera_s <= self._fresh_s
        liar = self._plausibility.step(dt_s, laser_um, gauge_pa, held.figure, blind)
        self._lies_s = self._lies_s + dt_s if liar == film.Liar.LASER and held.optics_hold else 0.0
        # A knock is over: the estimate knows the laser's new place. A laser that is knocked again and again is not.
        self.laser_moved = self._lies_s > film.WARM_S and not self._laser_verdicts.too_many(inputs.now_s)
        if self.laser_moved:
            self._plausibility.rebase()
            liar = film.Liar.NOBODY
        if liar == film.Liar.LASER and self._liar != film.Liar.LASER:
            self._laser_verdicts.add(inputs.now_s)
        events += self._judge(liar)
        if moves or state == State.SETTLE:
            return events
        self.gas_excess = self._growth.step(held.leak_um_per_s, held.flow_um_per_s, self._most_growth(inputs), dt_s)
        events += [_of_warning(each) for each in self._health.step(dt_s, held.leak_um_per_s, gauge_pa)]
        return events

    @property
    def agree(self) -> bool:
        """Laser and camera do not contradict each other, as far as is known."""
        return self._liar == film.Liar.NOBODY and not self.camera_lies

    @property
    def camera_drifts(self) -> bool:
        """The camera is wrong by a slow drift, not by a jump."""
        return self._plausibility.slow_wrong

    @property
    def judges(self) -> bool:
        """Laser, camera and gauge are compared: a jump of one of them will be judged."""
        return self._plausibility.judges

    def set_gains(self, loop: LoopConfig, pump: PumpConfig) -> None:
        """Judge by the gains and the curve that are now in force."""
        self._health.set_pump(loop.flow_most_um_per_s(pump))
        self._pump.set_pump(pump.change_max)

    def told_of_pump(self, loop: inner_loop.InnerLoop) -> list[Event]:
        """Events on what a segment of probing has told of the pump."""
        report, warnings = self._pump.step(loop.pump_known)
        events: list[Event] = [_of_warning(warning) for warning in warnings]
        if report:
            known = loop.pump_known
            scales = (round(value, 4) for value in (known.scale, known.sigma, loop.pump_correction))
            events.append(PumpLearned(*scales))
        return events

    def _rest(self) -> list[Event]:
        """Reset: the mirror is not held, or not yet at its setpoint."""
        self._lies_s, self.laser_moved = 0.0, False
        self._growth.moves()
        self.gas_excess = ""
        self._plausibility.reset()
        return self._judge(film.Liar.NOBODY)

    @property
    def _optics_alone(self) -> bool:
        """Whether the optics show the film in the laser's place."""
        missing = self._laser_missing_s > film.LASER_GAP_S
        return self._by_optics or (self._follows_optics and missing)

    def _compare_with_gauge(self, state: State, dt_s: float, held: HoldStatus) -> None:
        """Compare laser and optics with the gauge, each by itself; the one that shows the film decides.

        Both comparisons run all the time, so that the optics have a reference when the laser is lost.
        """
        if state not in safety.CONNECTED:
            self._laser_film.reset()
            self._optics_film.reset()
            self.laser_gauge_apart = ""
            return
        gauge_pa = held.gauge_pressure_pa
        by_laser = self._laser_film.step(dt_s, held.laser_um, held.trim_um, gauge_pa)
        by_optics = self._optics_film.step(dt_s, held.sag_um - self._nominal_sag_um, 0.0, gauge_pa)
        self.laser_gauge_apart = by_optics if self._optics_alone else by_laser

    @property
    def _film_in_use(self) -> film.FilmMonitor:
        return self._optics_film if self._optics_alone else self._laser_film

    def _notice_drift(self, state: State) -> list[Event]:
        """Report once that the displacement and the gauge drift apart, which climate may hide a sensor's drift in."""
        monitor = self._film_in_use
        noticed = state in safety.CONNECTED and monitor.drifting
        if noticed == self._drift_noticed:
            return []
        self._drift_noticed = noticed
        sensor = "optics" if self._optics_alone else "laser"
        if not noticed:
            return [MaintenanceOver("slow_drift", "the two are near each other again")]
        message = (
            f"{sensor} and gauge have moved {monitor.drift_um:.0f} um apart within a day: humidity and "
            "temperature of the film do this, and so does a sensor that drifts. Compare the laser with a ruler"
        )
        return [Maintenance("slow_drift", message)]

    def _watch_redundancy(self, now_s: float, state: State, held: HoldStatus) -> list[Event]:
        """Report a lost sensor of the film while the pump is driven."""
        present = {
            FilmSensor.LASER: math.isfinite(held.laser_um),
            FilmSensor.OPTICS: held.optics_hold or (held.optics_usable and math.isfinite(held.sag_um)),
            FilmSensor.GAUGE: math.isfinite(held.gauge_pressure_pa),
        }
        return self._redundancy.step(now_s, state in safety.MOVING, present)

    def _doubt_sag(self, state: State) -> list[Event]:
        """Report once that optics without a laser may have missed a jump of the film, until the next start."""
        doubted_now = self._optics_alone and self._optics_film.doubted
        doubted = state in safety.CONNECTED and (self._doubted or doubted_now)
        if doubted == self._doubted:
            return []
        self._doubted = doubted
        if not doubted:
            return [MaintenanceOver("sag_doubted", "the comparison begins again")]
        return [
            Maintenance("sag_doubted", "the gauge shows a jump of the film that the camera missed: restart the hold")
        ]

    def _look_at_camera(self, estimate: ShapeEstimate | None) -> None:
        """Note when the camera last showed the film, and how often it repeated one shape bit by bit."""
        if estimate is None:
            return
        self._camera_s = estimate.time_s
        self._repeats = self._repeats + 1 if estimate.sag_um == self._sag_um else 0
        self._sag_um = estimate.sag_um

    def _most_growth(self, inputs: TickInputs) -> float:
        """Allowed growth of the leak: unlimited while the camera agrees with a laser that is there."""
        if self._optics_alone or self._repeats >= _REPEATS:
            return self._leak_growth_max
        if not inputs.now_s - self._camera_s <= self._fresh_s:
            return self._leak_growth_max
        return math.inf if self._liar == film.Liar.NOBODY else film.CONTRADICTED_MOST

    def _judge_weather(self, inputs: TickInputs, dt_s: float) -> list[Event]:
        """Report once that a barometer or thermometer is implausible; the loop ignores it."""
        reading = inputs.reading
        if reading is None:
            return []
        failure = gas.weather_fault(reading.ambient_pressure_pa, reading.air_temperature_c)
        self._weather_s = self._weather_s + dt_s if bool(failure) != self._weather_told else 0.0
        if self._weather_s < _WEATHER_STANDS_S:
            return []
        self._weather_told, self._weather_s = bool(failure), 0.0
        return [(Maintenance if failure else MaintenanceOver)("weather_sensor", failure or "the sensor is back")]

    def _judge(self, liar: film.Liar) -> list[Event]:
        repeats = self._repeats >= _REPEATS
        seen = str(self._plausibility.changes) if liar in (film.Liar.LASER, film.Liar.OPTICS) else ""
        self.laser_lies = seen if liar == film.Liar.LASER else ""
        if repeats:
            self.camera_lies = "the camera repeats one shape to the last bit: restart it"
        elif liar != film.Liar.OPTICS:
            self.camera_lies = ""
        elif not self.camera_lies:  # changed numbers do not make a new reason
            self.camera_lies = f"laser and gauge agree that the camera is wrong: {seen}"
        if liar == self._liar:
            return []
        self._liar = liar
        seen = str(self._plausibility.changes) if self._plausibility.watching else "compared anew from here on"
        return [Plausibility(liar.name.lower(), seen)]


def _of_warning(warning: film_health.FilmWarning) -> Event:
    return (Maintenance if warning.bad else MaintenanceOver)(warning.name, warning.message)


_STAND_SHARE = 0.25  # of the band: a growth of the optics' stand that may be this large is told
_STANDS_S = 1.5  # a sensor that comes and goes within this, as a slower camera does at first, is not reported


_UNSTEADY_MESSAGE = (
    "the optics have jumped against the laser again and again; they are left out, and the mirror follows the laser. "
    "Look for vibration, reflections or a loose camera, then `ctl shape off` and `on` use them again"
)
_JUMP_TAKES_S = 2.0  # until the estimate has followed a jump of the laser


class MountDrift:
    """How far the estimate lets the laser's mount drift: as far as the shape loop's trim, `shape.trim_max_um`.

    Laser and optics that drift apart do not show which of them drifts. Beyond the limit the optics are left out, the
    mirror follows the laser, and a person decides. A jump that the estimate found to be the laser's is no drift.
    """

    def __init__(self, shape: ShapeConfig) -> None:
        self._most_um = shape.trim_max_um
        self.start(0.0)

    def start(self, mount_um: float) -> None:
        """Count from a place of the mount, in um."""
        self._last_um = mount_um
        self._drift_um = 0.0
        self._optics_jumps = RecentCount(_OPTICS_JUMPS_MAX)
        self._jump_left_s = 0.0
        self.beyond_limit = False

    def step(self, mount_um: float, jumped: Collection[Sensor], now_s: float, dt_s: float) -> list[Event]:
        """Follow the mount; returns the notice once the limit is passed, which only `start` takes back.

        `jumped`: the sensors of which the estimate has found a jump in this tick. Optics that jump again and again
        lead the estimate away in steps that each look like a knock; they are left out as well.
        """
        moved_um = mount_um - self._last_um
        self._last_um = mount_um
        if self.beyond_limit:
            return []
        if Sensor.OPTICS in jumped:
            self._optics_jumps.add(now_s)
            if self._optics_jumps.too_many(now_s):
                self.beyond_limit = True
                return [Maintenance("optics_unsteady", _UNSTEADY_MESSAGE)]
        laser_jumped = Sensor.LASER in jumped
        self._jump_left_s = _JUMP_TAKES_S if laser_jumped else max(0.0, self._jump_left_s - dt_s)
        if self._jump_left_s == 0.0:
            self._drift_um += moved_um
        self.beyond_limit = abs(self._drift_um) > self._most_um
        if not self.beyond_limit:
            return []
        message = (
            f"laser and optics have drifted {self._most_um:g} um apart; which of them is not known, and the mirror "
            "follows the laser. Check its mount and the optics, then `ctl shape off` and `on` accept the figure"
        )
        return [Maintenance("trim_limit", message)]


class Holders:
    """Runs the estimate beside the states if `estimator.process_value` asks for it."""

    def __init__(self, config: Config) -> None:
        self._wanted = config.estimator.process_value != "laser"
        self._by_optics = config.by_optics
        self._sag_zero_um = 1e3 * config.optics.mirror.sag_mm if config.by_optics else math.nan
        self._filter = CentreFilter(config.estimator, config.loop)
        self._tracks = config.shape.mode == "track"
        self._running = self._locking = False
        # While laser and camera agree, by whether a slow drift of the camera is to be undone: what the filter gave to
        # the mount after that was the film's.
        self._agreed_mounts = {False: LowPass(film.REFERENCE_S), True: LowPass(film.SLOW_REFERENCE_S)}
        self._mount_drift = MountDrift(config.shape)
        self._stand = StandGrowth(config.estimator)
        self._stand_most_um, self._stand_told = _STAND_SHARE * config.limits.band_um, False
        self._told: tuple[int, ...] | None = None
        self._news_s = math.nan
        self.estimate: CentreEstimate | None = None

    @property
    def optics_hold(self) -> bool:
        """Whether the mirror is held without a laser: the optics see it."""
        return self.estimate is not None and self._filter.frames >= LOCK_FRAMES and self._sees(Sensor.OPTICS)

    @property
    def optics_left_out(self) -> bool:
        """Whether figures are not used until a person accepts the optics again."""
        return self._mount_drift.beyond_limit

    def set_gains(self, loop: LoopConfig) -> None:
        """Take the feed-forward's gains from other settings."""
        self._filter.set_gains(loop)

    def step(
        self,
        inputs: TickInputs,
        state: State,
        scene: Scene,
        last: inner_loop.LoopOutput,
        shape: ShapeState,
        consistency: SensorConsistency,
    ) -> list[Event]:
        """One tick, after the sensors were judged; returns what is news."""
        flow_um_per_s, seen_um = last.flow_um_per_s, scene.observer.displacement_um
        figures = scene.observer.figures
        if not self._wanted or state not in safety.ESTIMATED or not math.isfinite(flow_um_per_s):
            self.estimate, self._running, self._told = None, False, None
            return []
        laser_um = math.nan if consistency.laser_lies else scene.observer.moving_laser_um
        if not self._running:
            start_um = last.filtered_um if math.isfinite(last.filtered_um) else seen_um
            if not math.isfinite(start_um):
                return []
            sag_zero_um = self._find_sag_zero_um(scene)
            self._filter.start(start_um, scene.loop.mean_flow_um_per_s, scene.trim_um, sag_zero_um)
            self._running = True
            for agreed in self._agreed_mounts.values():
                agreed.reset(scene.trim_um)
            self._mount_drift.start(scene.trim_um)
            self._stand.lock()
        if self._is_anchor(inputs.estimate):
            self._filter.relock()  # another anchor shows the same film up to a micrometre higher or lower
        figure = self._select_figure(figures.accepted, scene.dt_s, shape, consistency)
        reading = inputs.reading
        self._stand.step(
            gas.believed_weather(math.nan, reading.air_temperature_c)[1] if reading else math.nan, scene.dt_s
        )
        if self._filter.frames < LOCK_FRAMES:
            self._stand.lock()
        readings = CentreReadings(
            now_s=inputs.now_s,
            flow_um_per_s=flow_um_per_s,
            laser_um=laser_um,
            ambient_pressure_pa=reading.ambient_pressure_pa if reading else math.nan,
            air_temperature_c=reading.air_temperature_c if reading else math.nan,
            sag_um=figure.sag_um - self._stand.um if figure else math.nan,
            sag_sigma_um=figure.sag_sigma_um if figure else math.nan,
            sag_time_s=figure.time_s if figure else math.nan,
            judged=consistency.judges,
        )
        self.estimate = self._filter.step(readings, scene.dt_s)
        scene.trim_um = self.estimate.mount_um
        news = [*self._news(inputs.now_s, self.estimate.jumped), *self._told_of_stand()]
        jumped = self.estimate.jumped_sensors
        news += self._mount_drift.step(self.estimate.mount_um, jumped, inputs.now_s, scene.dt_s)
        if self._sees(Sensor.OPTICS):
            sigma_um = math.hypot(self.estimate.sigma_um, self._stand.sigma_um)
            self.estimate = replace(self.estimate, sigma_um=sigma_um)
        return news

    def _find_sag_zero_um(self, scene: Scene) -> float:
        """Sag at true centre 0, where the optics replace the laser; NaN where they are to be locked."""
        if self._by_optics:
            return self._sag_zero_um
        observer = scene.observer
        return observer.figures.zero_um + scene.trim_um if observer.optics_replace_laser else math.nan

    def _is_anchor(self, figure: ShapeEstimate | None) -> bool:
        """Whether a figure is a full set that the tracking's next frames count from."""
        return figure is not None and self._tracks and figure.kind == "full" and figure.verdict != "rejected"

    def _select_figure(
        self, figure: ShapeEstimate | None, dt_s: float, shape: ShapeState, consistency: SensorConsistency
    ) -> ShapeEstimate | None:
        """The tick's figure if the filter may use it; locks the filter again where its reference ended."""
        off = shape == ShapeState.OFF and not self._by_optics
        if self._locking and not off:
            self._filter.relock()
            self._mount_drift.start(self.estimate.mount_um if self.estimate else 0.0)
        self._locking = off
        if consistency.agree and self.estimate is not None:
            for agreed in self._agreed_mounts.values():
                agreed.update(self.estimate.mount_um, dt_s)
        elif consistency.camera_lies and self._filter.frames and not self._by_optics:
            self._filter.blame_optics(self._agreed_mounts[consistency.camera_drifts].value)
        unusable = off or bool(consistency.camera_lies) or self._mount_drift.beyond_limit
        return None if unusable else figure

    def _told_of_stand(self) -> list[Event]:
        """Report once that the optics may be off by the growth of their stand, and once that a new lock ended it."""
        sigma_um, warmed_k = self._stand.sigma_um, self._stand.warmed_k
        far = sigma_um > self._stand_most_um / (2 if self._stand_told else 1)
        if far == self._stand_told:
            return []
        self._stand_told = far
        stands = f"the optics' stand is {warmed_k:+.1f} K from the reference"
        if not far:
            return [MaintenanceOver("stand_growth", stands)]
        anew = "calibrate the optics anew" if self._by_optics else "`ctl shape off` and `on` accept it"
        return [Maintenance("stand_growth", f"{stands}: the figure may be off by {sigma_um:.1f} um; {anew}")]

    def _sees(self, sensor: Sensor) -> bool:
        return self.estimate is not None and self.estimate.sensors[sensor].fresh

    def _news(self, now_s: float, jumped: Collection[str]) -> list[Event]:
        """Report the sensors once they have stood for a second, and every jump."""
        seeing = tuple(int(sensor) for sensor in Sensor if self._sees(sensor))
        if seeing == self._told:
            self._news_s = math.nan
        elif math.isnan(self._news_s):
            self._news_s = now_s
        stands = not math.isnan(self._news_s) and now_s - self._news_s >= _STANDS_S
        if not stands and not jumped:
            return []
        self._told, self._news_s = seeing, math.nan
        return [HeldBy(", ".join(Sensor(n).name.lower() for n in seeing), ", ".join(jumped))]
