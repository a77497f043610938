"""The commands of a running hold, the role that each needs and the states in which it is allowed.

The control port checks the role, the tick the state.
"""

import math

from membrane_ctrl.config.schema import Config
from membrane_ctrl.controller.command import Command, CommandRule, Kind
from membrane_ctrl.controller.state_sets import MOVING
from membrane_ctrl.model.telemetry import State

AT_START = "command line"  # sender of the first commands
AT_END = "duration"  # sender of the last `stop`
TRIAL_MAX_S = 7200.0  # a longer trial would be unattended
TURN_MAX_DEG = 360.0  # of a mirror about its axis
TIME_CONSTANT_MAX_S = 1e5  # of the shape loop, as in the configuration

# People lock the mirror with `lock`; `latch` is the name of that command in the protocol, in the
# bridges and in the recorded inputs. Either name is accepted wherever a command is named.
SAME_AS: dict[str, Kind] = {"lock": "latch"}


ANY = frozenset(State)
RUNNING = MOVING | {State.STANDBY, State.CHECK}
_HOLD, _PARKED, _FLOW = (
    {State.HOLD},
    {State.STANDBY, State.MANUAL, State.TUNE},
    {State.SETTLE, State.HOLD, State.MANUAL},
)
# Allowed in a run that only observes
_OBSERVING: frozenset[Kind] = frozenset({"mark", "stop", "latch", "unlock"})


TABLE: dict[Kind, CommandRule] = {
    "setpoint": CommandRule(
        "operate", RUNNING, "Ramp to a laser setpoint, in µm.", needs=("value",)
    ),
    "hold": CommandRule("operate", _PARKED, "Hold the mirror, or return to holding it."),
    "pause": CommandRule("operate", _HOLD, "Pause the loop; the pump keeps its mean flow."),
    "resume": CommandRule("operate", _HOLD, "Resume the loop after a pause."),
    "manual": CommandRule(
        "operate", _FLOW, "Set the pump's flow by hand, in µm/s of the centre.", needs=("value",)
    ),
    "gains": CommandRule(
        "tune",
        RUNNING,
        "Set gains, on trial or to stay.",
        needs=("loop",),
        takes=("value", "shape_time_constant_s", "pump", "setpoint_step_um"),
    ),
    "keep": CommandRule("tune", RUNNING, "Keep the gains on trial."),
    "tune": CommandRule("tune", _HOLD, "Run a tuning experiment.", needs=("experiment",)),
    "shape_on": CommandRule("operate", ANY, "Switch the shape loop on."),
    "shape_off": CommandRule("operate", ANY, "Switch the shape loop off."),
    "mark": CommandRule("operate", ANY, "Add a remark to the timeline.", needs=("text",)),
    "capture": CommandRule(
        "operate", _HOLD, "Save a full capture set to the run's raw/ folder.", takes=("value",)
    ),
    "ack": CommandRule(
        "operate",
        {State.STANDBY, State.FAULT},
        "Clear a latched fault and acknowledge the alarms; locks stay.",
    ),
    "lower": CommandRule("operate", RUNNING, "Stop the pump; the leak lowers the mirror."),
    "vent": CommandRule("operate", ANY, "Open the vent."),
    "stop": CommandRule("operate", ANY, "End the run safely; never refused."),
    "latch": CommandRule(
        "operate", ANY, "Lock the mirror: pump off, no hold until `unlock`.", takes=("text",)
    ),
    "unlock": CommandRule(
        "operate", ANY, "Remove your lock, or another person's by typing its word.", takes=("text",)
    ),
}


def explain_refusal(command: Command, state: State, config: Config) -> str:
    """Say why a command cannot be executed now.

    Parameters
    ----------
    command : Command
        Any, also one that no state allows.
    state : State
        Of the controller.
    config : Config
        Limits of its values.

    Returns
    -------
    str
        Empty if it can.
    """
    # What no person sends: the start of a run informs the tick of earlier runs.
    if command.kind == "resumed" or command.kind == "latched":
        return (
            ""
            if command.who == AT_START
            else "only the start of a run may report earlier resumes and faults"
        )
    # Allowed in this run, and in this state?
    if config.states.observe and command.kind not in _OBSERVING:
        return "this run only observes (states.observe): it commands neither pump nor vent"
    rule = TABLE[command.kind]
    if state not in rule.states:
        where = ", ".join(sorted(s.name.lower() for s in rule.states))
        return f"{command.kind} is not allowed in state {state.name.lower()}; allowed in {where}"
    # Values that the present configuration does not allow.
    if command.kind == "shape_off" and config.by_optics:
        return "the mirror is held by the optics alone (estimator.process_value)"
    if command.kind == "setpoint":
        low, high = config.limits.displacement_min_um, config.limits.displacement_max_um
        if not low < command.value < high:
            return f"setpoint {command.value:g} µm is outside the limits ({low:g} .. {high:g} µm)"
    most_um_per_s = config.loop.flow_most_um_per_s(config.pump)
    if command.kind == "manual" and not 0.0 <= command.value <= most_um_per_s:
        return f"flow {command.value:g} µm/s is outside 0 .. {most_um_per_s:g} µm/s"
    if command.kind == "tune" and command.experiment is None:
        return "tune: experiment missing"
    if command.kind == "gains" and command.loop is None:
        return "gains: missing"
    if command.kind == "gains" and not (
        math.isnan(command.value) or 1.0 <= command.value <= TRIAL_MAX_S
    ):
        return f"gains on trial for {command.value:g} s: a trial takes 1 .. {TRIAL_MAX_S:g} s"
    averaged_s = command.shape_time_constant_s
    if not (math.isnan(averaged_s) or 1.0 <= averaged_s <= TIME_CONSTANT_MAX_S):
        return f"shape.time_constant_s = {averaged_s:g} s is outside 1 .. {TIME_CONSTANT_MAX_S:g} s"
    if math.isfinite(command.setpoint_step_um) and math.isnan(command.value):
        return "setpoint_step_um is for a trial: give its time as value"
    if (
        command.kind == "gains"
        and command.loop is not None
        and command.loop.rate_hz != config.loop.rate_hz
    ):
        return "the tick rate cannot be changed during a run"
    if command.kind == "capture" and abs(command.value) > TURN_MAX_DEG:
        return f"a mirror turned by {command.value:g} degrees: at most {TURN_MAX_DEG:g} either way"
    if command.kind == "capture" and not config.shape.enabled:
        return "no shape measurement in this run: [shape] enabled = false"
    return ""
