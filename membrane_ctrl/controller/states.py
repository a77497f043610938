"""States as small functions: each reads the tick, sets the pump and returns the next state.

They decide only what to do when all is well. Safety is judged around them on every tick
(`controller.Controller.tick`), and no handler can bypass it.
"""

import math
from collections.abc import Callable

from membrane_ctrl.control import inner_loop
from membrane_ctrl.control.centre_estimate import Sensor
from membrane_ctrl.control.experiments.experiment import BenchSample, ExperimentEnd, Finished
from membrane_ctrl.controller import commands, pump_obeys
from membrane_ctrl.controller.scene import Scene
from membrane_ctrl.model.errors import Exit
from membrane_ctrl.model.lock import describe_locks
from membrane_ctrl.model.reason import NO_REASON, Reason, WhyCode, make_reason
from membrane_ctrl.model.telemetry import SafeLevel, State

_LOCKS_SHOWN = 3  # in the operator's line; the status has all of them
# by then a pump that was left running has stopped: lag 0.15 s, transport 0.1 s
# (docs/explanation/physics.md)
_PUMP_STANDS_S = 0.5
_NO_VENT = "no vent is fitted, the leak lowers the mirror"
_VENTED_S = 900.0  # twice the twin's time from 600 Pa; longer means a shut vent or a wrong gauge
# A `stop` with a pump that does not obey: after this long with the vent open and the pump commanded
# off, report that the pump still runs. Shorter than the 30 s that the service manager allows.
_STOP_GIVES_UP_S = 10.0


def standby(scene: Scene) -> State:
    """Keep the pump off until someone requests a hold; a lock or an open interlock cancels the
    request.
    """
    interlock = scene.interlocks.describe_open(scene.interlocks.last_mask)
    if scene.locks:
        scene.hold_wanted = False
        locked = f"standby: locked: {describe_locks(scene.locks, _LOCKS_SHOWN)}"
        scene.explain(WhyCode.LOCKED, locked, *(lock.word for lock in scene.locks))
        return State.STANDBY
    if interlock:
        scene.hold_wanted = False
    if scene.hold_wanted:
        scene.explain(WhyCode.HOLD_REQUESTED, "a hold was requested")
        return State.CHECK
    if scene.latched:
        scene.explain(WhyCode.FAULT_LATCHED, f"standby: a fault is latched: {scene.latched}")
    elif interlock:
        scene.explain(WhyCode.INTERLOCK_OPEN, f"standby: {interlock}", scene.interlocks.last_mask)
    else:
        scene.explain(WhyCode.STANDBY, "standby: no hold was requested")
    return State.STANDBY


def check(scene: Scene) -> State:
    """Require good sensors for a while and a film that responds before the pump may run."""
    missing = _missing(scene)
    if missing == NO_REASON:
        scene.last_good_s = scene.now_s
    # occasional lost answers do not make a bad sensor
    gone = not scene.now_s - scene.last_good_s <= scene.config.limits.stale_s
    good_s = scene.stay_good(not gone)
    if scene.state_age_s > scene.config.states.check_timeout_s + scene.observer.waited_s:
        why = missing.text or "readings come and go, or the actuator test is not done"
        scene.overdue = (
            f"sensors still not good after {scene.config.states.check_timeout_s:g} s: {why}"
        )
    if gone:
        scene.test_memory = None  # repeat a measurement with a gap
        scene.explain(WhyCode.CHECKING, f"checking the sensors: {missing.text}", missing.code)
        return State.CHECK
    if scene.config.states.actuator_test:
        return _test_actuators(scene)
    scene.explain(WhyCode.CHECKING, "checking the sensors: all good so far")
    if scene.state_age_s > _PUMP_STANDS_S:
        scene.sinking.add(scene.now_s, scene.observer.displacement_um)
    if good_s < scene.config.states.check_s or missing != NO_REASON:
        return State.CHECK
    return _begin(scene, max(0.0, -scene.sinking.per_s))


def inflate(scene: Scene) -> State:
    """Ramp from where the mirror is to the setpoint; the ramp waits
    for a mirror that lags behind.
    """
    states = scene.config.states
    lag = abs(scene.loop.lag_um) / states.inflate_pause_um
    output = _drive(scene, scene.loop.ramp_um if lag > 1.0 else scene.setpoint_um)
    to_go_um = scene.setpoint_um - output.filtered_um
    unseen = NO_REASON if math.isfinite(to_go_um) else scene.observer.unseen
    to_go = f"{to_go_um:.1f} µm to go" if math.isfinite(to_go_um) else unseen.text or "no reading"
    # A waiting ramp starts and stops at the limit, several times a second: the reason must not.
    waits = lag > 0.8
    inflating = f"inflating: {to_go}{', the ramp waits for the mirror' if waits else ''}"
    scene.explain(WhyCode.INFLATING, inflating, unseen.code, waits)
    ramp_left_um = scene.setpoint_um + scene.trim_um - output.setpoint_um
    if (
        abs(ramp_left_um) < scene.config.limits.band_um
        and abs(to_go_um) < scene.config.limits.band_um
    ):
        return State.SETTLE
    rises = not output.filtered_um <= scene.highest_um + scene.config.limits.band_um
    if math.isfinite(to_go_um) and (
        rises or to_go_um <= 0.0
    ):  # from above the leak lowers it, however slowly
        scene.highest_um, scene.highest_s = output.filtered_um, scene.now_s
    if scene.now_s - scene.highest_s > states.inflate_stall_s:
        scene.overdue = (
            f"no rise in {states.inflate_stall_s:g} s, {to_go_um:.0f} µm below the setpoint"
        )
    elif scene.state_age_s > states.inflate_timeout_s:
        scene.overdue = f"still {to_go_um:.0f} µm from the setpoint"
    return State.INFLATE


def settle(scene: Scene) -> State:
    """Stay within the band for a while before `hold` begins."""
    output = _drive(scene, scene.setpoint_um)
    band_um = scene.config.limits.band_um
    settled_s = scene.stay_good(not abs(output.error_um) >= band_um)  # a lost reading is no error
    scene.explain(WhyCode.SETTLING, f"settling: inside the band for {settled_s:.0f} s")
    if settled_s >= scene.config.states.settle_s:
        scene.explain(WhyCode.SETTLED, f"inside +-{band_um:g} µm for {settled_s:.1f} s")
        return State.HOLD
    if scene.state_age_s > scene.config.states.settle_timeout_s:
        swings = "if it swings, halve loop.kp_per_s and double loop.ti_s"
        scene.overdue = (
            f"not inside +-{band_um:g} µm for {scene.config.states.settle_s:g} s: {swings}"
        )
    return State.SETTLE


def hold(scene: Scene) -> State:
    """Hold the mirror at its setpoint."""
    if scene.paused:
        scene.give(scene.loop.stale(_given(scene, scene.setpoint_um), scene.dt_s))
        scene.explain(WhyCode.PAUSED, f"paused by {scene.asked_by}: the pump keeps its mean flow")
        if scene.stay_good(True) > scene.config.states.pause_max_s or scene.strayed:
            scene.paused = False
        return State.HOLD
    scene.good_since_s = math.nan
    _explain_hold(scene, _drive(scene, scene.setpoint_um))
    return State.HOLD


def manual(scene: Scene) -> State:
    """Give the flow a person has requested; the loop tracks it, so that `hold` takes over without a
    bump.
    """
    if scene.hold_wanted:
        scene.explain(WhyCode.HOLD_REQUESTED, f"{scene.asked_by} requested a hold again")
        scene.keep_flowing()
        return State.INFLATE
    over = _manual_over(scene)
    flow_um_per_s = scene.mean_flow_um_per_s if over else scene.manual_um_per_s
    scene.give(scene.loop.follow(_given(scene, scene.setpoint_um), flow_um_per_s, scene.dt_s))
    if over:
        scene.explain(WhyCode.MANUAL_OVER, f"manual is over: {over}")
        return State.INFLATE
    manual = f"manual: {scene.asked_by} set the flow to {scene.manual_um_per_s:.2f} µm/s"
    scene.explain(WhyCode.MANUAL, manual, scene.asked_by)
    return State.MANUAL


def tune(scene: Scene) -> State:
    """Run an experiment inside its guard; however it ends, the loop resumes at the holding flow."""
    trial = scene.trial
    assert trial is not None  # made by the command that leads here
    given = _given(scene, scene.setpoint_um)
    measuring_um = math.nan if scene.laser_doubted else scene.observer.moving_laser_um
    seen_um = given.displacement_um if scene.config.by_optics else measuring_um
    if scene.config.by_optics and given.estimate is not None and math.isfinite(seen_um):
        seen_um = given.estimate.um  # a figure is of a moment ago
    measurement = BenchSample(seen_um, given.ambient_pressure_pa, given.air_temperature_c)
    wanted: float | Finished
    if scene.hold_wanted:
        wanted = Finished(ExperimentEnd.INTERRUPTED, f"ended by {scene.asked_by}")
    elif scene.levels.safe_level != SafeLevel.NONE:
        wanted = Finished(ExperimentEnd.INTERRUPTED, "the safety table holds the mean flow")
    else:
        wanted = trial.step(measurement, scene.dt_s)
    if isinstance(wanted, Finished):
        scene.give(scene.loop.resume(given, trial.spec.holding_flow_um_per_s, scene.dt_s))
        scene.trial_ended = wanted
        ended = f"{trial.spec.kind} {'done' if wanted.completed else 'stopped'}: {wanted.reason}"
        scene.explain(WhyCode.EXPERIMENT_ENDED, ended, trial.spec.kind, wanted.completed)
        return State.HOLD
    scene.give(
        (scene.loop.follow_raw if trial.raw else scene.loop.follow)(given, wanted, scene.dt_s)
    )
    tuning = f"tuning: {trial.spec.kind} requested by {scene.asked_by}"
    scene.explain(WhyCode.EXPERIMENT, tuning, trial.spec.kind, scene.asked_by)
    return State.TUNE


def lower(scene: Scene) -> State:
    """Lower the mirror: pump off, confirmed by its read-back; the leak or the vent lowers the film.

    Read-back and pressure end it, never a time-out: a pump that still runs is a fault
    (`pump_runs_on`).
    """
    scene.hold_wanted = False
    scene.vent_fraction = float(scene.venting)
    stand = scene.standstill
    _explain_way_down(scene, ": pump off")
    if scene.way_down == "stop":
        if stand.silent_s > scene.config.states.lower_timeout_s:
            scene.finished = Exit.DEVICE_FAILED  # the pump's state is unknown
        elif stand.at_rest:
            scene.finished = scene.stop_exit
        return State.LOWER
    if scene.venting:
        reading = scene.observer.reading
        pressure_pa = reading.gauge_pressure_pa if reading else math.nan
        vented = scene.config.vent_fitted
        venting = f"{'venting' if vented else _NO_VENT}: {pressure_pa:.0f} Pa left"
        late = vented and scene.state_age_s > _VENTED_S
        if late:
            venting += f" after {scene.state_age_s / 60:.0f} min: check the vent and the gauge"
        scene.explain(WhyCode.VENTING, venting, late)
        if not pressure_pa < scene.config.states.vented_pressure_pa:
            return State.LOWER
    if not stand.seen_off:
        return State.LOWER
    scene.way_down = None
    return State.STANDBY


def fault(scene: Scene) -> State:
    """Descend the safe levels, latched; a person clears the fault, or the resume rule once its
    cause has gone.
    """
    safe_level = scene.levels.step(scene.now_s)
    scene.explain(
        WhyCode.FAULT, f"fault: {_level_words(safe_level, scene)}", safe_level.name.lower()
    )
    scene.hold_wanted = False
    scene.vent_fraction = float(scene.venting or safe_level == SafeLevel.VENT)
    if safe_level == SafeLevel.RAMP_DOWN:
        if scene.state_age_s == 0:
            scene.ramp_from_fraction = scene.last_pump_fraction
        left = max(0.0, 1.0 - scene.levels.age_s(scene.now_s) / scene.config.states.ramp_down_s)
        scene.pump_fraction = left * scene.ramp_from_fraction
        return State.FAULT
    stops = scene.way_down == "stop"
    stand = scene.standstill
    silent = stand.silent_s > scene.config.states.lower_timeout_s
    if scene.acknowledged and (stand.seen_off or silent):
        scene.explain(WhyCode.ACKNOWLEDGED, f"fault acknowledged by {scene.asked_by}")
        return State.STANDBY
    if scene.may_resume and stand.seen_off and not stops:
        scene.hold_wanted = True
        scene.explain(WhyCode.RESUMING, "the cause is gone; resuming automatically")
        return State.STANDBY
    may_end = stops or not (scene.config.states.stay_after_trip or scene.resume_possible)
    if may_end and (stand.at_rest or silent or _nothing_left_to_do(scene, safe_level)):
        scene.finished = Exit.SAFETY_TRIP
    return State.FAULT


def _level_words(safe_level: SafeLevel, scene: Scene) -> str:
    """The safe level for people, by what the bench can do."""
    if safe_level == SafeLevel.VENT and not scene.config.vent_fitted:
        return f"pump off; {_NO_VENT}"
    return safe_level.name.lower().replace("_", " ")


def _nothing_left_to_do(scene: Scene, safe_level: SafeLevel) -> bool:
    """Whether, with a pump that does not obey, the vent is open and the mirror empty or given time
    to empty.

    Until then the run continues, so that it keeps commanding the pump to stop.
    """
    if safe_level != SafeLevel.VENT:
        return False
    reading, vented_s = scene.observer.reading, scene.levels.age_s(scene.now_s)
    empty = (
        reading is not None and reading.gauge_pressure_pa < scene.config.states.vented_pressure_pa
    )
    return vented_s > (_STOP_GIVES_UP_S if empty or scene.way_down == "stop" else _VENTED_S)


HANDLERS: dict[State, Callable[[Scene], State]] = {
    State.STANDBY: standby,
    State.CHECK: check,
    State.INFLATE: inflate,
    State.SETTLE: settle,
    State.HOLD: hold,
    State.MANUAL: manual,
    State.TUNE: tune,
    State.LOWER: lower,
    State.FAULT: fault,
}


def run_state(state: State, scene: Scene) -> State:
    """Run the state's handler and return the next state; a request for another state takes
    precedence.
    """
    if scene.way_down is not None and state not in (State.LOWER, State.FAULT):
        _explain_way_down(scene)
        return State.LOWER
    if (
        state in (State.INFLATE, State.SETTLE, State.HOLD)
        and (elsewhere := _asked_elsewhere(scene)) is not None
    ):
        return elsewhere
    return HANDLERS[state](scene)


def _explain_way_down(scene: Scene, more: str = "") -> None:
    way = "vent" if scene.venting and scene.way_down == "lower" else str(scene.way_down)
    who = (
        "the duration is over"
        if scene.asked_by == commands.AT_END
        else f"{way} requested by {scene.asked_by}"
    )
    scene.explain(WhyCode.GOING_DOWN, f"{who}{more}", way, scene.asked_by, bool(more))


def _manual_over(scene: Scene) -> str:
    """Why the loop takes over from manual flow; empty if it does not."""
    states = scene.config.states
    if scene.levels.safe_level != SafeLevel.NONE:
        return "the safety table holds the mean flow"
    if scene.strayed:
        return f"more than {states.manual_range_um:g} µm from the setpoint"
    if scene.now_s - scene.manual_since_s > states.manual_max_s:
        return f"no flow was set for {states.manual_max_s:g} s"
    return ""


def _asked_elsewhere(scene: Scene) -> State | None:
    """The requested state, if it is not a hold."""
    if scene.trial is not None:
        _drive(
            scene, scene.setpoint_um
        )  # the loop runs this tick: otherwise the pump would be off for 20 ms
        requested = f"{scene.asked_by} requested the experiment {scene.trial.spec.kind}"
        scene.explain(WhyCode.EXPERIMENT_REQUESTED, requested)
        return State.TUNE
    if scene.manual_wanted:
        scene.hold_wanted = False
        scene.explain(WhyCode.MANUAL_REQUESTED, f"{scene.asked_by} took over the pump")
        scene.mean_flow_um_per_s = scene.loop.mean_flow_um_per_s
        scene.keep_flowing()
        return State.MANUAL
    return None


def _test_actuators(scene: Scene) -> State:
    test = _running_test(scene)
    test.step(scene.observer.displacement_um, scene.dt_s)
    part = test.part
    if part is not None:
        scene.pump_fraction, scene.vent_fraction = part.pump_fraction, part.vent_fraction
        scene.explain(WhyCode.TESTING_ACTUATORS, f"testing the actuators: {part.name}", part.name)
        return State.CHECK
    if _missing(scene) != NO_REASON:
        return State.CHECK  # the loop starts from a reading
    failure = test.failure()
    if failure:
        if test.is_second:
            scene.unfit = failure
        responds = f"the film does not respond{'' if scene.unfit else ' clearly'}: {failure}"
        scene.explain(WhyCode.FILM_NOT_RESPONDING, responds, test.is_second)
        test.again()
        return State.CHECK
    return _begin(scene, test.leak_um_per_s)


def _running_test(scene: Scene) -> pump_obeys.ActuatorTest:
    """The actuator test, which begins with this tick if there is none."""
    memory, rate_hz = scene.test_memory, scene.config.loop.rate_hz
    if memory is not None:
        return pump_obeys.ActuatorTest(memory.pump, memory.test_vent, rate_hz, memory)
    reading = scene.observer.reading
    vents = reading is not None and math.isfinite(reading.vent_fraction)
    tense = (
        reading is not None and reading.gauge_pressure_pa > scene.config.states.vented_pressure_pa
    )
    test = pump_obeys.ActuatorTest(scene.pump_config, vents and tense, rate_hz)
    scene.test_memory = test.memory
    return test


def _begin(scene: Scene, leak_um_per_s: float) -> State:
    """Hand over to the loop at the flow that balances the leak, so that the integrator need not
    find it.
    """
    scene.loop.start(scene.observer.displacement_um, leak_um_per_s)
    scene.explain(
        WhyCode.CHECKED,
        f"all sensors good, the film responds and sinks by {leak_um_per_s:.2f} µm/s",
    )
    scene.pump_fraction = scene.last_pump_fraction
    return State.INFLATE


def _drive(scene: Scene, target_um: float) -> inner_loop.LoopOutput:
    """Let the loop drive the pump: automatic with a valid reading, held mean flow without one."""
    drive = scene.loop.step if scene.levels.safe_level == SafeLevel.NONE else scene.loop.stale
    output = drive(_given(scene, target_um), scene.dt_s)
    scene.give(output)
    return output


def _given(scene: Scene, target_um: float) -> inner_loop.LoopInput:
    reading = scene.observer.reading
    return inner_loop.LoopInput(
        target_um=target_um,
        trim_um=scene.trim_um,
        displacement_um=scene.observer.displacement_um,
        ambient_pressure_pa=reading.ambient_pressure_pa if reading else math.nan,
        air_temperature_c=reading.air_temperature_c if reading else math.nan,
        estimate=scene.estimate,
    )


def _missing(scene: Scene) -> Reason:
    """What the checks still lack; `NO_REASON` if nothing is missing."""
    reading = scene.observer.reading
    if reading is None:
        return make_reason(WhyCode.NO_ANSWER, "no answer from the device")
    unseen = scene.observer.unseen
    if unseen != NO_REASON:
        return unseen
    if not math.isfinite(reading.gauge_pressure_pa):
        return make_reason(WhyCode.NO_GAUGE, "no gauge pressure")
    if reading.latched_faults:
        faults = f"the board has latched faults {reading.latched_faults:#x}"
        return make_reason(WhyCode.BOARD_FAULTS, faults, reading.latched_faults)
    mask = scene.interlocks.open_mask
    return (
        make_reason(WhyCode.INTERLOCK_OPEN, scene.interlocks.describe_open(mask), mask)
        if mask
        else NO_REASON
    )


def _explain_hold(scene: Scene, output: inner_loop.LoopOutput) -> None:
    by_optics = scene.config.by_optics
    if scene.levels.safe_level == SafeLevel.HOLD_FLOW:
        until = "optics see the film" if by_optics else "laser is back"
        scene.explain(WhyCode.HOLDING_FLOW, f"holding the last mean flow until the {until}")
        return
    alone = scene.estimate is not None and not scene.estimate.sensors[Sensor.LASER].fresh
    holding = "holding by the optics alone" if alone else "holding"
    if output.too_tight:
        tight = f"{holding}, but the mirror is too tight: open a bleed (loop.bleed_fraction)"
        scene.explain(WhyCode.HOLDING, tight, alone, "too_tight")
    elif output.saturated:
        wants_more = output.flow_wanted_um_per_s > output.flow_um_per_s
        side = "more than the pump has" if wants_more else "less than none"
        limited = f"{holding}, pump at its limit: the loop needs {side}"
        scene.explain(WhyCode.HOLDING, limited, alone, "more" if wants_more else "less")
    else:
        scene.explain(WhyCode.HOLDING, f"{holding}: the pump balances the leak", alone)
