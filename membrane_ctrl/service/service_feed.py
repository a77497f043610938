"""Follows a hold behind another service, as `HoldFeed` follows one on this machine."""

from __future__ import annotations

import math
import time
from dataclasses import replace

from membrane_ctrl.control_port.api_models import StateAnswer
from membrane_ctrl.control_port.ctl import Where
from membrane_ctrl.control_port.safety_commands import is_safety_command
from membrane_ctrl.control_port.service_client import ServiceAddress, ServiceClient
from membrane_ctrl.controller.command import Role
from membrane_ctrl.model import terminal
from membrane_ctrl.service.feed import HoldFeed
from membrane_ctrl.service.hold_command import NO_LIMITS
from membrane_ctrl.service.hold_seen import HoldSeen, Message
from membrane_ctrl.service.published_signals import Value
from membrane_ctrl.service.send_limits import SendLimits

_PERIOD_S = 1.0
_ANSWER_S = 5.0
_EXPIRES_LEAST_S = 0.001


class ServiceFeed(HoldFeed):
    """Asks the other service once a second.

    The token's role there limits what its viewers here may do; commands are recorded there with
    the token's name, and with the viewer's in their reason.
    """

    def __init__(self, where: Where, address: ServiceAddress, with_signals: bool) -> None:
        super().__init__(where)
        self._with_signals = with_signals
        self._values: dict[str, Value] = {}
        self._service = ServiceClient(address, _ANSWER_S)
        self._role: Role | None = None

    def signal_values(self) -> dict[str, Value]:
        """The values of the published signals; the other service has those of the figure."""
        values = super().signal_values()
        if not self.seen.silent:
            values |= {name: value for name, value in self._values.items() if name in values}
        return values

    def ask_hold(self, request: Message, limits: SendLimits = NO_LIMITS) -> Message:
        """Send a request through the other service; returns the hold's answer.

        Parameters
        ----------
        request : Message
            A request of the control port; `on_behalf` names the viewer, for the reason in the
            records.
        limits : SendLimits
            Judged here, and passed on as a time limit for the other service. Safety commands have
            none.

        Raises
        ------
        DeviceError
            There is no answer.
        InputError
            The other service refuses it: the token's role is too low, or the request is wrong.
        """
        viewer = request.get("on_behalf", {}).get("name", "")
        request = request | {"viewer": viewer}
        if not is_safety_command(str(request["do"])):
            if reason := limits.find_refusal():
                return {"ok": False, "refused": reason}
            left_s = limits.deadline_s - time.monotonic()
            if math.isfinite(left_s):
                request = request | {"expires_in_s": max(left_s, _EXPIRES_LEAST_S)}
        return self._service.send_command(request)

    def follow_once(self) -> None:
        """Ask for the state, and keep it. Raises DeviceError or InputError."""
        if self._role is None:
            self._role = self._service.read_user().role
        state = self._service.read_state()
        seen = self.seen if state.run == self.seen.name else HoldSeen(state.run)
        problem = "" if state.in_contact else state.reason
        self.seen = replace(
            seen, role=self._role, status=state.status, seen_s=time.monotonic(), problem=problem
        )
        self._take_row(state)
        if not self._with_signals:
            events = tuple(terminal.one_line(line) for line in self._service.read_events())
            self.seen = replace(self.seen, events=events)
        elif state.in_contact:
            self._values = self._service.read_signals()

    def _follow(self) -> None:
        while not self._ending.is_set():
            self._try_to_follow(self.follow_once)
            self._ending.wait(_PERIOD_S)

    def _take_row(self, state: StateAnswer) -> None:
        if state.in_contact:
            self._take_ticks(state.status.get("row") or {}, None)


def make_feed(where: Where, with_signals: bool = False) -> HoldFeed:
    """Return what follows a hold, wherever it is.

    Parameters
    ----------
    where : Where
        Of the hold: on this machine, or behind a service.
    with_signals : bool
        Of a hold behind a service, get the published signals, for bridges; else the events, for the
        page.
    """
    if where.service is None:
        return HoldFeed(where)
    return ServiceFeed(where, where.service, with_signals)
