"""What every driver with a link of its own says of it."""

from typing import Protocol


class Reconnecting(Protocol):
    """A link or a port: it connects again after a loss, with back-off, and counts."""

    @property
    def reconnects(self) -> int:
        """Times it was opened after the first."""

    @property
    def retry_in_s(self) -> float:
        """Time until it will try to open."""


class LinkedDevice:
    """Base of a driver that talks through one link."""

    def __init__(self, link: Reconnecting) -> None:
        self._reconnecting = link

    @property
    def reconnects(self) -> int:
        """Times the link was opened after the first."""
        return self._reconnecting.reconnects

    @property
    def retry_in_s(self) -> float:
        """Time until `open` will try."""
        return self._reconnecting.retry_in_s


# Whether a reading can be believed that carries no checksum: it has to be near one of the two before it.


class StepGate:
    """Passes a value within `step` of either of the last two, passed or not.

    A hit reading is alone and is stopped; the good one after it still has the good one before. A true step is stopped
    once and passes with its second reading. The first value of all has nothing to confirm it and is stopped.
    """

    def __init__(self, step: float) -> None:
        self._step = step
        self._before: tuple[float, ...] = ()

    def passes(self, value: float) -> bool:
        """Whether to believe it; it is remembered either way."""
        near = any(abs(value - before) <= self._step for before in self._before)
        self._before = (value, *self._before[:1])
        return near
