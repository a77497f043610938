"""How often an address may try: a bridge's limit on guesses."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable

# Per address: a person's terminal and a script or two
_BURST, _PER_S = 10.0, 2.0
_ADDRESSES_MOST = 1024  # addresses remembered


class Turns:
    """How often an address may connect: a token bucket each.

    A bucket holds `_BURST` tokens and gets `_PER_S` a second; a connection costs one. The address
    that has been absent longest is forgotten, so that many addresses do not fill the memory.

    Parameters
    ----------
    now : callable
        Monotonic time, s.
    """

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        # tokens and the time at which they were counted; the address seen last is at the end
        self._left: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def take(self, address: str) -> bool:
        """Whether the address may connect now; counts the connection if so."""
        now_s = self._now()
        tokens, counted_s = self._left.pop(address, (_BURST, now_s))
        tokens = min(_BURST, tokens + _PER_S * (now_s - counted_s))
        may_connect = tokens >= 1.0
        if may_connect:
            tokens -= 1.0
        self._left[address] = (tokens, now_s)
        if len(self._left) > _ADDRESSES_MOST:
            self._left.popitem(last=False)
        return may_connect
