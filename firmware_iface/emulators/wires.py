"""What lies between a program and an emulated serial device: a pseudo-terminal, or nothing but time."""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import termios
import tty
from pathlib import Path

from firmware_iface.emulators.serial_device import SerialDevice
from firmware_iface.links.serial_port import Receiver, SerialSettings
from firmware_iface.roles import LinkDownError

_READ_BYTES = 65_536
_SPEED = 4  # place of the input speed in what tcgetattr gives; the output speed follows


class PtyWire:
    """An emulated device behind a pseudo-terminal, to be opened at `path` like any serial port.

    A program that opens it with another baud rate than the device's gets garbage and is not understood, as on a real
    line. Character size and parity are no properties of a pseudo-terminal.

    Parameters
    ----------
    device : SerialDevice
        Called from the event loop's thread only.
    path : Path
        Made as a link to the pseudo-terminal; another one after every replug.
    """

    def __init__(self, device: SerialDevice, path: Path) -> None:
        self.path = path
        self._device = device
        self._random = random.Random(0)
        self._ends: tuple[int, int] | None = None

    def plug(self) -> None:
        """Plug in. Raises OSError, for example when the path is taken."""
        device_end, program_end = os.openpty()
        self._ends = device_end, program_end  # the second is held open: without one, the first reports a hang-up
        tty.setraw(program_end)
        line = termios.tcgetattr(program_end)
        line[_SPEED] = line[_SPEED + 1] = _speed(self._device)
        termios.tcsetattr(program_end, termios.TCSANOW, line)
        os.set_blocking(device_end, False)
        self.path.symlink_to(os.ttyname(program_end))
        self._device.attach(self._transmit)
        asyncio.get_running_loop().add_reader(device_end, self._readable)

    def unplug(self) -> None:
        """Pull the plug: the path is gone and programs that have it open see a hang-up."""
        if self._ends is None:
            return
        asyncio.get_running_loop().remove_reader(self._ends[0])
        self._device.detach()
        self.path.unlink(missing_ok=True)
        for end in self._ends:
            os.close(end)
        self._ends = None

    def _readable(self) -> None:
        if self._ends is None:
            return
        data = os.read(self._ends[0], _READ_BYTES)
        self._device.hear(data if self._same_baud() else self._random.randbytes(len(data)))

    def _transmit(self, data: bytes) -> None:
        if self._ends is not None:
            with contextlib.suppress(BlockingIOError):  # nobody reads: lost, as on a line without flow control
                os.write(self._ends[0], data if self._same_baud() else self._random.randbytes(len(data)))

    def _same_baud(self) -> bool:
        assert self._ends is not None
        return bool(termios.tcgetattr(self._ends[0])[_SPEED] == _speed(self._device))


def _speed(device: SerialDevice) -> int:
    return int(getattr(termios, f"B{device.settings.baud}"))


class MemoryWire:
    """A `BytePort` with the emulated device at its other end, for runs in virtual time."""

    def __init__(self, device: SerialDevice, name: str = "memory") -> None:
        self.name = name
        self.plugged = True
        self._device = device
        self._receiver: Receiver | None = None
        self._opened = 0

    @property
    def settings(self) -> SerialSettings:
        """Of the line."""
        return self._device.settings

    @property
    def is_open(self) -> bool:
        """Whether bytes can flow."""
        return self._receiver is not None

    @property
    def reconnects(self) -> int:
        """Times it was opened after the first."""
        return max(0, self._opened - 1)

    @property
    def retry_in_s(self) -> float:
        """It may be tried at any time."""
        return 0.0

    def open(self, receiver: Receiver) -> None:
        """Open anew. Raises LinkDownError when it is not plugged in."""
        if not self.plugged:
            raise LinkDownError(f"{self.name}: there is no such port")
        self._receiver = receiver
        self._opened += 1
        self._device.attach(receiver.received)

    def write(self, data: bytes) -> None:
        """Hand over bytes. Raises LinkDownError."""
        if self._receiver is None:
            raise LinkDownError(f"{self.name}: not open")
        self._device.hear(data)

    def unplug(self) -> None:
        """Pull the plug."""
        self.plugged = False
        receiver = self._receiver
        self.close()
        if receiver is not None:
            receiver.lost(LinkDownError(f"{self.name}: the port is gone"))

    def succeeded(self) -> None:
        """Nothing to do: there is no back-off."""

    def close(self) -> None:
        """Close."""
        self._receiver = None
        self._device.detach()
