"""One command to a hold on this machine, on a connection of its own. Blocking."""

from __future__ import annotations

import math
import time
from typing import Any

from membrane_ctrl.control_port.ctl import Where, connected
from membrane_ctrl.control_port.safety_commands import is_safety_command
from membrane_ctrl.model import errors
from membrane_ctrl.service.send_limits import SendLimits

Message = dict[str, Any]


NO_LIMITS = SendLimits()


def ask_hold(where: Where, run: str, request: Message, limits: SendLimits = NO_LIMITS) -> Message:
    """Send a command to the run named `run`; returns the hold's answer.

    A hold that hangs does not greet, so nothing is sent to it that it could obey a minute later. If
    it hangs between greeting and tick, it refuses the command by its time limit. Safety commands
    have none of these conditions.

    Raises DeviceError without an answer, or if another run is listening.

    Parameters
    ----------
    where : Where
        Of the hold.
    run : str
        Name of the run; a safety command goes to any run that listens.
    request : Message
        The command.
    limits : SendLimits
        Until when the command may be sent, and what else refuses it.
    """
    with connected(where, notice=_ignore_notice) as client:
        if not is_safety_command(str(request["do"])):
            if client.greeting.get("run") != run:
                raise errors.DeviceError("not sent: another run is listening now; look again")
            if reason := limits.find_refusal():
                return {"ok": False, "refused": reason}
            request = request | _make_expiry(client.greeting, limits.deadline_s)
        return client.ask(**request)


def _make_expiry(greeting: Message, deadline_s: float) -> Message:
    """The request's time limit on the hold's clock; none for a hold
    that does not send its clock.
    """
    now_s = greeting.get("now_s")
    if not isinstance(now_s, int | float) or math.isinf(deadline_s):
        return {}
    return {"expires_s": now_s + deadline_s - time.monotonic()}


def _ignore_notice(text: str) -> None:
    """Notices are for people at a terminal."""
