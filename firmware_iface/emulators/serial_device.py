"""The device end of a serial line, paced like the real wire, and the pseudo-terminal that it
answers on.
"""

import asyncio
import contextlib
import os
import termios
import tty
from collections.abc import Callable
from pathlib import Path

from firmware_iface.links.serial_port import SerialSettings

Sensor = Callable[[], float]  # a device's measured value
Drive = Callable[[float], None]  # takes an actuator's fraction
Transmit = Callable[[bytes], None]
_LINE_BYTES_MAX = 1024  # of a line that has not ended
_READ_BYTES = 65_536
_SPEED = 4  # index of the input speed in tcgetattr's list; the output speed follows


class SerialDevice:
    """Receives and sends bytes. A device overrides `received`, and `restart` if it can lose
    settings.
    """

    frozen = False  # the measured value does not change

    def __init__(self, settings: SerialSettings) -> None:
        self.settings = settings
        self._transmit: Transmit | None = None
        self._free_s = 0.0  # until then the line is busy with sending
        self._due: set[asyncio.TimerHandle] = set()

    def attach(self, transmit: Transmit) -> None:
        """The wire is plugged in: sent bytes go to `transmit`."""
        self._transmit = transmit

    def detach(self) -> None:
        """The wire is pulled: bytes on their way are lost."""
        self._transmit = None
        self._free_s = 0.0
        for timer in self._due:
            timer.cancel()
        self._due.clear()

    def power_cycle(self) -> None:
        """Off and on again: unsent bytes are lost, settings as after power-up."""
        transmit = self._transmit
        self.detach()
        self._transmit = transmit
        self.restart()

    def restart(self) -> None:
        """Settings as after power-up."""

    def receive(self, data: bytes) -> None:
        """Bytes begin to arrive; the device gets them when the last one is in."""
        self._call_later(
            asyncio.get_running_loop().time() + len(data) * self.settings.char_s, self.arrived, data
        )

    def received(self, data: bytes) -> None:
        """Bytes arrived; the device answers with `send_answer`."""
        raise NotImplementedError

    def arrived(self, data: bytes) -> None:
        """All bytes are in."""
        self.received(data)

    def send_answer(self, answer: bytes, delay_s: float = 0.0) -> None:
        """Send an answer after the bytes being sent.

        Parameters
        ----------
        answer : bytes
            As on the wire. The other end gets it when its last byte would be in.
        delay_s : float
            Time in which the device prepares it; the wire is free meanwhile.
        """
        begin_s = max(asyncio.get_running_loop().time() + delay_s, self._free_s)
        self._free_s = begin_s + len(answer) * self.settings.char_s
        self._call_later(self._free_s, self._transmit_bytes, answer)

    def _transmit_bytes(self, data: bytes) -> None:
        if self._transmit is not None and data:
            self._transmit(data)

    def _call_later(self, when_s: float, call: Callable[[bytes], None], data: bytes) -> None:
        def run() -> None:
            self._due.discard(timer)
            call(data)

        timer = asyncio.get_running_loop().call_at(when_s, run)
        self._due.add(timer)


class LineDevice(SerialDevice):
    """A device that answers lines of text; a device overrides `line`.

    Parameters
    ----------
    baud, data_bits, parity : int, int, str
        Of the line, as in `SerialSettings`.
    """

    end = b"\n"

    def __init__(self, baud: int, data_bits: int = 8, parity: str = "N") -> None:
        super().__init__(SerialSettings(baud, data_bits, parity))
        self._buffer = b""

    def received(self, data: bytes) -> None:
        """Answer every complete line."""
        *lines, self._buffer = (self._buffer + data).split(self.end)
        for line in lines:
            self.line(line.strip().decode("ascii", "replace"))
        self._buffer = self._buffer[-_LINE_BYTES_MAX:]

    def restart(self) -> None:
        """Half a line is forgotten."""
        self._buffer = b""

    def line(self, text: str) -> None:
        """One line arrived."""
        raise NotImplementedError


class PtyWire:
    """An emulated device behind a pseudo-terminal, which is opened like any serial port.

    A program that opens it with another baud rate than the device's gets garbage and is not
    understood, as on a real line. A pseudo-terminal has no character size or parity.

    Parameters
    ----------
    device : SerialDevice
        The device's end of the line.
    path : Path
        Where a link to the pseudo-terminal is made, to another one after every replug.
    """

    def __init__(self, device: SerialDevice, path: Path) -> None:
        self.path = path
        self._device = device
        self._ends: tuple[int, int] | None = None

    def plug(self) -> None:
        """Plug in. Raises OSError, for example when the path is taken."""
        device_end, program_end = os.openpty()
        # the second is kept open, or the first would report a hang-up
        self._ends = (device_end, program_end)
        tty.setraw(program_end)
        line = termios.tcgetattr(program_end)
        line[_SPEED] = line[_SPEED + 1] = _read_baud_rate(self._device)
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
        self._device.receive(self._distort_bytes(data))

    def _transmit(self, data: bytes) -> None:
        if self._ends is not None:
            # without a reader it is lost, as on a line without flow control
            with contextlib.suppress(BlockingIOError):
                os.write(self._ends[0], self._distort_bytes(data))

    def _distort_bytes(self, data: bytes) -> bytes:
        """The bytes as the other end receives them: at another baud rate, garbage."""
        assert self._ends is not None
        same = termios.tcgetattr(self._ends[0])[_SPEED] == _read_baud_rate(self._device)
        if same:
            return data
        return bytes((7 * byte + 0xA5) % 256 for byte in data)


def _read_baud_rate(device: SerialDevice) -> int:
    return int(getattr(termios, f"B{device.settings.baud}"))
