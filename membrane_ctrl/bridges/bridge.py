"""What all bridges have in common: the values that they publish, and who may act through them."""

import asyncio
import math
import time
from collections.abc import Callable
from typing import Any

from membrane_ctrl.bridges.command_lanes import CommandLanes
from membrane_ctrl.config.schema import Config
from membrane_ctrl.control_port.outcome import Outcome
from membrane_ctrl.control_port.protocol import TEXT_BYTES
from membrane_ctrl.control_port.safety_commands import is_safety_command
from membrane_ctrl.control_port.sender import role_includes
from membrane_ctrl.controller.command import Role
from membrane_ctrl.model.numbers import parse_number
from membrane_ctrl.service.access import ACTIONS, STOP, is_action_allowed, request
from membrane_ctrl.service.action_button import ActionButton
from membrane_ctrl.service.feed import HoldFeed
from membrane_ctrl.service.published_signal import Published
from membrane_ctrl.service.published_signals import SIGNAL_TABLE, Value
from membrane_ctrl.service.web_user import WebUser

# Who removes a lock must be known; the clients of a bridge are not.
_NEVER = frozenset({"unlock"})
COMMANDS = {str(action.do): action for action in (*ACTIONS, STOP) if str(action.do) not in _NEVER}
# the answer to a safety command stays for so long, whatever else is refused meanwhile
_SAFETY_SHOWN_S = 5.0


_ANSWER = Published("answer", "result of the last command", is_text=True)
TABLE = (*SIGNAL_TABLE, _ANSWER)


class Bridge:
    """The values that bridges publish and the commands that they may send, by role; shared by all
    bridges of the process.

    Parameters
    ----------
    feed : HoldFeed
        The hold that is published, with its signals; the caller opens and closes it.
    config : Config
        `[bridges]` sets name, role and period; limits and pump set the bounds of the numbers that a
        client may send.
    """

    def __init__(self, feed: HoldFeed, config: Config) -> None:
        self.feed = feed
        self.settings = config.bridges
        limits = config.limits
        flow_max = config.loop.flow_most_um_per_s(config.pump)
        # what the hold would accept; it judges by itself
        self.bounds: dict[str, tuple[float, float]] = {
            "setpoint": (limits.displacement_min_um, limits.displacement_max_um),
            "manual": (0.0, flow_max),
        }
        self._answer = ""
        self._safety_answered_s = -math.inf
        self._lanes = CommandLanes(feed.ask, self._report_late)
        # they get the late outcomes of safety commands
        self.late_listeners: list[Callable[[str], None]] = []
        # one bridge after the other: a server blocks the event loop while it opens
        self.opening = asyncio.Lock()

    def values(self) -> dict[str, Value]:
        """The values of `TABLE` now."""
        return {**self.feed.signal_values(), _ANSWER.name: self._answer}

    @property
    def live(self) -> bool:
        """Whether the values are those of a hold that answers."""
        return not self.feed.seen.silent

    @property
    def commands(self) -> dict[str, ActionButton]:
        """The commands that the settings allow; the hold may still refuse them."""
        user = WebUser("", self.settings.role)
        return {
            name: action
            for name, action in COMMANDS.items()
            if is_action_allowed(user, "tune", action)
        }

    async def ask(
        self, by: str, name: str, given: Any = "", role: Role | None = None, who: str = ""
    ) -> str:
        """Send a command, as `submit`, and wait for its outcome.

        Parameters
        ----------
        by : str
            The bridge: `mqtt`, `opcua` or `epics`; recorded with the command.
        name : str
            A key of `COMMANDS`, such as `setpoint`.
        given : object
            Its number (in the unit of the command's button, such as µm) or text, as the client
            sent it: a number, str, or bytes in UTF-8. Ignored by a command that takes neither.
        role : str or None
            Role of the client; None is the role of `[bridges]`.
        who : str
            Name of a client that has logged in; empty if the bridge does not know it.

        Returns
        -------
        str
            One line for people, with the time in UTC. A refusal is returned, too: nothing is
            raised.
        """
        return await self.submit(by, name, given, role, who)

    def submit(
        self, by: str, name: str, given: Any = "", role: Role | None = None, who: str = ""
    ) -> asyncio.Future[str]:
        """Accept or refuse a command at once.

        Parameters
        ----------
        by : str
            The bridge: `mqtt`, `opcua` or `epics`.
        name : str
            Name of the command.
        given : object
            Its number or text, as the client sent it.
        role, who : str
            Role and name of the client, where the bridge has them. A client can do no more than
            the role of `[bridges]` allows.

        Returns
        -------
        Future of str
            The outcome in one line; already done if the command was refused here.
        """
        # A command that the bridge itself refuses gets a future that is done, so that refused and
        # sent commands are answered in the same way below.
        try:
            asked = self._request(by, name, given, role or self.settings.role, who)
        except ValueError as error:
            outcome: asyncio.Future[Outcome] = asyncio.get_running_loop().create_future()
            outcome.set_result(Outcome(name, str(error)))
        else:
            outcome = self._lanes.submit(asked)
        answer: asyncio.Future[str] = asyncio.get_running_loop().create_future()

        def note(done: asyncio.Future[Outcome]) -> None:
            if not answer.done():
                answer.set_result(self._note_outcome(by, name, done.result()))

        if outcome.done():
            note(outcome)
        else:
            outcome.add_done_callback(note)
        return answer

    async def close(self) -> None:
        """End the lanes; safety commands under way get the rest of their time."""
        await self._lanes.close()

    def _note_outcome(self, by: str, name: str, outcome: Outcome) -> str:
        """Note an outcome as the value `answer`; refusals of a flood do not replace a safety
        command's answer.
        """
        answer = f"{time.strftime('%H:%M:%S', time.gmtime())} UTC, {by}: {outcome.text}"
        safety = is_safety_command(name)
        now_s = time.monotonic()
        # An ordinary refusal waits until the safety command's answer has been visible for a while;
        # a command that the hold obeyed is always shown, because it changed something.
        safety_answer_is_old = now_s - self._safety_answered_s > _SAFETY_SHOWN_S
        if safety or safety_answer_is_old or outcome.done:
            self._answer = answer
        if safety:
            self._safety_answered_s = now_s
        return answer

    def _report_late(self, outcome: Outcome) -> None:
        answer = self._note_outcome("late", outcome.command, outcome)
        for listener in self.late_listeners:
            listener(answer)

    def _request(self, by: str, name: str, given: Any, role: Role, who: str) -> dict[str, Any]:
        """The request of a command, for the control port. Raises ValueError: one line that states
        the fault.
        """
        action = COMMANDS.get(name)
        if action is None:
            raise ValueError("no such command")
        # The role at the port is known only after the first contact: it must not refuse a safety
        # command.
        port_role = "tune" if is_safety_command(name) else self.feed.seen.role
        allowed = is_action_allowed(
            WebUser(by, self.settings.role), port_role, action
        ) and role_includes(role, action.role)
        if not allowed:
            raise ValueError(f"{name} refused: needs the role {action.role}")
        why = f"bridge: {by}, {who}" if who else f"bridge: {by}"
        asked = request(action, why, self._make_argument_text(action, name, given))
        asked["on_behalf"] = {"via": "bridge", "name": by, "role": role}
        return asked

    def _make_argument_text(self, action: ActionButton, name: str, given: Any) -> str:
        """The number or text of a command as `request` accepts it. Raises ValueError."""
        if action.asks == "number":
            return _number_text(action, given)
        if not action.asks:
            return ""
        if isinstance(given, bytes):
            given = _decode_payload(given, name)
        text = str(given)
        if is_safety_command(name):
            return _remove_unprintable(text)
        # the port would drop a client that sends too much
        if len(text.encode("utf-8", "replace")) > TEXT_BYTES:
            raise ValueError(f"{name} refused: longer than {TEXT_BYTES} bytes")
        return text


def _number_text(action: ActionButton, given: Any) -> str:
    """A number in the notation of `request`. Raises ValueError for whatever is not exactly one
    finite number.
    """
    # One byte more than allowed is enough to refuse a payload by its length.
    if isinstance(given, bytes):
        given = _decode_payload(given[: TEXT_BYTES + 1], str(action.do))
    if isinstance(given, str):
        if len(given.encode("utf-8", "replace")) > TEXT_BYTES:
            raise ValueError(f"{action.do} refused: longer than {TEXT_BYTES} bytes")
        try:
            given = parse_number(given)
        except ValueError as error:
            raise ValueError(f"{action.label}: enter a number in {action.unit}: {error}") from None
    # Python counts True as a number; a client that sends it means something else.
    if isinstance(given, bool) or not isinstance(given, float | int):
        raise ValueError(f"{action.label}: enter a number in {action.unit}")
    try:
        number = float(given)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ValueError(f"{action.label}: enter a finite number in {action.unit}")
    return repr(number)


def _decode_payload(payload: bytes, name: str) -> str:
    """A payload as text. Raises ValueError for one that is no UTF-8, unless the command makes the
    mirror safe.
    """
    if is_safety_command(name):
        return payload.decode("utf-8", "replace")
    try:
        return payload.decode("utf-8")
    except UnicodeDecodeError:
        raise ValueError(f"{name} refused: the payload is not text in UTF-8") from None


def _remove_unprintable(text: str) -> str:
    """The printable part of a safety command's text: a bad text must not refuse the command."""
    printable = "".join(c if c.isprintable() else "?" for c in text[:TEXT_BYTES])
    return printable.encode("utf-8", "replace")[:TEXT_BYTES].decode("utf-8", "ignore")
