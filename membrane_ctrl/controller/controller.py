"""One tick of control: observe, judge, act. Without I/O and clock, so that a run, a replay and a
test run the same code.

The order is fixed: the inputs become an observation; the safety table judges it; only then the
state's handler runs, and an active safe level overrules its output. Every path through a tick ends
here.
"""

import math
from collections.abc import Collection
from dataclasses import asdict, replace

from numpy.linalg import LinAlgError

from firmware_iface.roles import ALL_FAULTS, BenchCommand
from membrane_ctrl.config.schema import Config, EstimatorConfig, LoopConfig, PumpConfig
from membrane_ctrl.control import inner_loop, shape_code, shape_loop
from membrane_ctrl.control.experiments import trial
from membrane_ctrl.control.experiments.experiment import ExperimentEnd, Finished
from membrane_ctrl.control.gain_limits import limit_gains
from membrane_ctrl.control.pump_response import PumpResponse, apply_response
from membrane_ctrl.controller import (
    centre_estimation,
    command_event,
    command_precedence,
    commands,
    gains_trial,
    held_scalar,
    hold_status,
    interlocks,
    locks,
    process_value,
    resume_rule,
    safe_levels,
    safety,
    safety_rule,
    sensor_consistency,
    standstill,
    state_handlers,
    state_sets,
)
from membrane_ctrl.controller.climate_part import ClimatePart
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.observation import Observation
from membrane_ctrl.controller.observer import Observer
from membrane_ctrl.controller.sample_rate import SampleRate
from membrane_ctrl.controller.short_losses import ShortLossCounter
from membrane_ctrl.controller.state import ControllerState, ReportedShape, make_first_state
from membrane_ctrl.controller.telemetry_row import make_telemetry_row
from membrane_ctrl.controller.tick import TickInputs, TickOutputs
from membrane_ctrl.controller.tick_context import TickContext, apply_command, collect_state_fields
from membrane_ctrl.model import arrays, errors
from membrane_ctrl.model.events import (
    Cleared,
    Event,
    ExperimentEnded,
    GainsLimited,
    GainsReverted,
    LockRemoved,
    LockSet,
    PumpResponseFound,
    PumpStronger,
    Resumed,
    ShapeLoopState,
    StateEntered,
    Why,
)
from membrane_ctrl.model.held_weights import HeldWeights
from membrane_ctrl.model.lock import describe_locks
from membrane_ctrl.model.reason import NO_REASON, make_reason
from membrane_ctrl.model.telemetry import SafeLevel, State

# range of the loop's time step relative to the nominal one; beyond it a tick is missed, which the
# safety table sees
_DT_RANGE = (0.2, 5.0)
_RAMP_ENDS_UM = 0.1
_WHY_STANDS_S = 1.0  # shorter-lived reasons (a pump that touches its limit) are not reported
_WITHOUT_LASER = make_reason(
    shape_code.ShapeCode.NO_MOUNT,
    "there is no laser whose mount could drift: the optics themselves are held",
)
_LOCKS_SHOWN = 3  # in the fault's text; the status has all of them


class Controller:
    """Owns the state machine, the safety table and both loops.

    `sag_sensitivity` (terms,) are the Zernike coefficients of a Hencky bowl per sag, in µm per µm,
    for the shape loop. `held_weights` are of the scalar that `loop.holds` names, needed unless that
    is the vertex.
    """

    def __init__(
        self,
        config: Config,
        sag_sensitivity: arrays.FloatArray,
        memory: ControllerState | None = None,
        held_weights: HeldWeights | None = None,
    ) -> None:
        self._config = config
        self.memory = memory = memory or make_first_state(config)
        # Each part gets its own branch of the memory: nothing else is remembered
        self._gains = gains_trial.GainsTrial(memory.gains)
        present = self._present_config
        self._safety = safety.SafetyTable(config.limits, memory=memory.safety)
        self._held = held_scalar.HeldScalar(config, held_weights, memory.held)
        self._shape = shape_loop.ShapeLoop(
            config.shape, sag_sensitivity, memory.shape, self._held.rim_weights
        )
        self._shape.set_time_constant(self._gains.present.shape_time_constant_s)
        self._held.set_time_constant(self._gains.present.shape_time_constant_s)
        # A dead time and lag that the actuator test has identified replace the configured ones
        estimator = apply_response(config.estimator, memory.context.pump_response)
        self._context = TickContext(
            config=config,
            loop_config=present.loop,
            pump_config=present.pump,
            loop=inner_loop.InnerLoop(present.loop, present.pump, estimator, memory.loop),
            observer=Observer(config, memory.observer),
            levels=safe_levels.SafeLevels(config.states, memory.levels),
            standstill=standstill.Standstill(config.loop, config.states, memory.standstill),
            interlocks=interlocks.Interlocks(config.interlocks, memory.interlocks),
            **collect_state_fields(memory.context),
        )
        memory.context = self._context
        # A memory from a snapshot may be in the middle of an experiment
        if memory.context.trial_memory is not None:
            self._context.trial = trial.Trial(memory.context.trial_memory, config.loop.rate_hz)
        self._resume = resume_rule.ResumeRule(config.resume, config.limits, memory.resume)
        self._consistency = sensor_consistency.SensorConsistency(config, memory.consistency)
        self._estimation = centre_estimation.CentreEstimation(
            config.model_copy(update={"estimator": estimator}), memory.estimation
        )
        self._estimation.set_gains(present.loop)
        self._consistency.set_gains(present.loop, present.pump)
        self._process_value = process_value.ProcessValueChoice(
            present.loop, present.pump, estimator, memory.process_value
        )
        self._sample_rate = SampleRate(memory.sample_rate)
        self._climate = ClimatePart(config, memory.climate)
        self._short_losses = ShortLossCounter(memory.short_losses)
        self._answers: list[tuple[int, str]] = []
        self._clear_mask = 0

    @property
    def state(self) -> State:
        """The present state."""
        return self.memory.state

    @property
    def fault(self) -> safety_rule.Rule | None:
        """The standing fault."""
        return None if self.memory.fault is None else safety.RULES[self.memory.fault]

    @fault.setter
    def fault(self, rule: safety_rule.Rule | None) -> None:
        self.memory.fault = None if rule is None else rule.code

    @property
    def loop_config(self) -> LoopConfig:
        """The loop's present settings."""
        return self._context.loop_config

    @property
    def pump_config(self) -> PumpConfig:
        """The pump's present curve."""
        return self._context.pump_config

    @property
    def _estimator(self) -> EstimatorConfig:
        """The estimator's settings, with dead time and lag as identified."""
        return apply_response(self._config.estimator, self._context.pump_response)

    @property
    def _present_config(self) -> Config:
        gains = self._gains.present
        return self._config.model_copy(update={"loop": gains.loop, "pump": gains.pump})

    def tick(self, inputs: TickInputs) -> TickOutputs:
        """Run one tick.

        Never raises: an exception in a state's handler, or in a part that may fail, becomes the
        fault `tick_error` in the next tick.

        Parameters
        ----------
        inputs : TickInputs
            Reading, figure and commands of the tick, and its time (`RunClock`, s). Called 50 times
            a second by the supervisor, in its event loop; a replay calls it with recorded inputs.

        Returns
        -------
        TickOutputs
            The command for pump and vent, the telemetry row, and what happened.
        """
        context = self._context
        events: list[Event] = []
        # 1. Time, interlocks and commands
        self._begin_tick(inputs, events)
        # 2. What do the sensors show? The loop's last output is the one of the tick before
        last = context.output or inner_loop.LoopOutput()
        observation = self._observe(inputs, last, events)
        # 3. The safety table judges before anything decides about the pump
        self._judge_safety(observation, events)
        # 4. The loop's setpoint and process value
        shape = self._step_shape(inputs, events)
        shape = self._choose_loop_inputs(inputs, last, shape, events)
        # 5. The state's handler commands the pump. The verdict, too, may have changed the state
        if math.isnan(self.memory.state_since_s):
            self.memory.state_since_s = inputs.now_s
            context.state_age_s = 0.0
        self._run_state(events)
        # 6. What this tick has found out about the pump counts from the next one
        self._use_pump(events)
        self._use_response(events)
        if context.loop.learned and self.state == State.HOLD:
            events += self._consistency.report_pump_curve(context.loop)
        # 7. The record
        command = BenchCommand(context.pump_fraction, context.vent_fraction)
        context.observer.note_command(command)
        context.last_pump_fraction = context.pump_fraction
        self._report_reason(events)
        fault = self.fault.code if self.fault else 0
        return TickOutputs(
            command=command,
            row=make_telemetry_row(
                context,
                self.state,
                fault,
                self.memory.ticks,
                inputs,
                observation,
                shape,
                self._held.row_values,
                self._climate.telemetry(),
            ),
            events=tuple(events),
            finished=context.finished,
            answers=tuple(self._answers),
            clear_mask=self._clear_mask,
        )

    def _observe(
        self, inputs: TickInputs, last: inner_loop.LoopOutput, events: list[Event]
    ) -> Observation:
        """Collect what the safety table judges: the readings, and what the parts found in them."""
        context, consistency, stand = self._context, self._consistency, self._context.standstill
        # The displacement first: all that follows compares with it
        context.observer.observe_inputs(inputs, self._may_follow_optics())
        # The climate, which the comparison of laser and gauge allows for
        events += self._climate.step(inputs.reading, self.state, context.dt_s)
        # Sensors against each other; a faulty one is known in the tick that shows it
        status = hold_status.hold_status(
            context,
            last,
            self._estimation.held_by_optics,
            self._may_follow_optics(),
            self._climate.fresh_strains,
        )
        events += consistency.compare_sensors(inputs, self.state, context.dt_s, status)
        # The pump against what was commanded
        stand.observe_reading(
            inputs.now_s, inputs.reading, context.observer.commanded, inputs.link_up
        )
        # In a pause nothing follows a setpoint: there is no error to judge
        follows_setpoint = self.state in state_sets.MOVING and not context.paused
        error_um = last.error_um if follows_setpoint else math.nan
        observation = replace(
            context.observer.make_observation(inputs, error_um),
            tick_error=self.memory.tick_error,
            overdue=context.overdue,
            unfit=context.unfit,
            laser_fault_text=consistency.laser_fault_text,
            runs_on=stand.runs_on,
            inflow=stand.inflow,
            locked=describe_locks(context.locks, _LOCKS_SHOWN),
            laser_gauge_apart=consistency.laser_gauge_apart,
            gas_excess=consistency.gas_excess,
            held_by_optics=self._estimation.held_by_optics or context.observer.optics_replace_laser,
            displacement_valid=self._displacement_suffices(),
            unseen_film=self._explain_unseen_film(),
            open_interlocks=context.interlocks.judged_mask,
            interlock_level=context.interlocks.safe_level,
            interlock_words=context.interlocks.describe_open(context.interlocks.judged_mask),
        )
        # Notices only; no rule follows from them
        if not self._config.by_optics:
            advances = observation.advance_age_s <= self._config.limits.stale_s
            events += self._sample_rate.step(
                inputs.now_s,
                answered=inputs.reading is not None and advances,
                fresh=observation.advance_age_s == 0.0,
            )
        return observation

    def _judge_safety(self, observation: Observation, events: list[Event]) -> None:
        """Compare the observation with the limits, and enter the safe level that follows."""
        verdict = self._safety.judge(self.state, observation)
        if self._config.states.observe:  # the program that drives the pump protects the mirror
            verdict = safety.Verdict(None)
        self._apply_verdict(verdict, events)
        self._consider_resuming(observation)

    def _choose_loop_inputs(
        self,
        inputs: TickInputs,
        last: inner_loop.LoopOutput,
        shape: shape_loop.ShapeOutput,
        events: list[Event],
    ) -> shape_loop.ShapeOutput:
        """Estimate the centre, move the setpoint for the held scalar, and choose what the loop
        follows; returns the shape loop's output with the trim that is in use.
        """
        context, consistency = self._context, self._consistency
        # While the centre is estimated, the trim is the estimated drift of the laser's mount
        events += self._estimation.step(inputs, self.state, context, last, shape.state, consistency)
        estimate = self._estimation.estimate
        if estimate is not None:
            shape = replace(shape, trim_um=estimate.mount_um)
        self._step_held(events)
        context.laser_doubted = bool(consistency.laser_fault_text)
        # Only a mirror near its setpoint is held by the estimate: elsewhere the loop has the laser
        is_held = self.state in (State.SETTLE, State.HOLD) or self._config.states.observe
        context.estimate = estimate if is_held else None
        if self._config.estimator.process_value == "auto":
            self._choose_process_value(last, events)
        return shape

    def _choose_process_value(self, last: inner_loop.LoopOutput, events: list[Event]) -> None:
        """Let the loop follow laser or estimate; after an error the estimate."""
        context = self._context
        try:
            context.estimate, chosen = self._process_value.step(self._collect_facts(last))
        except Exception as error:
            self.memory.tick_error = f"process value: {type(error).__name__}: {error}"
            return
        events += chosen

    def _collect_facts(self, last: inner_loop.LoopOutput) -> process_value.ProcessValueFacts:
        """What decides which process value the loop follows in this tick."""
        context, observer = self._context, self._context.observer
        reading = observer.reading
        is_steady = (
            self.state == State.HOLD
            and not context.paused
            and context.levels.safe_level == SafeLevel.NONE
            and abs(context.setpoint_um - context.loop.ramp_um) < _RAMP_ENDS_UM
        )
        is_stated = self._config.estimator.pump_response == "stated"
        return process_value.ProcessValueFacts(
            now_s=context.now_s,
            dt_s=context.dt_s,
            estimate=context.estimate,
            held_by_optics=self._estimation.held_by_optics,
            response_known=is_stated or context.pump_response is not None,
            on_trial=self._gains.on_trial,
            laser_um=observer.moving_laser_um,
            repeats_sample=observer.repeats_sample,
            laser_doubted=context.laser_doubted,
            steady=is_steady,
            setpoint_um=last.setpoint_um,
            flow_um_per_s=last.flow_um_per_s,
            weather=(
                reading.ambient_pressure_pa if reading else math.nan,
                reading.air_temperature_c if reading else math.nan,
            ),
        )

    def _may_follow_optics(self) -> bool:
        """Whether the estimate uses the figures: what it leaves out
        must not replace a lost laser.
        """
        if self._config.by_optics:
            return not self._estimation.optics_left_out
        return (
            self._shape.on
            and not self._consistency.camera_fault_text
            and not self._estimation.optics_left_out
        )

    def _displacement_suffices(self) -> bool:
        """Whether the displacement is known as well as the present state needs it.

        A loop needs a new reading or figure, or the estimate while that follows the optics. A flow
        that a person has set, and a pause, need only what their range is judged by. An experiment
        measures with the laser.
        """
        context, observer = self._context, self._context.observer
        if observer.repeats_sample and not self._estimation.blind:
            return True  # rule `displacement_frozen` limits for how long
        if self.state == State.TUNE and not self._config.by_optics:
            return math.isfinite(observer.laser_um) or self._estimation.held_by_optics
        if self.state == State.MANUAL or context.paused:
            return math.isfinite(observer.guard_um)
        if self._estimation.blind:
            return False
        estimated = self.state in (State.SETTLE, State.HOLD) and self._estimation.held_by_optics
        return math.isfinite(observer.displacement_um) or estimated

    def _explain_unseen_film(self) -> str:
        """Why a bench without a laser cannot be held by its optics; empty if it can."""
        if not self._config.by_optics:
            return ""
        if self._estimation.optics_left_out:
            return "the sag jumps again and again"
        if self._estimation.blind:
            return "the figures do not fit the estimate"
        return self._context.observer.figures.explain_unseen().text

    def _begin_tick(self, inputs: TickInputs, events: list[Event]) -> None:
        """Take time, interlocks and commands of a tick, and end a trial of gains that is over."""
        context = self._context
        self.memory.ticks += 1
        nominal_s = 1.0 / self._config.loop.rate_hz
        # The time since the last tick, within what the loop's numerics stand.
        context.now_s = inputs.now_s
        context.dt_s = min(max(inputs.dt_s, _DT_RANGE[0] * nominal_s), _DT_RANGE[1] * nominal_s)
        if self.memory.ticks == 1:
            self._shape.switch(self._config.shape.enabled, inputs.now_s)
        if math.isnan(self.memory.state_since_s):  # the state's first tick
            self.memory.state_since_s = inputs.now_s
        context.state_age_s = inputs.now_s - self.memory.state_since_s
        context.found_response = None
        context.found_pump = None
        # Interlocks before commands: a circuit that opens refuses them.
        events += context.interlocks.observe_reading(inputs.reading, self.state)
        self._answers = []
        self._clear_mask = 0
        obeyed: set[str] = set()
        for command in command_precedence.sort_commands(inputs.commands):
            if self._handle_command(command, obeyed, events):
                obeyed.add(command.kind)
        # Gains on trial that were not kept in time go back.
        if self._gains.is_overdue(context.now_s):
            self._revert_gains("the trial expired before they were kept", events)
        context.loop.may_probe = not self._gains.on_trial

    def _handle_command(
        self, command: Command, obeyed: Collection[str], events: list[Event]
    ) -> bool:
        """Execute or refuse a command; either way, record its sender and reason."""
        # The first reason to refuse counts. The experiment comes last: it is begun if nothing
        # refuses it
        refused = (
            command_precedence.explain_overruled(command, obeyed)
            or locks.refuse_while_locked(command, self._context.locks)
            or commands.explain_refusal(command, self.state, self._present_config)
            or self._refuse_by_condition(command)
            or self._begin_experiment(command)
        )
        self._answers.append((command.number, refused))
        events.append(command_event.make_command_event(command, refused))
        if not refused:
            self._execute_command(command, events)
        return not refused

    def _execute_command(self, command: Command, events: list[Event]) -> None:
        """Carry out an accepted command; the wish of a state goes to its handler
        (`apply_command`).
        """
        context = self._context
        match command.kind:
            case "setpoint" if math.isfinite(self.memory.setpoint_back_um):  # it stays
                self.memory.setpoint_back_um = command.value
            case "gains":
                assert command.loop is not None  # checked by `explain_refusal`
                self._gains.begin(command.loop, command, context.now_s)
                self._set_gains(command.loop)
            case "keep":
                self._gains.keep()
                self._step_setpoint()
            case "shape_on" | "shape_off":
                self._shape.switch(command.kind == "shape_on", context.now_s)
                self.memory.shape_back = command.kind == "shape_on"
            case "resumed":
                self._resume.resumed(context.now_s - command.value)
            case "ack":
                self._clear_mask = ALL_FAULTS
            case "latch":
                self._set_lock(command, events)
            case "unlock":
                self._remove_lock(command, events)
        apply_command(context, command, self.state)

    def _set_lock(self, command: Command, events: list[Event]) -> None:
        lock = locks.make_lock(command, self._context.locks)
        if lock is not None:
            self._context.locks = (*self._context.locks, lock)
            events.append(LockSet(**asdict(lock), number=command.number))

    def _remove_lock(self, command: Command, events: list[Event]) -> None:
        """Remove the lock that an accepted `unlock` means, and report by which right."""
        context = self._context
        unlocking = locks.decide_unlock(command, context.locks)
        lock = unlocking.lock
        assert lock is not None  # checked by `refuse_while_locked`
        context.locks = tuple(each for each in context.locks if each != lock)
        event = LockRemoved(
            word=lock.word,
            text=lock.text,
            author=lock.author,
            set_utc=lock.set_utc,
            remover=command.who,
            how=unlocking.reason.value,
            number=command.number,
        )
        events.append(event)

    def _refuse_by_condition(self, command: Command) -> str:
        """Why a fault, an interlock, a safe level or a limit forbids a command that its state
        allows; empty if none does.
        """
        context = self._context
        if command.kind == "hold" and context.latched:
            return f"a fault is latched: {context.latched}; acknowledge it first"
        if command.kind == "hold" and self.state == State.STANDBY and context.interlocks.last_mask:
            return (
                f"{context.interlocks.describe_open(context.interlocks.last_mask)}; close it first"
            )
        if command.kind in ("manual", "tune") and context.levels.safe_level != SafeLevel.NONE:
            return "the safety table holds the mean flow"
        if math.isfinite(command.setpoint_step_um):
            # The step of a trial begins at the setpoint of people, not at a step of an earlier one
            now_um = (
                self.memory.setpoint_back_um
                if math.isfinite(self.memory.setpoint_back_um)
                else context.setpoint_um
            )
            stepped = replace(command, kind="setpoint", value=now_um + command.setpoint_step_um)
            return commands.explain_refusal(stepped, self.state, self._present_config)
        return ""

    def _begin_experiment(self, command: Command) -> str:
        """Begin the experiment of a `tune`; returns why it cannot begin, or an empty text."""
        context, spec = self._context, command.experiment
        if command.kind != "tune" or spec is None:
            return ""
        centre_um = context.setpoint_um + context.setpoint_shift_um
        try:
            begun = trial.begin_trial(spec, context.loop_config, context.pump_config, centre_um)
            context.begin_trial(trial.Trial(begun, self._config.loop.rate_hz))
        except ValueError as error:
            return str(error)
        context.hold_wanted = False
        return ""

    def _set_gains(self, loop: LoopConfig) -> None:
        """Give the present gains, curve and time constant to every part that uses them."""
        context, pump = self._context, self._gains.present.pump
        if pump != context.pump_config:
            context.loop.set_pump(pump)
        context.loop_config = loop
        context.pump_config = pump
        context.loop.set_gains(loop)
        self._estimation.set_gains(loop)
        self._process_value.set_loop(loop, pump, self._estimator)
        self._consistency.set_gains(loop, pump)
        self._shape.set_time_constant(self._gains.present.shape_time_constant_s)
        self._held.set_time_constant(self._gains.present.shape_time_constant_s)
        self._step_setpoint()

    def _step_setpoint(self) -> None:
        """Step the setpoint as the trial asks, with the shape loop off; after the trial both are as
        before it.
        """
        # A setpoint to return to is kept exactly while a step is on trial
        context, step_um = self._context, self._gains.setpoint_step_um
        stepped = math.isfinite(self.memory.setpoint_back_um)
        if math.isfinite(step_um):
            if not stepped:
                self.memory.setpoint_back_um = context.setpoint_um
                self.memory.shape_back = self._shape.on
                self._shape.switch(False, context.now_s)
            context.setpoint_um = self.memory.setpoint_back_um + step_um
        elif stepped:
            context.setpoint_um = self.memory.setpoint_back_um
            self.memory.setpoint_back_um = math.nan
            self._shape.switch(self.memory.shape_back, context.now_s)

    def _revert_gains(self, why: str, events: list[Event]) -> None:
        self._gains.revert()
        self._set_gains(self._gains.present.loop)
        events.append(GainsReverted(why))

    def _consider_resuming(self, observation: Observation) -> None:
        """Decide whether a latched fault may clear automatically (`resume`)."""
        context, resume = self._context, self._resume
        if self.state != State.FAULT or self.fault is None:
            resume.forget()
            context.may_resume = context.resume_possible = False
            return
        context.may_resume = resume.is_due(self.fault, context.levels, observation, context.now_s)
        context.resume_possible = resume.possible
        self._clear_mask |= resume.clear_mask

    def _apply_verdict(self, verdict: safety.Verdict, events: list[Event]) -> None:
        """Enter the safe level of the verdict; every level below HOLD_FLOW latches the fault."""
        levels, losses, now_s = self._context.levels, self._short_losses, self._context.now_s
        events += losses.report_count(now_s)
        # No rule trips: a level that only held the flow is over; deeper ones stay latched.
        rule = verdict.rule
        if rule is None:
            if levels.safe_level == SafeLevel.HOLD_FLOW:
                levels.clear(now_s)
                if self.fault is None:
                    events.append(Cleared(""))
                else:
                    cleared = Cleared(self.fault.name)
                    events += losses.end_fault(self.fault.code, cleared, now_s)
                self.fault = None
            return
        # A fault begins, or a deeper one takes its place.
        if verdict.safe_level > SafeLevel.HOLD_FLOW >= levels.safe_level:
            self.fault = rule
            events.append(rule.fault(verdict.seen, verdict.safe_level))
        elif self.fault is None:
            self.fault = rule
            events += losses.begin_fault(rule.fault(verdict.seen, verdict.safe_level), now_s)
        # The level deepens with time, too: a fault that held the flow becomes one that ramps down.
        levels.enter(verdict.safe_level, now_s)
        is_deeper = levels.step(now_s) > SafeLevel.HOLD_FLOW
        if losses.must_list(now_s, is_deeper):
            seen = verdict.seen if rule.code == self.fault.code else ""
            events.append(self.fault.fault(seen, verdict.safe_level))
        if is_deeper and self.state != State.FAULT:
            self._enter_state(State.FAULT, f"{self.fault.name}: {self.fault.cause}", events)

    def _step_shape(self, inputs: TickInputs, events: list[Event]) -> shape_loop.ShapeOutput:
        """Run the shape loop, and set the trim; it counts only while the loop moves the mirror."""
        context = self._context
        # May the figure move the setpoint?
        settled = self.state == State.HOLD and context.levels.safe_level == SafeLevel.NONE
        if self._consistency.laser_moved and self._shape.on:
            self._shape.lock(inputs.now_s)
        distrust = self._consistency.camera_distrust
        if distrust == NO_REASON and self._config.by_optics:
            distrust = _WITHOUT_LASER
        try:
            shape = self._shape.step(
                inputs.now_s,
                context.dt_s,
                inputs.estimate,
                context.observer.displacement_um,
                settled,
                distrust,
            )
        except (ValueError, ArithmeticError, LinAlgError) as error:
            self.memory.tick_error = f"shape loop: {type(error).__name__}: {error}"
            shape = self._shape.output(inputs.now_s)
        # The trim, and an event if the loop's state has changed.
        context.trim_um = shape.trim_um if self.state in state_sets.MOVING else 0.0
        reported = ReportedShape(shape.state, shape.reason.code)
        if reported != self.memory.reported_shape:
            self.memory.reported_shape = reported
            events.append(
                ShapeLoopState(shape.state.name.lower(), shape.reason.text, shape.reason.code)
            )
        return shape

    def _step_held(self, events: list[Event]) -> None:
        """Move the centre so that the held scalar stays.

        After an error the offset is that of the tick before, until `tick_error` latches a fault in
        the next tick. The offset counts only while the loop moves the mirror: otherwise it is 0 in
        the context, and the memory of `HeldOffset` keeps it for the next hold.
        """
        context = self._context
        try:
            events += self._held.step(
                context, self.state, self._shape.on, self._consistency.camera_distrust
            )
        except (ValueError, ArithmeticError, LinAlgError) as error:
            self.memory.tick_error = f"held scalar: {type(error).__name__}: {error}"
        if self.state not in state_sets.MOVING:
            context.held_offset_um = 0.0

    def _run_state(self, events: list[Event]) -> None:
        """Run the state's handler; everything is off unless it sets it."""
        context = self._context
        context.output = None
        context.pump_fraction = 0.0
        context.vent_fraction = 0.0
        try:
            wanted = state_handlers.run_state(self.state, context)
        except Exception as error:
            self.memory.tick_error = f"{type(error).__name__}: {error}"
            # an error must not close an open vent
            vents = context.venting or context.levels.safe_level == SafeLevel.VENT
            context.output = None
            context.pump_fraction = 0.0
            context.vent_fraction = float(vents)
            if self.state == State.FAULT:  # no safer state is left
                context.finished = errors.Exit.SAFETY_TRIP
            return
        for name, fraction in (("pump", context.pump_fraction), ("vent", context.vent_fraction)):
            if not 0.0 <= fraction <= 1.0:
                self.memory.tick_error = (
                    f"{name} command {fraction} from state {self.state.name.lower()}"
                )
                context.pump_fraction = 0.0
                context.vent_fraction = 0.0
        if wanted != self.state:
            self._enter_state(wanted, context.why.text, events)

    def _use_pump(self, events: list[Event]) -> None:
        """Let the loop use the size of a pump that was found much stronger than assumed."""
        context = self._context
        pump = context.found_pump
        if pump is None or self._gains.on_trial:
            return
        assumed_um_per_s = self._config.pump.flow_full_um_per_s
        loop = context.loop_config
        if loop.flow_max_um_per_s >= assumed_um_per_s:
            # The limit was that of the assumed pump. From none to full within two seconds
            most_um_per_s = min(pump.flow_full_um_per_s, 2.0 * loop.flow_rate_limit_um_per_s2)
            loop = loop.model_copy(update={"flow_max_um_per_s": most_um_per_s})
        self._gains.replace_pump(pump, loop)
        self._set_gains(loop)
        # The loop began in this tick at the flow of the leak, by the assumed curve
        context.loop.start(context.observer.displacement_um, context.found_leak_um_per_s)
        events.append(PumpStronger(pump.flow_full_um_per_s, assumed_um_per_s))

    def _use_response(self, events: list[Event]) -> None:
        """Let loop and estimate use a response that was identified in this tick."""
        context = self._context
        found = context.found_response
        if found is None:
            return
        # Loop, estimate and comparison predict with the same dead time and lag
        context.pump_response = found
        estimator = self._estimator
        context.loop.set_pump_lag(estimator)
        self._estimation.set_estimator(estimator)
        self._process_value.set_loop(context.loop_config, context.pump_config, estimator)
        self._process_value.forget_verdict()
        events.append(
            PumpResponseFound(
                delay_s=found.delay_s,
                delay_sigma_s=found.delay_sigma_s,
                lag_s=found.lag_s,
                lag_sigma_s=found.lag_sigma_s,
                sum_s=found.sum_s,
                sum_sigma_s=found.sum_sigma_s,
            )
        )
        if self._config.estimator.pump_response == "identified":
            self._limit_gains(found, events)

    def _limit_gains(self, response: PumpResponse, events: list[Event]) -> None:
        """Slow down a loop that is too quick for the pump, unless a person has set its gains."""
        # Gains that a person has set, or that are on trial, are that person's responsibility
        stated, present = self._config.loop, self._gains.present.loop
        limited = limit_gains(present, response)
        set_by_person = present not in (stated, self._gains.memory.limited)
        if self._gains.on_trial or set_by_person or limited is present:
            return
        self._gains.limit(limited)
        self._set_gains(limited)
        events.append(
            GainsLimited(
                kp_per_s=limited.kp_per_s,
                ti_s=limited.ti_s,
                stated_kp_per_s=stated.kp_per_s,
                stated_ti_s=stated.ti_s,
            )
        )

    def _enter_state(self, state: State, why: str, events: list[Event]) -> None:
        """Leave the present state and begin another one; both are reported with the reason."""
        context = self._context
        events.append(StateEntered(state.name.lower(), self.state.name.lower(), why))
        # What ends with the former state: an experiment, gains on trial, a fault.
        if self.state == State.TUNE:
            self._report_experiment(why, events)
        if state != State.TUNE:
            context.end_trial()
        if state == State.FAULT and self._gains.on_trial:
            self._revert_gains("a fault occurred during the trial", events)
        if self.state == State.FAULT:  # acknowledged, or may resume
            if not context.acknowledged and self.fault is not None:
                self._resume.resumed(context.now_s)
                events.append(Resumed(self.fault.name))
            self.fault = None
            self.memory.tick_error = ""
            context.levels.leave()
            context.acknowledged = False
        # What the new state begins with.
        if state == State.STANDBY:
            context.venting = False
        context.manual_wanted = context.paused = False  # they end with their hold
        self.memory.state = state
        self.memory.state_since_s = math.nan
        context.good_since_s = context.last_good_s = context.highest_um = context.highest_s = (
            math.nan
        )
        context.overdue = context.unfit = ""
        context.test_memory = None

    def _report_experiment(self, why: str, events: list[Event]) -> None:
        """Report how the experiment ended: as planned, or because the state changed."""
        experiment = self._context.trial
        assert experiment is not None
        ended = self._context.trial_ended or Finished(ExperimentEnd.INTERRUPTED, why)
        events.append(
            ExperimentEnded(experiment.spec.kind, ended.completed, ended.reason, ended.end.value)
        )

    def _report_reason(self, events: list[Event]) -> None:
        """Report the operator's line once its reason (not its numbers) has changed durably."""
        # A reason that changes to and fro within a second would fill the record
        context, memory = self._context, self.memory
        code = context.why.code
        if code != memory.why_code:
            memory.why_code = code
            memory.why_since_s = context.now_s
        if code != memory.reported_why_code and context.now_s - memory.why_since_s >= _WHY_STANDS_S:
            memory.reported_why_code = code
            events.append(Why(context.why.text, code))
