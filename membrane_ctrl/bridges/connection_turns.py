"""How often an address may try: a bridge's limit on guesses."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable

# Per address: a person's terminal and a script or two
_BURST, _PER_S = 10.0, 2.0
_ADDRESSES_MOST = 1024  # addresses remembered


class Turns:
    """How often an address may connect: a token bucket each; forgets the address absent longest."""

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._left: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def take(self, address: str) -> bool:
        """Whether the address may connect now; counts the connection if so."""
        now_s = self._now()
        left, since_s = self._left.pop(address, (_BURST, now_s))
        left = min(_BURST, left + _PER_S * (now_s - since_s))
        may = left >= 1.0
        self._left[address] = (left - may, now_s)
        if len(self._left) > _ADDRESSES_MOST:
            self._left.popitem(last=False)
        return may
