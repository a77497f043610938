"""What a viewer may ask of a hold: the commands of `ctl` that need one number or one text at most."""

import math
from dataclasses import dataclass
from typing import Any, Literal

from membrane_ctrl.controller.commands import ANY, TABLE, Kind, Role
from membrane_ctrl.web.access import WebUser

_RANK: dict[str, int] = {"read": 0, "operate": 1, "tune": 2}


@dataclass(frozen=True, slots=True)
class Action:
    """A button.

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
        return "Acknowledge the alarms: no reminders." if self.do == "quiet" else TABLE[self.do].does

    @property
    def states(self) -> frozenset[str]:
        """States in which the hold obeys, in lower case; all for `quiet`."""
        return frozenset(state.name.lower() for state in (ANY if self.do == "quiet" else TABLE[self.do].states))


STOP = Action("stop", "STOP", "stop_circle")
ACTIONS = (
    Action("hold", "Hold", "play_arrow"),
    Action("pause", "Pause", "pause"),
    Action("resume", "Resume", "play_circle"),
    Action("setpoint", "Setpoint", "straighten", "number", "um"),
    Action("manual", "Manual flow", "tune", "number", "um/s"),
    Action("shape_on", "Shape loop on", "toggle_on"),
    Action("shape_off", "Shape loop off", "toggle_off"),
    Action("mark", "Mark", "bookmark", "text"),
    Action("capture", "Capture set", "photo_camera"),
    Action("keep", "Keep gains", "done_all"),
    Action("ack", "Clear fault", "check_circle"),
    Action("quiet", "Quiet alarms", "notifications_off"),
    Action("lower", "Lower", "south"),
    Action("vent", "Vent", "air"),
    Action("latch", "Lock", "lock", "text"),
)


def may(user: WebUser, port_role: str, action: Action) -> bool:
    """Whether the viewer's role and that of this process at the port both allow it."""
    return min(_RANK[user.role], _RANK.get(port_role, 0)) >= _RANK[action.role]


def request(action: Action, user: WebUser, given: str, take_over: bool = False) -> dict[str, Any]:
    """The request to send. Raises ValueError with what is wrong with the input."""
    asked: dict[str, Any] = {"do": action.do, "why": f"web: {user.name}", "take_over": take_over}
    if action.asks == "number":
        try:
            value = float(given.replace(",", "."))
        except ValueError:
            raise ValueError(f"{action.label}: enter a number in {action.unit}") from None
        if not math.isfinite(value):
            raise ValueError(f"{action.label}: enter a finite number in {action.unit}")
        asked["value"] = value
    elif action.asks == "text":
        if not given.strip() and action.do == "mark":
            raise ValueError("Mark: enter a text")
        if given.strip():
            asked["text"] = given.strip()
    return asked
