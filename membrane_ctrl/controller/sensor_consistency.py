"""Which sensor of a held mirror is wrong, judged by the other sensors and the film."""

import math
from dataclasses import dataclass, field

from membrane_ctrl.config.schema import Config, LoopConfig, PumpConfig
from membrane_ctrl.control import (
    film_health,
    film_monitor,
    gas_balance,
    inner_loop,
    leak_growth,
    maintenance_notice,
    pump_health,
    weather_limits,
)
from membrane_ctrl.control.climate_allowance import MINUTES_MOST_UM, ClimateAllowance
from membrane_ctrl.control.plausibility import (
    LASER_GAP_S,
    PlausibilityCheck,
    PlausibilityState,
)
from membrane_ctrl.control.shape_code import ShapeCode
from membrane_ctrl.controller import state_sets
from membrane_ctrl.controller.duties import FilmSensor
from membrane_ctrl.controller.hold_status import HoldStatus
from membrane_ctrl.controller.recent_count import RecentCount
from membrane_ctrl.controller.redundancy import RedundancyState, RedundancyWatch
from membrane_ctrl.controller.tick import TickInputs
from membrane_ctrl.model.events import (
    Event,
    FaultySensor,
    Maintenance,
    MaintenanceOver,
    Plausibility,
    PumpLearned,
)
from membrane_ctrl.model.reason import NO_REASON, Reason, make_reason
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.state_tree import Count, StateNode
from membrane_ctrl.model.telemetry import State

_WEATHER_STANDS_S = 10.0  # a single bad answer is not reported
# No two cycles have the same noise; a shape that appears twice may be a repeated message
_REPEATS = 3

# A figure is made of frames of up to a cycle ago, and takes this long to compute and arrive.
_FIGURE_TAKES_S = 0.5
# An answer of the laser counts as much as so many ticks without one.
_ANSWER_COUNTS = 4.0
# So that a laser that is back is used after a second.
_MISSING_MAX_S = 4.0
_VERDICTS_MAX = 2


def _find_figure_lag_s(config: Config) -> float:
    """By how much a figure may be older than the laser's reading of the same tick."""
    shape = config.shape
    interval_s = 1 / shape.track_rate_hz if shape.mode == "track" else shape.period_s
    return interval_s + _FIGURE_TAKES_S


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
    gas: gas_balance.GasBalanceState = field(default_factory=gas_balance.GasBalanceState)
    growth: leak_growth.LeakGrowth = field(default_factory=leak_growth.LeakGrowth)
    laser_missing_s: float = 0.0
    doubted: bool = False
    drift_noticed: bool = False
    camera_s: float = -math.inf  # the newest figure
    sag_um: float = math.nan  # by it
    repeats: Count = 0  # of the same sag, to the last bit
    faulty_sensor: FaultySensor = FaultySensor.NONE
    laser_fault_s: float = 0.0
    laser_verdicts: RecentCount = field(default_factory=RecentCount)
    weather_s: float = 0.0
    weather_fault_reported: bool = False
    laser_fault_text: str = ""
    camera_fault_text: str = ""
    laser_gauge_apart: str = ""
    gas_excess: str = ""


class SensorConsistency:
    """Consulted on every tick, before safety judges.

    Parameters
    ----------
    config : Config
        Limits, mirror, and which sensors there are.
    memory : SensorConsistencyState, optional
        From the snapshot of an earlier controller; else nothing has been compared yet.

    Attributes
    ----------
    laser_moved : bool
        From this tick on the laser is used in its new place; the shape loop must lock again.
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
            ClimateAllowance.from_config(config.optics.mirror, config.climate, MINUTES_MOST_UM),
        )
        self._far_um = config.shape.disagreement_max_um
        self._health = film_health.FilmHealth(
            config.loop.flow_most_um_per_s(config.pump), memory.health
        )
        self._pump = pump_health.PumpHealth(config.pump.change_max, memory.pump)
        limits, mirror = config.limits, config.optics.mirror
        self._laser_film = film_monitor.FilmMonitor(
            limits, mirror, "laser", memory.laser_film, config.climate
        )
        self._optics_film = film_monitor.FilmMonitor(
            limits, mirror, "optics", memory.optics_film, config.climate
        )
        self._gas = gas_balance.GasBalance(memory.gas)
        self._nominal_sag_um = 1e3 * config.optics.mirror.sag_mm
        self._by_optics = config.by_optics
        self._follows_optics = config.estimates_centre
        self._redundancy = RedundancyWatch(config, memory.redundancy)
        self._leak_growth_max = config.limits.leak_growth_max
        self._fresh_s = config.shape.fresh_s
        self.laser_moved = False

    @property
    def laser_fault_text(self) -> str:
        """As in `Observation`."""
        return self.memory.laser_fault_text

    @property
    def laser_gauge_apart(self) -> str:
        """As in `Observation`."""
        return self.memory.laser_gauge_apart

    @property
    def gas_excess(self) -> str:
        """As in `Observation`."""
        return self.memory.gas_excess

    @property
    def camera_fault_text(self) -> str:
        """Readings of laser, gauge and camera, if the camera is wrong."""
        return self.memory.camera_fault_text

    @property
    def camera_distrust(self) -> Reason:
        """Why the shape loop must not follow the camera; `NO_REASON` if it may."""
        if not self.camera_fault_text:
            return NO_REASON
        code = (
            ShapeCode.CAMERA_REPEATS if self.memory.repeats >= _REPEATS else ShapeCode.CAMERA_WRONG
        )
        return make_reason(code, self.camera_fault_text)

    def compare_sensors(
        self, inputs: TickInputs, state: State, dt_s: float, held: HoldStatus
    ) -> list[Event]:
        """Observe a tick and return its new events.

        Parameters
        ----------
        inputs : TickInputs
            Time, weather and figure of the tick.
        state : State
            Before the tick; sensors are compared only in states of `ESTIMATED`.
        dt_s : float
            Since the last tick.
        held : HoldStatus
            Readings, setpoint and pump of the held mirror.
        """
        laser_um, gauge_pa = held.laser_um, held.gauge_pressure_pa
        # A new setpoint or bleed changes the gas that the film usually takes
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
        self._count_gas(state, dt_s, held)
        # Two sensors: laser (or optics) and gauge, in each state
        self._compare_with_gauge(state, dt_s, held)
        events = self._report_doubtful_sag(state) + self._notice_drift(state)
        events += self._watch_redundancy(inputs.now_s, state, held)
        if state not in state_sets.ESTIMATED:
            return events + self._reset_comparisons()
        # While the setpoint moves, the loss of gas is no evidence about the film
        moves = state not in (State.SETTLE, State.HOLD) or abs(held.ramp_left_um) > self._far_um
        if moves:
            self.memory.growth.note_ramp()
            self.memory.gas_excess = ""
        self._note_figure(held.figure)
        events += self._judge_weather(inputs, dt_s)
        # Three sensors: which one do the other two contradict?
        blind = not inputs.now_s - self.memory.camera_s <= self._fresh_s
        self._plausibility.note_strains(held.strains)
        faulty = self._plausibility.step(dt_s, laser_um, gauge_pa, held.figure, blind)
        self.memory.laser_fault_s = (
            self.memory.laser_fault_s + dt_s
            if faulty == FaultySensor.LASER and held.held_by_optics
            else 0.0
        )
        # A knock is over: the estimate has the laser's new place. A laser that is knocked again
        # and again is not.
        self.laser_moved = (
            self.memory.laser_fault_s > film_monitor.WARM_S
            and not self.memory.laser_verdicts.too_many(inputs.now_s, _VERDICTS_MAX)
        )
        if self.laser_moved:
            self._plausibility.rebase()
            faulty = FaultySensor.NONE
        if faulty == FaultySensor.LASER and self.memory.faulty_sensor != FaultySensor.LASER:
            self.memory.laser_verdicts.add(inputs.now_s, _VERDICTS_MAX)
        events += self._judge_sensor(faulty)
        # At rest at the setpoint: excess gas, and the health of the film over days
        if moves or state == State.SETTLE:
            return events
        self.memory.gas_excess = self.memory.growth.step(
            held.leak_um_per_s, held.flow_um_per_s, self._limit_growth(inputs), dt_s
        )
        events += [
            _to_event(each) for each in self._health.step(dt_s, held.leak_um_per_s, gauge_pa)
        ]
        return events

    @property
    def sensors_agree(self) -> bool:
        """Laser and camera do not contradict each other, as far as is known."""
        return self.memory.faulty_sensor == FaultySensor.NONE and not self.camera_fault_text

    @property
    def camera_drifts(self) -> bool:
        """The camera is wrong by a slow drift, not by a jump."""
        return self._plausibility.slow_wrong

    @property
    def compares_sensors(self) -> bool:
        """Laser, camera and gauge are compared: a jump of one of them will be judged."""
        return self._plausibility.judges

    def set_gains(self, loop: LoopConfig, pump: PumpConfig) -> None:
        """Judge by these gains and this curve from the next tick on.

        Parameters
        ----------
        loop : LoopConfig
            Its largest flow on this curve is what a growing leak is compared with.
        pump : PumpConfig
            Its `change_max` bounds how much the pump may have changed before it is reported.
        """
        self._health.set_pump(loop.flow_most_um_per_s(pump))
        self._pump.set_pump(pump.change_max)

    def report_pump_curve(self, loop: inner_loop.InnerLoop) -> list[Event]:
        """Return the events after a segment of the pump's probe."""
        report, warnings = self._pump.step(loop.pump_known)
        events: list[Event] = [_to_event(warning) for warning in warnings]
        if report:
            known = loop.pump_known
            scales = (round(value, 4) for value in (known.scale, known.sigma, loop.pump_correction))
            events.append(PumpLearned(*scales))
        return events

    def _reset_comparisons(self) -> list[Event]:
        """Reset: the mirror is not held, or not yet at its setpoint."""
        self.memory.laser_fault_s = 0.0
        self.laser_moved = False
        self.memory.growth.note_ramp()
        self.memory.gas_excess = ""
        self._plausibility.reset()
        return self._judge_sensor(FaultySensor.NONE)

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
        if state not in state_sets.CONNECTED:
            self._laser_film.reset()
            self._optics_film.reset()
            self.memory.laser_gauge_apart = ""
            return
        gauge_pa = held.gauge_pressure_pa
        for monitor in (self._laser_film, self._optics_film):
            monitor.note_strains(held.strains)
        by_laser = self._laser_film.step(dt_s, held.laser_um, held.trim_um, gauge_pa)
        by_optics = self._optics_film.step(dt_s, held.sag_um - self._nominal_sag_um, 0.0, gauge_pa)
        if not self._optics_alone:
            self.memory.laser_gauge_apart = by_laser
        else:
            by_gas = self._gas.explain_contradiction(self._optics_film.share_of_minutes)
            self.memory.laser_gauge_apart = by_optics or by_gas

    def _count_gas(self, state: State, dt_s: float, held: HoldStatus) -> None:
        """Count the gas that enters while the optics hold the mirror in the lost laser's place."""
        rests = state in state_sets.AT_SETPOINT and abs(held.ramp_left_um) <= self._far_um
        alone = rests and self._optics_alone and not self._by_optics
        self._gas.step(held.flow_um_per_s, held.leak_um_per_s, alone, dt_s)

    @property
    def _film_in_use(self) -> film_monitor.FilmMonitor:
        return self._optics_film if self._optics_alone else self._laser_film

    def _notice_drift(self, state: State) -> list[Event]:
        """Report once that the displacement and the gauge drift apart, which climate may hide a
        sensor's drift in.
        """
        monitor = self._film_in_use
        noticed = state in state_sets.CONNECTED and monitor.drifting
        if noticed == self.memory.drift_noticed:
            return []
        self.memory.drift_noticed = noticed
        sensor = "optics" if self._optics_alone else "laser"
        if not noticed:
            return [MaintenanceOver("slow_drift", "the two are near each other again")]
        message = (
            f"{sensor} and gauge have moved {monitor.drift_um:.0f} µm apart within a day: "
            "humidity and "
            "temperature of the film do this, and so does a sensor that drifts. "
        )
        if monitor.sees_climate:
            message += (
                f"The climate's sensors explain {monitor.explained_um:+.0f} µm. Compare the "
                "laser with a ruler if that is not near"
            )
        else:
            message += (
                "Compare the laser with a ruler, or connect a film thermometer and a hygrometer"
            )
        return [Maintenance("slow_drift", message)]

    def _watch_redundancy(self, now_s: float, state: State, held: HoldStatus) -> list[Event]:
        """Report a lost sensor of the film while the pump is driven."""
        present = {
            FilmSensor.LASER: math.isfinite(held.laser_um),
            FilmSensor.OPTICS: held.held_by_optics
            or (held.optics_usable and math.isfinite(held.sag_um)),
            FilmSensor.GAUGE: math.isfinite(held.gauge_pressure_pa),
        }
        return self._redundancy.step(now_s, state in state_sets.MOVING, present)

    def _report_doubtful_sag(self, state: State) -> list[Event]:
        """Report once that optics without a laser may have missed a jump of the film, until the
        next start.
        """
        doubted_now = self._optics_alone and self._optics_film.doubted
        doubted = state in state_sets.CONNECTED and (self.memory.doubted or doubted_now)
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

    def _note_figure(self, estimate: ShapeEstimate | None) -> None:
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

    def _limit_growth(self, inputs: TickInputs) -> float:
        """Allowed growth of the leak: unlimited while the camera agrees with a laser that is there,
        small while the two contradict each other.
        """
        if self._optics_alone or self.memory.repeats >= _REPEATS:
            return self._leak_growth_max
        if not inputs.now_s - self.memory.camera_s <= self._fresh_s:
            return self._leak_growth_max
        return (
            math.inf
            if self.memory.faulty_sensor == FaultySensor.NONE
            else leak_growth.CONTRADICTED_MOST
        )

    def _judge_weather(self, inputs: TickInputs, dt_s: float) -> list[Event]:
        """Report once that a barometer or thermometer is implausible; the loop ignores it."""
        reading = inputs.reading
        if reading is None:
            return []
        failure = weather_limits.explain_weather_fault(
            reading.ambient_pressure_pa, reading.air_temperature_c
        )
        # For how long the sensor has been other than reported: a single bad reading is no fault
        self.memory.weather_s = (
            self.memory.weather_s + dt_s
            if bool(failure) != self.memory.weather_fault_reported
            else 0.0
        )
        if self.memory.weather_s < _WEATHER_STANDS_S:
            return []
        self.memory.weather_fault_reported = bool(failure)
        self.memory.weather_s = 0.0
        return [
            (Maintenance if failure else MaintenanceOver)(
                "weather_sensor", failure or "the sensor is back"
            )
        ]

    def _judge_sensor(self, faulty: FaultySensor) -> list[Event]:
        """Keep which sensor is wrong, in words, and report it when that changes."""
        repeats = self.memory.repeats >= _REPEATS
        seen = (
            str(self._plausibility.changes)
            if faulty in (FaultySensor.LASER, FaultySensor.OPTICS)
            else ""
        )
        self.memory.laser_fault_text = seen if faulty == FaultySensor.LASER else ""
        if repeats:
            self.memory.camera_fault_text = (
                "the camera repeats one shape to the last bit: restart it"
            )
        elif faulty != FaultySensor.OPTICS:
            self.memory.camera_fault_text = ""
        elif not self.camera_fault_text:  # changed numbers do not make a new reason
            self.memory.camera_fault_text = (
                f"laser and gauge agree that the camera is wrong: {seen}"
            )
        if faulty == self.memory.faulty_sensor:
            return []
        self.memory.faulty_sensor = faulty
        seen = (
            str(self._plausibility.changes)
            if self._plausibility.watching
            else "compared again from here on"
        )
        return [Plausibility(faulty, seen)]


def _to_event(warning: maintenance_notice.MaintenanceNotice) -> Event:
    return (Maintenance if warning.bad else MaintenanceOver)(warning.name, warning.message)
