"""What drivers with a link of their own have in common."""

from collections.abc import Awaitable, Callable
from typing import Protocol

from firmware_iface.links.exchange import LineFence, LineLink
from firmware_iface.links.serial_port import SerialPort
from firmware_iface.roles import DeviceIdentity, LinkError


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


class LineDriver(LinkedDevice):
    """Base of a driver whose device is asked in lines of text on a serial port of its own."""

    manual = ""

    def __init__(self, port: SerialPort, end: str, timeout_s: float, fence: LineFence) -> None:
        super().__init__(port)
        self._link = LineLink(port, end, timeout_s, fence)

    async def _opened(self, begin: Callable[[], Awaitable[DeviceIdentity]], greeting: str = "") -> DeviceIdentity:
        """Open the port and begin; the port is closed again when that fails."""
        self._link.connect(greeting)
        try:
            return await begin()
        except LinkError:
            await self._link.close()
            raise

    async def close(self) -> None:
        """Close the port. Never raises."""
        await self._link.close()

    @property
    def _shown(self) -> str:
        """The settings in words."""
        raise NotImplementedError

    def describe(self) -> dict[str, str]:
        """For people: port, settings, manual."""
        port = f"{self._link.name}, {self._link.port.settings}"
        return {"port": port, "settings": self._shown, "manual": self.manual}


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
