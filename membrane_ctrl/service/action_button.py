"""A button of the page: a command that takes at most one number or one text."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Literal, cast

from membrane_ctrl.controller.command import Kind, Role
from membrane_ctrl.controller.commands import ANY, TABLE


@dataclass(frozen=True, slots=True)
class ActionButton:
    """A button: a command of `ctl` that takes at most one number or one text.

    `asks` is what the viewer types: a number in the given unit, a text, or nothing but yes.
    """

    do: Kind | Literal["quiet"]
    label: str
    icon: str  # a Material icon's name
    asks: Literal["", "number", "text"] = ""
    unit: str = ""

    @property
    def role(self) -> Role:
        """The role that it needs."""
        return "operate" if self.do == "quiet" else TABLE[self.do].role

    @property
    def does(self) -> str:
        """What it does, in a sentence."""
        return (
            "Acknowledge the alarms: no reminders." if self.do == "quiet" else TABLE[self.do].does
        )

    @property
    def states(self) -> frozenset[str]:
        """States in which the hold obeys, in lower case; all for `quiet`."""
        return _states(self.do)


@cache  # asked for each button of each viewer
def _states(do: str) -> frozenset[str]:
    return frozenset(
        state.name.lower() for state in (ANY if do == "quiet" else TABLE[cast(Kind, do)].states)
    )
