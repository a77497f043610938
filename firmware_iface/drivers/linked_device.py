"""What every driver with a link of its own says of it."""

from __future__ import annotations

from typing import Protocol


class Reconnecting(Protocol):
    """A link or a port: it connects again after a loss, with back-off, and counts."""

    @property
    def reconnects(self) -> int:
        """Times it was opened after the first."""
        ...

    @property
    def retry_in_s(self) -> float:
        """Time until it will try to open."""
        ...


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
