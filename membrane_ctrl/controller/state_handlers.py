"""The handler of each state, and the requests that take precedence over it."""

from collections.abc import Callable

from membrane_ctrl.controller import states
from membrane_ctrl.controller.tick_context import TickContext
from membrane_ctrl.model.reason import WhyCode
from membrane_ctrl.model.telemetry import State

HANDLERS: dict[State, Callable[[TickContext], State]] = {
    State.STANDBY: states.standby,
    State.CHECK: states.check,
    State.INFLATE: states.inflate,
    State.SETTLE: states.settle,
    State.HOLD: states.hold,
    State.MANUAL: states.manual,
    State.TUNE: states.tune,
    State.LOWER: states.lower,
    State.FAULT: states.fault,
}


def run_state(state: State, context: TickContext) -> State:
    """Run the state's handler.

    Parameters
    ----------
    state : State
        The present state.
    context : TickContext
        What the handler reads, and gets: command of pump and vent, and why.

    Returns
    -------
    State
        The next one; a request for another state takes precedence.
    """
    if context.config.states.observe:
        return states.observe(context)
    if context.way_down is not None and state not in (State.LOWER, State.FAULT):
        states.explain_way_down(context)
        return State.LOWER
    if (
        state in (State.INFLATE, State.SETTLE, State.HOLD)
        and (elsewhere := _find_requested_state(context)) is not None
    ):
        return elsewhere
    return HANDLERS[state](context)


def _find_requested_state(context: TickContext) -> State | None:
    """The requested state, if it is not a hold."""
    if context.trial is not None:
        # the loop runs this tick: otherwise the pump would be off for 20 ms
        states.drive_pump(context, context.setpoint_um)
        requested = f"{context.asked_by} requested the experiment {context.trial.spec.kind}"
        context.explain(WhyCode.EXPERIMENT_REQUESTED, requested)
        return State.TUNE
    if context.manual_wanted:
        context.hold_wanted = False
        context.explain(WhyCode.MANUAL_REQUESTED, f"{context.asked_by} took over the pump")
        context.mean_flow_um_per_s = context.loop.mean_flow_um_per_s
        context.keep_flowing()
        return State.MANUAL
    return None
