"""Who publishes under a name at an MQTT broker: one bridge, by a claim that all bridges of that
name can see.

The claim is a retained message on `membrane/NAME/owner`. Its owner publishes it again every
`BEAT_S`, and at once when another bridge publishes, so a claim without an owner is recognised by
its silence. A bridge that starts

1. reads the retained claim, and publishes its own, not retained;
2. listens: `SETTLE_S` if there is no other claim, `SILENT_S` if there is one;
3. ends with an error as soon as it receives a live claim that outranks its own; else it is the
   owner.

Two claims are compared by the time since which they are owned; a bridge that is not an owner yet
ranks behind every owner, and equal ones are ordered by their random identifiers. So of two bridges
that start together, one continues; an owner is not displaced by a newcomer; and an owner whose
connection was interrupted gets its name back.
"""

from __future__ import annotations

import asyncio
import json
import math
import os
import re
import secrets
import socket
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, replace

from membrane_ctrl.model import errors

BEAT_S = 2.0
# several times the way through a broker and the start of a process on a busy machine
SETTLE_S = 1.0
SILENT_S = 5.0  # more than two beats
_RETAINED_S = 0.3  # a broker delivers the retained claim right after the subscription
_BETWEEN_ANSWERS_S = 0.2  # a flood of claims is not answered by a flood
_CLAIM_BYTES = 512
_HOST_LENGTH = 64
_INSTANCE = re.compile(r"[0-9a-f]{16}")

Publish = Callable[[bytes, bool], Awaitable[None]]  # payload, retained


@dataclass(frozen=True, slots=True)
class OwnerClaim:
    """The claim of one process to a name."""

    instance: str  # random, of the process
    host: str
    pid: int
    since_s: float | None = None  # UTC since which it owns the name; None: not yet

    @classmethod
    def of_this_process(cls) -> OwnerClaim:
        """A claim of this process, which owns nothing yet."""
        return cls(secrets.token_hex(8), socket.gethostname()[:_HOST_LENGTH], os.getpid())

    def encode(self) -> bytes:
        """The message."""
        return json.dumps(asdict(self)).encode()

    def outranks(self, other: OwnerClaim) -> bool:
        """Whether this claim's process keeps the name."""
        return self._rank() < other._rank()

    def _rank(self) -> tuple[float, str]:
        since_s = math.inf if self.since_s is None else self.since_s
        return since_s, self.instance


def parse_claim(payload: bytes) -> OwnerClaim | None:
    """The claim in a message; None for anything else, because any client can publish there."""
    if len(payload) > _CLAIM_BYTES:
        return None
    try:
        claim = OwnerClaim(**json.loads(payload))
    except (ValueError, TypeError, RecursionError):
        return None
    if not _is_owned_since(claim.since_s):
        return None
    # The dataclass checks no types: JSON may have put anything into its fields.
    if not isinstance(claim.instance, str) or not _INSTANCE.fullmatch(claim.instance):
        return None
    if type(claim.pid) is not int:
        return None
    if not isinstance(claim.host, str) or not claim.host.isprintable():
        return None
    if len(claim.host) > _HOST_LENGTH:
        return None
    return claim


def _is_owned_since(since_s: object) -> bool:
    """Whether this is a time since which a claim may own a name; None is: not yet."""
    if since_s is None:
        return True
    if isinstance(since_s, bool) or not isinstance(since_s, int | float):
        return False
    try:
        return math.isfinite(since_s) and since_s >= 0.0
    except OverflowError:  # an integer that no float holds
        return False


class NameOwnership:
    """This process's claim to a name, over any number of connections to the broker.

    Parameters
    ----------
    claim : OwnerClaim
        Of this process.
    what : str
        The name and the broker, for messages.
    """

    def __init__(self, claim: OwnerClaim, what: str) -> None:
        self.claim = claim
        self._what = what
        self._retained: OwnerClaim | None = None
        self._live: OwnerClaim | None = None
        self._released = False
        self._heard = asyncio.Event()

    def receive(self, payload: bytes, retained: bool) -> None:
        """Note a message of the owner's topic.

        Parameters
        ----------
        payload : bytes
            A claim as JSON; empty if an owner has ended; anything else is ignored.
        retained : bool
            Whether the broker delivered it from its memory: then its owner may be gone. A message
            that is not retained shows an owner that is alive.
        """
        if not payload:  # a former owner has ended
            self._released = True
            self._heard.set()
            return
        claim = parse_claim(payload)
        if claim is None or claim.instance == self.claim.instance:
            return
        if retained:
            self._retained = claim
        elif self._live is None or claim.outranks(self._live):
            self._live = claim
        self._heard.set()

    async def establish(self, publish: Publish) -> None:
        """Become the owner; call it after each connection. Raises DeviceError if another bridge has
        the name.
        """
        # Wait for the retained claim, then publish this one, not retained: a live owner answers it
        # at once with its own.
        await asyncio.sleep(_RETAINED_S)
        await publish(self.claim.encode(), False)
        deadline_s = time.monotonic() + self._listening_s()
        while (left_s := deadline_s - time.monotonic()) > 0.0:
            if self._released:
                # The owner has ended, so there is no need to wait for its silence. Other bridges
                # may also have waited for that: settle with them who follows.
                self._released = False
                deadline_s = min(deadline_s, time.monotonic() + SETTLE_S)
            # A rival that ranks behind must see this claim, so that it ends.
            if await self._rival_heard(min(left_s, SETTLE_S)):
                await publish(self.claim.encode(), False)
                await asyncio.sleep(_BETWEEN_ANSWERS_S)
        # No live claim ranks before this one. A reconnecting owner keeps its earlier time, and so
        # its rank.
        if self.claim.since_s is None:
            self.claim = replace(self.claim, since_s=time.time())
        await publish(self.claim.encode(), True)

    async def keep(self, publish: Publish) -> None:
        """Renew the claim until cancelled. Raises DeviceError if a bridge with an older claim has
        come back.
        """
        while True:
            await self._rival_heard(BEAT_S)
            await publish(self.claim.encode(), True)
            await asyncio.sleep(_BETWEEN_ANSWERS_S)

    def forget_heard(self) -> None:
        """Forget what an earlier connection has delivered."""
        self._retained = self._live = None
        self._released = False

    def _listening_s(self) -> float:
        """How long to listen before this process owns the name."""
        other = self._retained
        owner = self.claim.since_s is not None
        if owner and (other is None or self.claim.outranks(other)):
            return 0.0
        return SETTLE_S if other is None else SILENT_S

    async def _rival_heard(self, timeout_s: float) -> bool:
        """Wait for a live claim of another process; returns whether there was one, which ranks
        behind this one.

        Raises DeviceError if it ranks before this one.
        """
        with suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                await self._heard.wait()
        self._heard.clear()
        rival, self._live = self._live, None
        if rival is None:
            return False
        if not rival.outranks(self.claim):
            return True
        raise errors.DeviceError(
            f"mqtt: {self._what} is in use by another bridge (process {rival.pid} on "
            f"{rival.host}); stop that one, or choose another bridges.name"
        )
