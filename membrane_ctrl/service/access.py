"""The roles of viewers, and what they may ask of a hold."""

from __future__ import annotations

from typing import Any

from membrane_ctrl.control_port.sender import role_includes
from membrane_ctrl.model.columns import unit_of
from membrane_ctrl.model.numbers import parse_number
from membrane_ctrl.service.action_button import ActionButton
from membrane_ctrl.service.web_user import WebUser

STOP = ActionButton("stop", "STOP", "stop_circle")
UNLOCK = ActionButton(
    "unlock", "Unlock", "lock_open", "text"
)  # none of `ACTIONS`, which the bridges offer as well
ACTIONS = (
    ActionButton("hold", "Hold", "play_arrow"),
    ActionButton("pause", "Pause", "pause"),
    ActionButton("resume", "Resume", "play_circle"),
    ActionButton("setpoint", "Setpoint", "straighten", "number", unit_of("setpoint_um")),
    ActionButton("manual", "Manual flow", "tune", "number", unit_of("flow_um_per_s")),
    ActionButton("shape_on", "Shape loop on", "toggle_on"),
    ActionButton("shape_off", "Shape loop off", "toggle_off"),
    ActionButton("mark", "Mark", "bookmark", "text"),
    ActionButton("capture", "Capture set", "photo_camera"),
    ActionButton("keep", "Keep gains", "done_all"),
    ActionButton("ack", "Clear fault", "check_circle"),
    ActionButton("quiet", "Quiet alarms", "notifications_off"),
    ActionButton("lower", "Lower", "south"),
    ActionButton("vent", "Vent", "air"),
    ActionButton("latch", "Lock", "lock", "text"),
)


def is_action_allowed(user: WebUser, port_role: str, action: ActionButton) -> bool:
    """Whether the viewer's role and that of this process at the port both allow an action.

    Parameters
    ----------
    user : WebUser
        The viewer; the role is of the account, the link or the token.
    port_role : str
        Role that the hold's port has granted this process; empty before it has: as `read`.
    action : ActionButton
        States the role that it needs.
    """
    return role_includes(user.role, action.role) and role_includes(port_role, action.role)


def on_behalf(user: WebUser, session: str) -> dict[str, str]:
    """What the service states of a viewer in each request (`protocol.OnBehalf`).

    Parameters
    ----------
    user : WebUser
        The viewer; the hold trusts the name only because this service has verified the login.
    session : str
        Of the viewer.

    Returns
    -------
    dict
    """
    account = user.name if user.has_login else ""
    return {
        "via": user.via,
        "account": account,
        "name": user.name,
        "session": session,
        "role": user.role,
    }


def request(action: ActionButton, why: str, given: str, take_over: bool = False) -> dict[str, Any]:
    """The request to send.

    Parameters
    ----------
    action : ActionButton
        The command, and which input it asks for.
    why : str
        Who asks, for the records of the run.
    given : str
        The input as typed; not read if the command asks for none.
    take_over : bool
        Take command from the session that has it.

    Returns
    -------
    dict
        A request of the control port (docs/reference/control-port.md), without `on_behalf`.

    Raises
    ------
    ValueError
        What is wrong with the input, in a sentence for the viewer.
    """
    asked: dict[str, Any] = {"do": action.do, "why": why, "take_over": take_over}
    if action.asks == "number":
        try:
            asked["value"] = parse_number(given)
        except ValueError as error:
            raise ValueError(f"{action.label}: enter a number in {action.unit}: {error}") from None
    elif action.asks == "text":
        if not given.strip() and action.do == "mark":
            raise ValueError("Mark: enter a text")
        if given.strip():
            asked["text"] = given.strip()
    return asked
