"""The sensors of a held mirror: which one is wrong by the others and the film, what wears out,
which ones hold it.
"""

import math
from collections import deque
from collections.abc import Collection
from dataclasses import dataclass, field, replace

from membrane_ctrl.config.schema import Config, LoopConfig, PumpConfig, ShapeConfig
from membrane_ctrl.control import (
    camera_mount,
    film_health,
    film_monitor,
    inner_loop,
    leak_growth,
    maintenance_notice,
    pump_health,
    weather_limits,
)
from membrane_ctrl.control.camera_mount import StandGrowth
from membrane_ctrl.control.centre import LOCK_FRAMES, CentreFilter, CentreState
from membrane_ctrl.control.centre_estimate import CentreEstimate, CentreReadings, Sensor
from membrane_ctrl.control.filters import LowPass
from membrane_ctrl.control.plausibility import (
    LASER_GAP_S,
    REFERENCE_S,
    SLOW_REFERENCE_S,
    Liar,
    PlausibilityCheck,
    PlausibilityState,
)
from membrane_ctrl.control.shape_loop import ShapeCode
from membrane_ctrl.controller import safety
from membrane_ctrl.controller.protection import FilmSensor
from membrane_ctrl.controller.redundancy import RedundancyState, RedundancyWatch
from membrane_ctrl.controller.scene import Scene
from membrane_ctrl.controller.tick import TickInputs
from membrane_ctrl.model.events import (
    Event,
    FaultySensor,
    HeldBy,
    Maintenance,
    MaintenanceOver,
    Plausibility,
    PumpLearned,
)
from membrane_ctrl.model.reason import NO_REASON, Reason, make_reason
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.state_tree import Count, StateNode
from membrane_ctrl.model.telemetry import ShapeState, State

_WEATHER_STANDS_S = 10.0  # a single bad answer is not reported
# No two cycles have the same noise; a shape that appears twice may be a repeated message
_REPEATS = 3
_FAULTY = {
    Liar.NOBODY: FaultySensor.NONE,
    Liar.UNSURE: FaultySensor.UNKNOWN,
    Liar.LASER: FaultySensor.LASER,
    Liar.OPTICS: FaultySensor.OPTICS,
}


@dataclass(frozen=True, slots=True)
class HoldStatus:
    """State of the held mirror."""

    # NaN for old, bad or stuck readings and jumps: a mean over ten seconds must not include a bit
    # error
    laser_um: float
    gauge_pressure_pa: float
    setpoint_um: float  # as commanded
    trim_um: float  # by the shape loop
    # the rest of the setpoint's ramp. The camera lags by a cycle, and the gauge is linear only near
    # its reference: on a long ramp they would contradict a correct laser
    ramp_left_um: float
    leak_um_per_s: float  # as the inner loop estimates it; NaN without
    flow_um_per_s: float  # of the pump; NaN without
    bleed_fraction: float  # of the vent, held open on purpose
    # they see the centre, and its estimate is held: a laser that moved is known
    optics_hold: bool = False
    sag_um: float = math.nan  # by the newest figure; NaN without a usable one
    optics_usable: bool = True  # the estimate, or the shape loop, uses the figures
    figure: ShapeEstimate | None = None  # that arrived in this tick and may be used


def hold_status(
    scene: Scene, last: inner_loop.LoopOutput, optics_hold: bool, optics_usable: bool = True
) -> HoldStatus:
    """The mirror after the tick's reading was taken; `last` is what the loop gave in the tick
    before.
    """
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


@dataclass(slots=True)
class RecentCount(StateNode):
    """Counts events of the last ten minutes."""

    times_s: deque[float] = field(default_factory=deque)

    def add(self, now_s: float, most: int) -> None:
        """Count one; no more are kept than `too_many` needs."""
        self.times_s.append(now_s)
        if len(self.times_s) > most + 1:
            self.times_s.popleft()

    def too_many(self, now_s: float, most: int) -> bool:
        """Whether there were more than allowed."""
        return len(self.times_s) > most and now_s - self.times_s[0] <= _UNSTEADY_S


@dataclass(slots=True)
class SensorConsistencyState(StateNode):
    """What is remembered of the sensors from tick to tick."""

    setpoint_um: float  # as last commanded
    bleed_fraction: float
    plausibility: PlausibilityState = field(default_factory=PlausibilityState)
    health: film_health.FilmHealthState = field(default_factory=film_health.FilmHealthState)
    pump: pump_health.PumpHealthState = field(default_factory=pump_health.PumpHealthState)
    laser_film: film_monitor.FilmMonitorState = field(default_factory=film_monitor.FilmMonitorState)
    optics_film: film_monitor.FilmMonitorState = field(
        default_factory=film_monitor.FilmMonitorState
    )
    redundancy: RedundancyState = field(default_factory=RedundancyState)
    growth: leak_growth.LeakGrowth = field(default_factory=leak_growth.LeakGrowth)
    laser_missing_s: float = 0.0
    doubted: bool = False
    drift_noticed: bool = False
    camera_s: float = -math.inf  # the newest figure
    sag_um: float = math.nan  # by it
    repeats: Count = 0  # of the same sag, to the last bit
    liar: Liar = Liar.NOBODY
    lies_s: float = 0.0
    laser_verdicts: RecentCount = field(default_factory=RecentCount)
    weather_s: float = 0.0
    weather_told: bool = False
    laser_lies: str = ""
    camera_lies: str = ""
    laser_gauge_apart: str = ""
    gas_excess: str = ""


class SensorConsistency:
    """Consulted on every tick, before safety judges.

    Parameters
    ----------
    config : Config
    memory : SensorConsistencyState, optional

    Attributes
    ----------
    laser_moved : bool
        From this tick on the laser is believed in its new place; the shape loop must lock anew.
    """

    def __init__(self, config: Config, memory: SensorConsistencyState | None = None) -> None:
        self.memory = memory or SensorConsistencyState(
            config.loop.setpoint_um, config.loop.bleed_fraction
        )
        memory = self.memory
        self._plausibility = PlausibilityCheck(
            config.shape.disagreement_max_um,
            1e3 * config.optics.mirror.sag_mm,
            _find_figure_lag_s(config),
            memory.plausibility,
        )
        self._far_um = config.shape.disagreement_max_um
        self._health = film_health.FilmHealth(
            config.loop.flow_most_um_per_s(config.pump), memory.health
        )
        self._pump = pump_health.PumpHealth(config.pump.change_max, memory.pump)
        limits, mirror = config.limits, config.optics.mirror
        self._laser_film = film_monitor.FilmMonitor(limits, mirror, "laser", memory.laser_film)
        self._optics_film = film_monitor.FilmMonitor(limits, mirror, "optics", memory.optics_film)
        self._nominal_sag_um = 1e3 * config.optics.mirror.sag_mm
        self._by_optics = config.by_optics
        self._follows_optics = config.estimator.process_value != "laser"
        self._redundancy = RedundancyWatch(config, memory.redundancy)
        self._leak_growth_max = config.limits.leak_growth_max
        self._fresh_s = config.shape.fresh_s
        self.laser_moved = False

    @property
    def laser_lies(self) -> str:
        """As in `Observation`."""
        return self.memory.laser_lies

    @property
    def laser_gauge_apart(self) -> str:
        """As in `Observation`."""
        return self.memory.laser_gauge_apart

    @property
    def gas_excess(self) -> str:
        """As in `Observation`."""
        return self.memory.gas_excess

    @property
    def camera_lies(self) -> str:
        """Readings of laser, gauge and camera, if the camera is wrong."""
        return self.memory.camera_lies

    @property
    def camera_distrust(self) -> Reason:
        """Why the shape loop must not follow the camera; `NO_REASON` if it may."""
        if not self.camera_lies:
            return NO_REASON
        code = (
            ShapeCode.CAMERA_REPEATS if self.memory.repeats >= _REPEATS else ShapeCode.CAMERA_WRONG
        )
        return make_reason(code, self.camera_lies)

    def ask(self, inputs: TickInputs, state: State, dt_s: float, held: HoldStatus) -> list[Event]:
        """Observe a tick and return its new events; judges only a held mirror."""
        laser_um, gauge_pa = held.laser_um, held.gauge_pressure_pa
        if held.setpoint_um != self.memory.setpoint_um:
            self.memory.setpoint_um = held.setpoint_um
            self._health.setpoint_moved()
        if state != State.HOLD or held.bleed_fraction != self.memory.bleed_fraction:
            self.memory.bleed_fraction = held.bleed_fraction
            self.memory.growth.reset()
        # A laser that answers now and then counts as missing; one that misses a reading now and
        # then does not.
        change_s = -_ANSWER_COUNTS * dt_s if math.isfinite(laser_um) else dt_s
        self.memory.laser_missing_s = min(
            max(self.memory.laser_missing_s + change_s, 0.0), _MISSING_MAX_S
        )
        self._compare_with_gauge(state, dt_s, held)
        events = self._doubt_sag(state) + self._notice_drift(state)
        events += self._watch_redundancy(inputs.now_s, state, held)
        if state not in safety.ESTIMATED:
            return events + self._rest()
        moves = state not in (State.SETTLE, State.HOLD) or abs(held.ramp_left_um) > self._far_um
        if moves:
            self.memory.growth.moves()
            self.memory.gas_excess = ""
        self._look_at_camera(held.figure)
        events += self._judge_weather(inputs, dt_s)
        blind = not inputs.now_s - self.memory.camera_s <= self._fresh_s
        liar = self._plausibility.step(dt_s, laser_um, gauge_pa, held.figure, blind)
        self.memory.lies_s = (
            self.memory.lies_s + dt_s if liar == Liar.LASER and held.optics_hold else 0.0
        )
        # A knock is over: the estimate knows the laser's new place. A laser that is knocked again
        # and again is not.
        self.laser_moved = (
            self.memory.lies_s > film_monitor.WARM_S
            and not self.memory.laser_verdicts.too_many(inputs.now_s, _VERDICTS_MAX)
        )
        if self.laser_moved:
            self._plausibility.rebase()
            liar = Liar.NOBODY
        if liar == Liar.LASER and self.memory.liar != Liar.LASER:
            self.memory.laser_verdicts.add(inputs.now_s, _VERDICTS_MAX)
        events += self._judge(liar)
        if moves or state == State.SETTLE:
            return events
        self.memory.gas_excess = self.memory.growth.step(
            held.leak_um_per_s, held.flow_um_per_s, self._most_growth(inputs), dt_s
        )
        events += [
            _of_warning(each) for each in self._health.step(dt_s, held.leak_um_per_s, gauge_pa)
        ]
        return events

    @property
    def agree(self) -> bool:
        """Laser and camera do not contradict each other, as far as is known."""
        return self.memory.liar == Liar.NOBODY and not self.camera_lies

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
        self.memory.lies_s = 0.0
        self.laser_moved = False
        self.memory.growth.moves()
        self.memory.gas_excess = ""
        self._plausibility.reset()
        return self._judge(Liar.NOBODY)

    @property
    def _optics_alone(self) -> bool:
        """Whether the optics show the film in the laser's place."""
        missing = self.memory.laser_missing_s > LASER_GAP_S
        return self._by_optics or (self._follows_optics and missing)

    def _compare_with_gauge(self, state: State, dt_s: float, held: HoldStatus) -> None:
        """Compare laser and optics with the gauge, each by itself; the one that shows the film
        decides.

        Both comparisons run all the time, so that the optics have a reference when the laser is
        lost.
        """
        if state not in safety.CONNECTED:
            self._laser_film.reset()
            self._optics_film.reset()
            self.memory.laser_gauge_apart = ""
            return
        gauge_pa = held.gauge_pressure_pa
        by_laser = self._laser_film.step(dt_s, held.laser_um, held.trim_um, gauge_pa)
        by_optics = self._optics_film.step(dt_s, held.sag_um - self._nominal_sag_um, 0.0, gauge_pa)
        self.memory.laser_gauge_apart = by_optics if self._optics_alone else by_laser

    @property
    def _film_in_use(self) -> film_monitor.FilmMonitor:
        return self._optics_film if self._optics_alone else self._laser_film

    def _notice_drift(self, state: State) -> list[Event]:
        """Report once that the displacement and the gauge drift apart, which climate may hide a
        sensor's drift in.
        """
        monitor = self._film_in_use
        noticed = state in safety.CONNECTED and monitor.drifting
        if noticed == self.memory.drift_noticed:
            return []
        self.memory.drift_noticed = noticed
        sensor = "optics" if self._optics_alone else "laser"
        if not noticed:
            return [MaintenanceOver("slow_drift", "the two are near each other again")]
        message = (
            f"{sensor} and gauge have moved {monitor.drift_um:.0f} µm apart within a day: "
            "humidity and "
            "temperature of the film do this, and so does a sensor that drifts. Compare the "
            "laser with a ruler"
        )
        return [Maintenance("slow_drift", message)]

    def _watch_redundancy(self, now_s: float, state: State, held: HoldStatus) -> list[Event]:
        """Report a lost sensor of the film while the pump is driven."""
        present = {
            FilmSensor.LASER: math.isfinite(held.laser_um),
            FilmSensor.OPTICS: held.optics_hold
            or (held.optics_usable and math.isfinite(held.sag_um)),
            FilmSensor.GAUGE: math.isfinite(held.gauge_pressure_pa),
        }
        return self._redundancy.step(now_s, state in safety.MOVING, present)

    def _doubt_sag(self, state: State) -> list[Event]:
        """Report once that optics without a laser may have missed a jump of the film, until the
        next start.
        """
        doubted_now = self._optics_alone and self._optics_film.doubted
        doubted = state in safety.CONNECTED and (self.memory.doubted or doubted_now)
        if doubted == self.memory.doubted:
            return []
        self.memory.doubted = doubted
        if not doubted:
            return [MaintenanceOver("sag_doubted", "the comparison begins again")]
        return [
            Maintenance(
                "sag_doubted",
                "the gauge shows a jump of the film that the camera missed: restart the hold",
            )
        ]

    def _look_at_camera(self, estimate: ShapeEstimate | None) -> None:
        """Note when the camera last showed the film, and how often it repeated one shape bit by
        bit.
        """
        if estimate is None:
            return
        self.memory.camera_s = estimate.time_s
        self.memory.repeats = (
            self.memory.repeats + 1 if estimate.sag_um == self.memory.sag_um else 0
        )
        self.memory.sag_um = estimate.sag_um

    def _most_growth(self, inputs: TickInputs) -> float:
        """Allowed growth of the leak: unlimited while the camera
        agrees with a laser that is there.
        """
        if self._optics_alone or self.memory.repeats >= _REPEATS:
            return self._leak_growth_max
        if not inputs.now_s - self.memory.camera_s <= self._fresh_s:
            return self._leak_growth_max
        return math.inf if self.memory.liar == Liar.NOBODY else leak_growth.CONTRADICTED_MOST

    def _judge_weather(self, inputs: TickInputs, dt_s: float) -> list[Event]:
        """Report once that a barometer or thermometer is implausible; the loop ignores it."""
        reading = inputs.reading
        if reading is None:
            return []
        failure = weather_limits.weather_fault(
            reading.ambient_pressure_pa, reading.air_temperature_c
        )
        self.memory.weather_s = (
            self.memory.weather_s + dt_s if bool(failure) != self.memory.weather_told else 0.0
        )
        if self.memory.weather_s < _WEATHER_STANDS_S:
            return []
        self.memory.weather_told = bool(failure)
        self.memory.weather_s = 0.0
        return [
            (Maintenance if failure else MaintenanceOver)(
                "weather_sensor", failure or "the sensor is back"
            )
        ]

    def _judge(self, liar: Liar) -> list[Event]:
        repeats = self.memory.repeats >= _REPEATS
        seen = str(self._plausibility.changes) if liar in (Liar.LASER, Liar.OPTICS) else ""
        self.memory.laser_lies = seen if liar == Liar.LASER else ""
        if repeats:
            self.memory.camera_lies = "the camera repeats one shape to the last bit: restart it"
        elif liar != Liar.OPTICS:
            self.memory.camera_lies = ""
        elif not self.camera_lies:  # changed numbers do not make a new reason
            self.memory.camera_lies = f"laser and gauge agree that the camera is wrong: {seen}"
        if liar == self.memory.liar:
            return []
        self.memory.liar = liar
        seen = (
            str(self._plausibility.changes)
            if self._plausibility.watching
            else "compared anew from here on"
        )
        return [Plausibility(_FAULTY[liar], seen)]


def _of_warning(warning: maintenance_notice.FilmWarning) -> Event:
    return (Maintenance if warning.bad else MaintenanceOver)(warning.name, warning.message)


_STAND_SHARE = 0.25  # of the band: a growth of the optics' stand that may be this large is told
# a sensor that comes and goes within this, as a slower camera does at first, is not reported
_STANDS_S = 1.5


_UNSTEADY_MESSAGE = (
    "the optics have jumped against the laser again and again; they are left out, and the "
    "mirror follows the laser. "
    "Look for vibration, reflections or a loose camera, then `ctl shape off` and `on` use "
    "them again"
)
_UNSTEADY_ALONE_MESSAGE = (
    "the optics have jumped again and again, and no laser shows which jumps are the film's; they "
    "are left out. Look for vibration, reflections, a loose camera or wrong times of its frames, "
    "then restart the hold"
)
_JUMP_TAKES_S = 2.0  # until the estimate has followed a jump of the laser
# So long may the estimate be held by pump, gas and weather alone, beyond the time in which a sensor
# counts as fresh: a start without a figure yet. At the pump's full flow the film moves by 5 µm.
_BLIND_S = 1.0


@dataclass(slots=True)
class MountDriftState(StateNode):
    """How far the mount has drifted."""

    last_um: float = 0.0
    drift_um: float = 0.0
    optics_jumps: RecentCount = field(default_factory=RecentCount)
    jump_left_s: float = 0.0  # until the estimate has followed a jump of the laser
    beyond_limit: bool = False


class MountDrift:
    """How far the estimate lets the laser's mount drift: as far as the shape loop's trim,
    `shape.trim_max_um`.

    Laser and optics that drift apart do not show which of them drifts. Beyond the limit the optics
    are left out, the mirror follows the laser, and a person decides. A jump that the estimate found
    to be the laser's is no drift.
    """

    def __init__(
        self, shape: ShapeConfig, memory: MountDriftState | None = None, by_optics: bool = False
    ) -> None:
        self._most_um = shape.trim_max_um
        self._by_optics = by_optics
        self.memory = memory or MountDriftState()

    def start(self, mount_um: float) -> None:
        """Count from a place of the mount, in µm."""
        self.memory.start_afresh()
        self.memory.last_um = mount_um

    @property
    def beyond_limit(self) -> bool:
        """The limit is passed."""
        return self.memory.beyond_limit

    def step(
        self, mount_um: float, jumped: Collection[Sensor], now_s: float, dt_s: float
    ) -> list[Event]:
        """Follow the mount; returns the notice once the limit is passed, which only `start` takes
        back.

        `jumped`: the sensors of which the estimate has found a jump in this tick. Optics that jump
        again and again lead the estimate away in steps that each look like a knock; they are left
        out as well.
        """
        memory = self.memory
        moved_um = mount_um - memory.last_um
        memory.last_um = mount_um
        if memory.beyond_limit:
            return []
        if Sensor.OPTICS in jumped:
            memory.optics_jumps.add(now_s, _OPTICS_JUMPS_MAX)
            if memory.optics_jumps.too_many(now_s, _OPTICS_JUMPS_MAX):
                memory.beyond_limit = True
                message = _UNSTEADY_ALONE_MESSAGE if self._by_optics else _UNSTEADY_MESSAGE
                return [Maintenance("optics_unsteady", message)]
        laser_jumped = Sensor.LASER in jumped
        memory.jump_left_s = _JUMP_TAKES_S if laser_jumped else max(0.0, memory.jump_left_s - dt_s)
        if memory.jump_left_s == 0.0:
            memory.drift_um += moved_um
        memory.beyond_limit = abs(memory.drift_um) > self._most_um
        if not memory.beyond_limit:
            return []
        message = (
            f"laser and optics have drifted {self._most_um:g} µm apart; which of them is not "
            "known, and the mirror "
            "follows the laser. Check its mount and the optics, then `ctl shape off` and "
            "`on` accept the figure"
        )
        return [Maintenance("trim_limit", message)]


@dataclass(slots=True)
class HoldersState(StateNode):
    """What the estimate remembers from tick to tick."""

    centre: CentreState | None = None  # None while the estimate does not run
    locking: bool = False
    # Means of the mount while laser and camera agree: what the filter gave to the mount after that
    # was the film's. The slow one serves if a slow drift of the camera is to be undone.
    agreed_mount: LowPass = field(default_factory=LowPass)
    slowly_agreed_mount: LowPass = field(default_factory=LowPass)
    mount_drift: MountDriftState = field(default_factory=MountDriftState)
    stand: camera_mount.StandGrowthState = field(default_factory=camera_mount.StandGrowthState)
    stand_told: bool = False
    told: tuple[int, ...] | None = None  # the sensors, as reported
    news_s: float = math.nan
    estimate: CentreEstimate | None = None
    blind_since_s: float = math.nan  # the estimate follows neither laser nor optics since then
    blind: bool = False  # it has done so for too long


class Holders:
    """Runs the estimate beside the states if `estimator.process_value` asks for it."""

    def __init__(self, config: Config, memory: HoldersState | None = None) -> None:
        self.memory = memory or HoldersState()
        self._config = config.estimator
        self._loop = config.loop
        self._wanted = config.estimator.process_value != "laser"
        self._by_optics = config.by_optics
        self._sag_zero_um = 1e3 * config.optics.mirror.sag_mm if config.by_optics else math.nan
        centre = self.memory.centre
        self._filter = (
            None if centre is None else CentreFilter(config.estimator, config.loop, centre)
        )
        self._tracks = config.shape.mode == "track"
        self._mount_drift = MountDrift(config.shape, self.memory.mount_drift, config.by_optics)
        self._stand = StandGrowth(config.estimator, self.memory.stand)
        self._stand_most_um = _STAND_SHARE * config.limits.band_um

    @property
    def estimate(self) -> CentreEstimate | None:
        """The newest estimate; None while it does not run."""
        return self.memory.estimate

    @property
    def optics_hold(self) -> bool:
        """Whether the mirror is held without a laser: the optics see it."""
        if self.memory.estimate is None or self._filter is None:
            return False
        return self._filter.frames >= LOCK_FRAMES and self._sees(Sensor.OPTICS)

    @property
    def blind(self) -> bool:
        """Whether the estimate has followed neither laser nor optics for a second: it then only
        predicts the centre by pump and weather, and nothing may be held by it.
        """
        return self.memory.blind

    @property
    def optics_left_out(self) -> bool:
        """Whether figures are not used until a person accepts the optics again."""
        return self._mount_drift.beyond_limit

    def set_gains(self, loop: LoopConfig) -> None:
        """Take the feed-forward's gains from other settings."""
        self._loop = loop
        if self._filter is not None:
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
            self._stop()
            if self._by_optics and state not in safety.MOVING:
                self._mount_drift.start(0.0)  # a resumed hold judges the optics by itself
            return []
        laser_um = math.nan if consistency.laser_lies else scene.observer.moving_laser_um
        if self._filter is None:
            start_um = last.filtered_um if math.isfinite(last.filtered_um) else seen_um
            if not math.isfinite(start_um):
                return []
            self._filter = self._start(start_um, scene)
        if self._is_anchor(inputs.estimate):
            # another anchor shows the same film up to a micrometre higher or lower
            self._filter.relock()
        figure = self._select_figure(self._filter, figures.accepted, scene.dt_s, shape, consistency)
        reading = inputs.reading
        self._stand.step(
            weather_limits.believed_weather(math.nan, reading.air_temperature_c)[1]
            if reading
            else math.nan,
            scene.dt_s,
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
        self.memory.estimate = estimate = self._filter.step(readings, scene.dt_s)
        self._note_blindness(inputs.now_s)
        scene.trim_um = estimate.mount_um
        news = [*self._news(inputs.now_s, estimate.jumped), *self._told_of_stand()]
        news += self._mount_drift.step(
            estimate.mount_um, estimate.jumped_sensors, inputs.now_s, scene.dt_s
        )
        if self._sees(Sensor.OPTICS):
            sigma_um = math.hypot(estimate.sigma_um, self._stand.sigma_um)
            self.memory.estimate = replace(estimate, sigma_um=sigma_um)
        return news

    def _stop(self) -> None:
        self._filter = None
        self.memory.centre = None
        self.memory.estimate = None
        self.memory.told = None
        self.memory.blind_since_s = math.nan
        self.memory.blind = False

    def _note_blindness(self, now_s: float) -> None:
        """Note since when neither laser nor optics correct the estimate."""
        memory = self.memory
        if self._sees(Sensor.LASER) or self._sees(Sensor.OPTICS):
            memory.blind_since_s = math.nan
        elif math.isnan(memory.blind_since_s):
            memory.blind_since_s = now_s
        # false while `blind_since_s` is NaN
        memory.blind = now_s - memory.blind_since_s > _BLIND_S

    def _start(self, start_um: float, scene: Scene) -> CentreFilter:
        """Begin an estimate at a displacement."""
        memory = self.memory
        memory.centre = CentreState()
        begun = CentreFilter(self._config, self._loop, memory.centre)
        begun.start(
            start_um, scene.loop.mean_flow_um_per_s, scene.trim_um, self._find_sag_zero_um(scene)
        )
        memory.agreed_mount.reset(scene.trim_um)
        memory.slowly_agreed_mount.reset(scene.trim_um)
        self._mount_drift.start(scene.trim_um)
        self._stand.lock()
        return begun

    def _find_sag_zero_um(self, scene: Scene) -> float:
        """Sag at true centre 0, where the optics replace the laser; NaN where they are to be
        locked.
        """
        if self._by_optics:
            return self._sag_zero_um
        observer = scene.observer
        return (
            observer.figures.zero_um + scene.trim_um if observer.optics_replace_laser else math.nan
        )

    def _is_anchor(self, figure: ShapeEstimate | None) -> bool:
        """Whether a figure is a full set that the tracking's next frames count from."""
        return (
            figure is not None
            and self._tracks
            and figure.kind == "full"
            and figure.verdict != "rejected"
        )

    def _select_figure(
        self,
        centre: CentreFilter,
        figure: ShapeEstimate | None,
        dt_s: float,
        shape: ShapeState,
        consistency: SensorConsistency,
    ) -> ShapeEstimate | None:
        """The tick's figure if the filter may use it; locks the filter again where its reference
        ended.
        """
        memory = self.memory
        off = shape == ShapeState.OFF and not self._by_optics
        if memory.locking and not off:
            centre.relock()
            self._mount_drift.start(memory.estimate.mount_um if memory.estimate else 0.0)
        memory.locking = off
        if consistency.agree and memory.estimate is not None:
            memory.agreed_mount.update(memory.estimate.mount_um, dt_s, REFERENCE_S)
            memory.slowly_agreed_mount.update(memory.estimate.mount_um, dt_s, SLOW_REFERENCE_S)
        elif consistency.camera_lies and centre.frames and not self._by_optics:
            agreed = (
                memory.slowly_agreed_mount if consistency.camera_drifts else memory.agreed_mount
            )
            centre.blame_optics(agreed.value)
        unusable = off or bool(consistency.camera_lies) or self._mount_drift.beyond_limit
        return None if unusable else figure

    def _told_of_stand(self) -> list[Event]:
        """Report once that the optics may be off by the growth of their stand, and once that a new
        lock ended it.
        """
        sigma_um, warmed_k = self._stand.sigma_um, self._stand.warmed_k
        memory = self.memory
        far = sigma_um > self._stand_most_um / (2 if memory.stand_told else 1)
        if far == memory.stand_told:
            return []
        memory.stand_told = far
        stands = f"the optics' stand is {warmed_k:+.1f} K from the reference"
        if not far:
            return [MaintenanceOver("stand_growth", stands)]
        anew = (
            "calibrate the optics anew" if self._by_optics else "`ctl shape off` and `on` accept it"
        )
        return [
            Maintenance(
                "stand_growth", f"{stands}: the figure may be off by {sigma_um:.1f} µm; {anew}"
            )
        ]

    def _sees(self, sensor: Sensor) -> bool:
        estimate = self.memory.estimate
        return estimate is not None and estimate.sensors[sensor].fresh

    def _news(self, now_s: float, jumped: Collection[str]) -> list[Event]:
        """Report the sensors once they have stood for a second, and every jump."""
        seeing = tuple(int(sensor) for sensor in Sensor if self._sees(sensor))
        memory = self.memory
        if seeing == memory.told:
            memory.news_s = math.nan
        elif math.isnan(memory.news_s):
            memory.news_s = now_s
        stands = not math.isnan(memory.news_s) and now_s - memory.news_s >= _STANDS_S
        if not stands and not jumped:
            return []
        memory.told = seeing
        memory.news_s = math.nan
        return [HeldBy(tuple(Sensor(n).name.lower() for n in seeing), tuple(jumped))]
