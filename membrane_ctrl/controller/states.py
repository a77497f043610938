"""States as small functions: each reads the tick, sets the pump and returns the next state.

They decide only what to do when all is well. Safety is judged around them on every tick
(`controller.Controller.tick`), and no handler can bypass it.
"""

import math

from membrane_ctrl.control import inner_loop
from membrane_ctrl.control.centre_estimate import Sensor
from membrane_ctrl.control.experiments.experiment import BenchSample, ExperimentEnd, Finished
from membrane_ctrl.controller import actuator_test, commands
from membrane_ctrl.controller.tick_context import TickContext
from membrane_ctrl.model.errors import Exit
from membrane_ctrl.model.lock import describe_locks
from membrane_ctrl.model.reason import NO_REASON, Reason, WhyCode, make_reason
from membrane_ctrl.model.telemetry import SafeLevel, State

_LOCKS_SHOWN = 3  # in the operator's line; the status has all of them
# by then a pump that was left running has stopped: lag 0.15 s, transport 0.1 s
# (docs/explanation/physics.md)
_PUMP_STANDS_S = 0.5
# An inflation whose mirror has sunk by `limits.following_error_max_um` for so long has failed; a
# gust is shorter.
_SANK_S = 5.0
_NO_VENT = "no vent is fitted, the leak lowers the mirror"
_VENTED_S = 900.0  # twice the twin's time from 600 Pa; longer means a shut vent or a wrong gauge
# A `stop` with a pump that does not obey: after this long with the vent open and the pump commanded
# off, report that the pump still runs. Shorter than the 30 s that the service manager allows.
_STOP_GIVES_UP_S = 10.0


def standby(context: TickContext) -> State:
    """Keep the pump off until someone requests a hold; a lock or an open interlock cancels the
    request.
    """
    interlock = context.interlocks.describe_open(context.interlocks.last_mask)
    if context.locks:
        context.hold_wanted = False
        locked = f"standby: locked: {describe_locks(context.locks, _LOCKS_SHOWN)}"
        context.explain(WhyCode.LOCKED, locked, *(lock.word for lock in context.locks))
        return State.STANDBY
    if interlock:
        context.hold_wanted = False
    if context.hold_wanted:
        context.explain(WhyCode.HOLD_REQUESTED, "a hold was requested")
        return State.CHECK
    if context.latched:
        context.explain(WhyCode.FAULT_LATCHED, f"standby: a fault is latched: {context.latched}")
    elif interlock:
        context.explain(
            WhyCode.INTERLOCK_OPEN, f"standby: {interlock}", context.interlocks.last_mask
        )
    else:
        context.explain(WhyCode.STANDBY, "standby: no hold was requested")
    return State.STANDBY


def check(context: TickContext) -> State:
    """Require good sensors for a while and a film that responds before the pump may run."""
    missing = _list_missing_checks(context)
    if missing == NO_REASON:
        context.last_good_s = context.now_s
    # occasional lost answers do not make a bad sensor
    gone = not context.now_s - context.last_good_s <= context.config.limits.stale_s
    good_s = context.measure_good_time_s(not gone)
    if context.state_age_s > context.config.states.check_timeout_s + context.observer.waited_s:
        unsteady = "readings come and go, or the actuator test is not done"
        why = missing.text or _explain_slow_link(context) or unsteady
        context.overdue = (
            f"sensors still not good after {context.config.states.check_timeout_s:g} s: {why}"
        )
    if gone:
        context.test_memory = None  # repeat a measurement with a gap
        context.explain(WhyCode.CHECKING, f"checking the sensors: {missing.text}", missing.code)
        return State.CHECK
    if context.config.states.actuator_test:
        return _test_actuators(context)
    context.explain(WhyCode.CHECKING, "checking the sensors: all good so far")
    if context.state_age_s > _PUMP_STANDS_S:
        context.sinking.add(context.now_s, context.observer.displacement_um)
    if good_s < context.config.states.check_s or missing != NO_REASON:
        return State.CHECK
    return _begin_loop(context, max(0.0, -context.sinking.per_s))


def inflate(context: TickContext) -> State:
    """Ramp from where the mirror is to the setpoint; the ramp waits
    for a mirror that lags behind.
    """
    states = context.config.states
    # A mirror ahead of the ramp must not stop it: with a slow leak it would never be caught up.
    rises_to_target = context.setpoint_um >= context.loop.ramp_um
    behind_um = context.loop.lag_um if rises_to_target else -context.loop.lag_um
    lag = behind_um / states.inflate_pause_um
    output = drive_pump(context, context.loop.ramp_um if lag > 1.0 else context.setpoint_um)
    to_go_um = context.setpoint_um + context.setpoint_shift_um - output.filtered_um
    unseen = NO_REASON if math.isfinite(to_go_um) else context.observer.missing_reason
    to_go = f"{to_go_um:.1f} µm to go" if math.isfinite(to_go_um) else unseen.text or "no reading"
    # A waiting ramp starts and stops at the limit, several times a second: the reason must not.
    waits = lag > 0.8
    inflating = f"inflating: {to_go}{', the ramp waits for the mirror' if waits else ''}"
    context.explain(WhyCode.INFLATING, inflating, unseen.code, waits)
    ramp_left_um = context.setpoint_um + context.setpoint_shift_um - output.setpoint_um
    if (
        abs(ramp_left_um) < context.config.limits.band_um
        and abs(to_go_um) < context.config.limits.band_um
    ):
        return State.SETTLE
    rises = not output.filtered_um <= context.highest_um + context.config.limits.band_um
    # from above the leak lowers it, however slowly
    if math.isfinite(to_go_um) and (rises or to_go_um <= 0.0):
        context.highest_um = output.filtered_um
        context.highest_s = context.now_s
    # A pump that takes gas instead of giving it, or a film that is torn
    most_um = context.config.limits.following_error_max_um
    sank_um = context.highest_um - output.filtered_um
    if context.measure_good_time_s(to_go_um > 0.0 and sank_um > most_um) > _SANK_S:
        context.overdue = f"the mirror sank by {sank_um:.0f} µm while it was to rise"
    elif context.now_s - context.highest_s > states.inflate_stall_s:
        context.overdue = (
            f"no rise in {states.inflate_stall_s:g} s, {to_go_um:.0f} µm below the setpoint"
        )
    elif context.state_age_s > states.inflate_timeout_s:
        context.overdue = f"still {to_go_um:.0f} µm from the setpoint"
    return State.INFLATE


def settle(context: TickContext) -> State:
    """Stay within the band for a while before `hold` begins."""
    output = drive_pump(context, context.setpoint_um)
    band_um = context.config.limits.band_um
    # a lost reading is no error
    settled_s = context.measure_good_time_s(not abs(output.error_um) >= band_um)
    context.explain(WhyCode.SETTLING, f"settling: inside the band for {settled_s:.0f} s")
    if settled_s >= context.config.states.settle_s:
        context.explain(WhyCode.SETTLED, f"inside +-{band_um:g} µm for {settled_s:.1f} s")
        return State.HOLD
    if context.state_age_s > context.config.states.settle_timeout_s:
        swings = "if it swings, halve loop.kp_per_s and double loop.ti_s"
        context.overdue = (
            f"not inside +-{band_um:g} µm for {context.config.states.settle_s:g} s: {swings}"
        )
    return State.SETTLE


def hold(context: TickContext) -> State:
    """Hold the mirror at its setpoint."""
    if context.paused:
        context.drive_by(
            context.loop.step_without_reading(
                _make_loop_input(context, context.setpoint_um), context.dt_s
            )
        )
        context.explain(
            WhyCode.PAUSED, f"paused by {context.asked_by}: the pump keeps its mean flow"
        )
        if (
            context.measure_good_time_s(True) > context.config.states.pause_max_s
            or context.beyond_manual_range
        ):
            context.paused = False
        return State.HOLD
    context.good_since_s = math.nan
    _explain_hold(context, drive_pump(context, context.setpoint_um))
    return State.HOLD


def manual(context: TickContext) -> State:
    """Give the flow a person has requested; the loop tracks it, so that `hold` takes over without a
    bump.
    """
    if context.hold_wanted:
        context.explain(WhyCode.HOLD_REQUESTED, f"{context.asked_by} requested a hold again")
        context.keep_flowing()
        return State.INFLATE
    # At its end the pump has its mean flow in this tick, and the loop takes over in the next
    over = _explain_manual_end(context)
    flow_um_per_s = context.mean_flow_um_per_s if over else context.manual_um_per_s
    context.drive_by(
        context.loop.follow_flow(
            _make_loop_input(context, context.setpoint_um), flow_um_per_s, context.dt_s
        )
    )
    if over:
        context.explain(WhyCode.MANUAL_OVER, f"manual is over: {over}")
        return State.INFLATE
    manual = f"manual: {context.asked_by} set the flow to {context.manual_um_per_s:.2f} µm/s"
    context.explain(WhyCode.MANUAL, manual, context.asked_by)
    return State.MANUAL


def tune(context: TickContext) -> State:
    """Run an experiment inside its guard; however it ends, the loop resumes at the holding flow."""
    trial = context.trial
    assert trial is not None  # made by the command that leads here
    # The reading that the experiment and its guard follow.
    given = _make_loop_input(context, context.setpoint_um)
    measuring_um = math.nan if context.laser_doubted else context.observer.moving_laser_um
    seen_um = given.displacement_um if context.config.by_optics else measuring_um
    if context.config.by_optics and given.estimate is not None and math.isfinite(seen_um):
        seen_um = given.estimate.um  # a figure is of a moment ago
    measurement = BenchSample(seen_um, given.ambient_pressure_pa, given.air_temperature_c)
    # The experiment ends by a person, by the safety table, or by itself; else it asks for a flow.
    wanted: float | Finished
    if context.hold_wanted:
        wanted = Finished(ExperimentEnd.INTERRUPTED, f"ended by {context.asked_by}")
    elif context.levels.safe_level != SafeLevel.NONE and not _has_lost_laser(context):
        wanted = Finished(ExperimentEnd.INTERRUPTED, "the safety table holds the mean flow")
    else:
        wanted = trial.step(measurement, context.dt_s)
    # At its end the loop takes over at the mean flow, not at the flow of a moment.
    if isinstance(wanted, Finished):
        context.drive_by(
            context.loop.resume_at_mean(given, trial.spec.holding_flow_um_per_s, context.dt_s)
        )
        context.trial_ended = wanted
        ended = f"{trial.spec.kind} {'done' if wanted.completed else 'stopped'}: {wanted.reason}"
        context.explain(WhyCode.EXPERIMENT_ENDED, ended, trial.spec.kind, wanted.completed)
        return State.HOLD
    context.drive_by(
        (context.loop.follow_raw if trial.raw else context.loop.follow_flow)(
            given, wanted, context.dt_s
        )
    )
    tuning = f"tuning: {trial.spec.kind} requested by {context.asked_by}"
    context.explain(WhyCode.EXPERIMENT, tuning, trial.spec.kind, context.asked_by)
    return State.TUNE


def _has_lost_laser(context: TickContext) -> bool:
    """Whether an experiment has no reading for a moment: its guard tolerates 0.3 s and allows for
    the motion in that time, so that a short loss does not end it.
    """
    may_be_short = not context.config.by_optics and not context.laser_doubted
    return may_be_short and math.isnan(context.observer.laser_um)


def lower(context: TickContext) -> State:
    """Lower the mirror: pump off, confirmed by its read-back; the leak or the vent lowers the film.

    Read-back and pressure end it, never a time-out: a pump that still runs is a fault
    (`pump_runs_on`).
    """
    context.hold_wanted = False
    context.vent_fraction = float(context.venting)
    stand = context.standstill
    explain_way_down(context, ": pump off")
    # A stop ends the run once the pump has been seen to stand still.
    if context.way_down == "stop":
        if stand.silent_s > context.config.states.lower_timeout_s:
            context.finished = Exit.DEVICE_FAILED  # the pump's state is unknown
        elif stand.at_rest:
            context.finished = context.stop_exit
        return State.LOWER
    # A vent is over when the pressure has gone.
    if context.venting:
        reading = context.observer.reading
        pressure_pa = reading.gauge_pressure_pa if reading else math.nan
        vented = context.config.vent_fitted
        venting = f"{'venting' if vented else _NO_VENT}: {pressure_pa:.0f} Pa left"
        late = vented and context.state_age_s > _VENTED_S
        if late:
            venting += f" after {context.state_age_s / 60:.0f} min: check the vent and the gauge"
        context.explain(WhyCode.VENTING, venting, late)
        if not pressure_pa < context.config.states.vented_pressure_pa:
            return State.LOWER
    # Then, or at once without a vent: standby.
    if not stand.seen_off:
        return State.LOWER
    context.way_down = None
    return State.STANDBY


def fault(context: TickContext) -> State:
    """Descend the safe levels, latched; a person clears the fault, or the resume rule once its
    cause has gone.
    """
    safe_level = context.levels.step(context.now_s)
    context.explain(
        WhyCode.FAULT, f"fault: {_level_words(safe_level, context)}", safe_level.name.lower()
    )
    context.hold_wanted = False
    context.vent_fraction = float(context.venting or safe_level == SafeLevel.VENT)
    # The pump's command falls evenly from where it was; in the other levels it is off.
    if safe_level == SafeLevel.RAMP_DOWN:
        if context.state_age_s == 0:
            context.ramp_from_fraction = context.last_pump_fraction
        left = max(
            0.0, 1.0 - context.levels.age_s(context.now_s) / context.config.states.ramp_down_s
        )
        context.pump_fraction = left * context.ramp_from_fraction
        return State.FAULT
    # Out of the fault: acknowledged by a person, or by the resume rule; the pump must have been
    # seen to stand still.
    stops = context.way_down == "stop"
    stand = context.standstill
    silent = stand.silent_s > context.config.states.lower_timeout_s
    if context.acknowledged and (stand.seen_off or silent):
        context.explain(WhyCode.ACKNOWLEDGED, f"fault acknowledged by {context.asked_by}")
        return State.STANDBY
    if context.may_resume and stand.seen_off and not stops:
        context.hold_wanted = True
        context.explain(WhyCode.RESUMING, "the cause is gone; resuming automatically")
        return State.STANDBY
    # Or the run ends, once the mirror is at rest.
    may_end = stops or not (context.config.states.stay_after_trip or context.resume_possible)
    if may_end and (stand.at_rest or silent or _is_lowered(context, safe_level)):
        context.finished = Exit.SAFETY_TRIP
    return State.FAULT


def _level_words(safe_level: SafeLevel, context: TickContext) -> str:
    """The safe level for people, by what the bench can do."""
    if safe_level == SafeLevel.VENT and not context.config.vent_fitted:
        return f"pump off; {_NO_VENT}"
    return safe_level.name.lower().replace("_", " ")


def _is_lowered(context: TickContext, safe_level: SafeLevel) -> bool:
    """Whether, with a pump that does not obey, the vent is open and the mirror empty or given time
    to empty.

    Until then the run continues, so that it keeps commanding the pump to stop.
    """
    if safe_level != SafeLevel.VENT:
        return False
    reading, vented_s = context.observer.reading, context.levels.age_s(context.now_s)
    empty = (
        reading is not None and reading.gauge_pressure_pa < context.config.states.vented_pressure_pa
    )
    return vented_s > (_STOP_GIVES_UP_S if empty or context.way_down == "stop" else _VENTED_S)


def observe(context: TickContext) -> State:
    """Follow a pump that others drive, by its read-back; command nothing."""
    reading = context.observer.reading
    context.hold_wanted = False
    context.explain(WhyCode.OBSERVING, "observing: this run commands neither pump nor vent")
    if reading is not None and math.isfinite(reading.pump_fraction):
        context.output = context.loop.follow_pump(
            _make_loop_input(context, context.setpoint_um), reading.pump_fraction, context.dt_s
        )
    if context.way_down is not None:
        context.finished = context.stop_exit
    return State.STANDBY


def explain_way_down(context: TickContext, more: str = "") -> None:
    """State why the mirror goes down, and at whose request.

    Parameters
    ----------
    context : TickContext
        Gets the reason.
    more : str
        What follows in the sentence.
    """
    way = "vent" if context.venting and context.way_down == "lower" else str(context.way_down)
    who = (
        "the duration is over"
        if context.asked_by == commands.AT_END
        else f"{way} requested by {context.asked_by}"
    )
    context.explain(WhyCode.GOING_DOWN, f"{who}{more}", way, context.asked_by, bool(more))


def _explain_manual_end(context: TickContext) -> str:
    """Why the loop takes over from manual flow; empty if it does not."""
    states = context.config.states
    if context.levels.safe_level != SafeLevel.NONE:
        return "the safety table holds the mean flow"
    if context.beyond_manual_range:
        return f"more than {states.manual_range_um:g} µm from the setpoint"
    if context.now_s - context.manual_since_s > states.manual_max_s:
        return f"no flow was set for {states.manual_max_s:g} s"
    return ""


def _test_actuators(context: TickContext) -> State:
    """Run a tick of the actuator test; at its end, begin the loop or report why the film is
    unfit.
    """
    test = _get_actuator_test(context)
    test.step(context.observer.displacement_um, context.dt_s)
    part = test.part
    if part is not None:
        context.pump_fraction = part.pump_fraction
        context.vent_fraction = part.vent_fraction
        context.explain(WhyCode.TESTING_ACTUATORS, f"testing the actuators: {part.name}", part.name)
        return State.CHECK
    if _list_missing_checks(context) != NO_REASON:
        return State.CHECK  # the loop starts from a reading
    if test.failure:
        context.unfit = test.failure
        context.test_memory = None
        responds = f"the film does not respond: {test.failure}"
        context.explain(WhyCode.FILM_NOT_RESPONDING, responds)
        return State.CHECK
    context.found_response = test.response
    context.found_pump = test.stronger_pump
    context.found_leak_um_per_s = test.leak_um_per_s
    return _begin_loop(context, test.leak_um_per_s)


def _get_actuator_test(context: TickContext) -> actuator_test.ActuatorTest:
    """The actuator test, which begins with this tick if there is none."""
    memory, rate_hz = context.test_memory, context.config.loop.rate_hz
    # A curve that was measured since the start is no assumption
    assumed = (
        context.config.states.actuator_size == "any" and context.pump_config == context.config.pump
    )
    if memory is not None:
        return actuator_test.ActuatorTest(
            memory.pump, memory.test_vent, rate_hz, memory=memory, assumed=assumed
        )
    reading = context.observer.reading
    vents = reading is not None and math.isfinite(reading.vent_fraction)
    tense = (
        reading is not None and reading.gauge_pressure_pa > context.config.states.vented_pressure_pa
    )
    identify = context.config.estimator.pump_response == "identified"
    test = actuator_test.ActuatorTest(
        context.pump_config, vents and tense, rate_hz, identify, assumed=assumed
    )
    context.test_memory = test.memory
    return test


def _begin_loop(context: TickContext, leak_um_per_s: float) -> State:
    """Hand over to the loop at the flow that balances the leak, so that the integrator need not
    find it.
    """
    context.loop.start(context.observer.displacement_um, leak_um_per_s)
    context.explain(
        WhyCode.CHECKED,
        f"all sensors good, the film responds and sinks by {leak_um_per_s:.2f} µm/s",
    )
    context.pump_fraction = context.last_pump_fraction
    return State.INFLATE


def drive_pump(context: TickContext, target_um: float) -> inner_loop.LoopOutput:
    """Let the loop drive the pump.

    Automatic with a new reading, the last output with one that repeats, held mean flow without one.

    Parameters
    ----------
    context : TickContext
        Readings, estimate and safe level of the tick; gets the pump's command.
    target_um : float
        Displacement to hold.
    """
    drive = context.loop.step
    if context.levels.safe_level != SafeLevel.NONE:
        drive = context.loop.step_without_reading
    elif context.observer.repeats_sample and context.estimate is None:
        drive = context.loop.keep_output
    output = drive(_make_loop_input(context, target_um), context.dt_s)
    context.drive_by(output)
    return output


def _make_loop_input(context: TickContext, target_um: float) -> inner_loop.LoopInput:
    reading = context.observer.reading
    return inner_loop.LoopInput(
        target_um=target_um,
        trim_um=context.setpoint_shift_um,
        displacement_um=context.observer.displacement_um,
        ambient_pressure_pa=reading.ambient_pressure_pa if reading else math.nan,
        air_temperature_c=reading.air_temperature_c if reading else math.nan,
        estimate=context.estimate,
    )


def _explain_slow_link(context: TickContext) -> str:
    """That the ticks wait for the devices too long to check anything; empty if they do not."""
    link = context.observer.link
    if link.wait_ms <= context.config.limits.lateness_max_ms:
        return ""
    return f"the last tick had {link.explain_wait()}, whose answers are late"


def _list_missing_checks(context: TickContext) -> Reason:
    """What the checks still lack; `NO_REASON` if nothing is missing."""
    reading = context.observer.reading
    if reading is None:
        why = context.observer.link.message
        return make_reason(
            WhyCode.NO_ANSWER, f"no answer from the device{f': {why}' if why else ''}"
        )
    unseen = context.observer.missing_reason
    if unseen != NO_REASON:
        return unseen
    if not math.isfinite(reading.gauge_pressure_pa):
        return make_reason(WhyCode.NO_GAUGE, "no gauge pressure")
    if reading.latched_faults:
        faults = f"the board has latched faults {reading.latched_faults:#x}"
        return make_reason(WhyCode.BOARD_FAULTS, faults, reading.latched_faults)
    mask = context.interlocks.open_mask
    return (
        make_reason(WhyCode.INTERLOCK_OPEN, context.interlocks.describe_open(mask), mask)
        if mask
        else NO_REASON
    )


def _explain_hold(context: TickContext, output: inner_loop.LoopOutput) -> None:
    """State how the mirror is held: by which sensor, and whether the pump stands at a limit."""
    by_optics = context.config.by_optics
    if context.levels.safe_level == SafeLevel.HOLD_FLOW:
        until = "optics see the film" if by_optics else "laser is back"
        context.explain(WhyCode.HOLDING_FLOW, f"holding the last mean flow until the {until}")
        return
    alone = context.estimate is not None and not context.estimate.sensors[Sensor.LASER].fresh
    holding = "holding by the optics alone" if alone else "holding"
    if output.too_tight:
        tight = f"{holding}, but the mirror is too tight: open a bleed (loop.bleed_fraction)"
        context.explain(WhyCode.HOLDING, tight, alone, "too_tight")
    elif output.saturated:
        wants_more = output.flow_wanted_um_per_s > output.flow_um_per_s
        side = "more than the pump has" if wants_more else "less than none"
        limited = f"{holding}, pump at its limit: the loop needs {side}"
        context.explain(WhyCode.HOLDING, limited, alone, "more" if wants_more else "less")
    else:
        context.explain(WhyCode.HOLDING, f"{holding}: the pump balances the leak", alone)
