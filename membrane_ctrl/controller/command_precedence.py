"""Which command of a tick comes first, and which ones it overrules."""

from collections.abc import Collection, Iterable

from membrane_ctrl.controller.command import Command, Kind

# Within one tick these come first, in this order: the safest wins
DOWN: tuple[Kind, ...] = ("latch", "vent", "stop", "lower")
# these can lift the mirror and are not obeyed in the same tick
_OVERRULED: frozenset[str] = frozenset({"hold", "manual", "tune", "resume", "ack", "unlock"})


def sort_commands(commands: Iterable[Command]) -> list[Command]:
    """Commands of a tick, safest first, the others in order of arrival."""
    return sorted(
        commands,
        key=lambda command: DOWN.index(command.kind) if command.kind in DOWN else len(DOWN),
    )


def explain_overruled(command: Command, obeyed: Collection[str]) -> str:
    """Say which command of the same tick overrules this one.

    Parameters
    ----------
    command : Command
        The next one in the order of `sort_commands`.
    obeyed : collection of str
        Names of the commands that the tick has accepted before.

    Returns
    -------
    str
        The refusal; empty if none does.
    """
    winner = next((kind for kind in DOWN if kind in obeyed), "")
    if command.kind not in _OVERRULED or not winner:
        return ""
    return f"{winner} came at the same time and takes precedence; send again"
