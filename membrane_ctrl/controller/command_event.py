"""The event that records a command and its refusal."""

import math

from membrane_ctrl.controller.command import Command
from membrane_ctrl.model.events import CommandTaken


def make_command_event(command: Command, refused: str) -> CommandTaken:
    """Return the event of a command: its sender, reason and settings.

    Parameters
    ----------
    command : Command
        As the tick got it, executed or not.
    refused : str
        Why it was refused; empty: it was not.
    """
    spec, experiment = command.experiment, None
    if spec is not None:
        experiment = spec.model_dump(exclude=None if spec.steps else {"steps"})
    return CommandTaken(
        command=command.kind,
        who=command.who,
        why=command.why,
        value=_or_none(command.value),
        text=command.text or None,
        loop=_list_settings(command),
        experiment=experiment,
        shape_time_constant_s=_or_none(command.shape_time_constant_s),
        setpoint_step_um=_or_none(command.setpoint_step_um),
        refused=refused or None,
    )


def _or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _list_settings(command: Command) -> dict[str, object] | None:
    """What a `gains` sets, for its event: the loop's keys, and the pump's table if that changes."""
    if command.loop is None:
        return None
    return command.loop.model_dump() | (
        {} if command.pump is None else {"pump": command.pump.model_dump()}
    )
