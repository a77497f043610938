"""Follows a hold behind another service, as `HoldFeed` follows one on this machine."""

from __future__ import annotations

import time
from dataclasses import replace

from membrane_ctrl.control_port.api_models import StateAnswer
from membrane_ctrl.control_port.ctl import Where
from membrane_ctrl.control_port.service_client import ServiceAddress, ServiceClient
from membrane_ctrl.controller.commands import Role
from membrane_ctrl.service.feed import HoldFeed, HoldSeen, Message

_PERIOD_S = 1.0
_ANSWER_S = 5.0


class ServiceFeed(HoldFeed):
    """Asks the other service once a second.

    The token's role there limits what its viewers here may do; commands are recorded there with
    the token's name, and with the viewer's in their reason.
    """

    def __init__(self, where: Where, address: ServiceAddress) -> None:
        super().__init__(where)
        self._service = ServiceClient(address, _ANSWER_S)
        self._role: Role | None = None

    def ask_hold(self, request: Message) -> Message:
        """Send a request; returns the hold's answer. Raises DeviceError without an answer,
        InputError if the other service refuses it.
        """
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

    def _follow(self) -> None:
        while not self._ending.is_set():
            self._try_to_follow(self.follow_once)
            self._ending.wait(_PERIOD_S)

    def _take_row(self, state: StateAnswer) -> None:
        if state.in_contact:
            self._take_ticks(state.status.get("row") or {}, None)


def make_feed(where: Where) -> HoldFeed:
    """Return what follows a hold, wherever it is."""
    return HoldFeed(where) if where.service is None else ServiceFeed(where, where.service)
