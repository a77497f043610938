"""One command from a bridge to the hold, on a connection of its own. Blocking: it runs on a thread
of the lanes.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from membrane_ctrl.control_port.ctl import Where, connected
from membrane_ctrl.control_port.outcome import Outcome
from membrane_ctrl.control_port.safety_commands import is_safety_command
from membrane_ctrl.model import errors

Message = dict[str, Any]


@dataclass(frozen=True, slots=True)
class SendLimits:
    """What may keep a command from being sent after the hold has answered the connection."""

    deadline_s: float  # monotonic time; later it is not sent, and the hold does not obey it
    refusal: Callable[[], str]  # why it must not be sent any more; empty if it may


def send_command(where: Where, run: str, request: Message, limits: SendLimits) -> Outcome:
    """Send a command to the run named `run`; returns what became of it.

    A hold that hangs does not greet, so nothing is sent to it that it could obey a minute later. If
    it hangs between greeting and tick, it refuses the command by its time limit. Safety commands
    have none of these conditions.
    """
    kind = str(request["do"])
    what = kind.replace("_", " ")
    try:
        with connected(where, notice=_ignore_notice) as client:
            if not is_safety_command(kind):
                if client.greeting.get("run") != run:
                    return Outcome.failed(
                        what, "not sent: another run is listening now; look again"
                    )
                if reason := _late_reason(limits):
                    return Outcome.refused(what, reason)
                request = request | _expiry(client.greeting, limits.deadline_s)
            answer = client.ask(**request)
    except errors.CommandError as error:
        return Outcome.failed(what, "; ".join(error.lines))
    return Outcome.from_answer(what, answer)


def _late_reason(limits: SendLimits) -> str:
    if time.monotonic() > limits.deadline_s:
        return "the hold answered too late, so it was not sent"
    return limits.refusal()


def _expiry(greeting: Message, deadline_s: float) -> Message:
    """The request's time limit on the hold's clock; none for a hold
    that does not send its clock.
    """
    now_s = greeting.get("now_s")
    if not isinstance(now_s, int | float):
        return {}
    return {"expires_s": now_s + deadline_s - time.monotonic()}


def _ignore_notice(text: str) -> None:
    """Notices are for people at a terminal."""
