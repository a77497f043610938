"""The device end of a serial line: paced like the real wire, with faults that can be switched on.

What a device says is kept apart from how its bytes travel: a `PtyWire` carries them through the kernel, a
`MemoryWire` through nothing, in virtual time.
"""

import asyncio
import contextlib
import os
import random
import termios
import tty
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from firmware_iface.links.serial_port import Receiver, SerialSettings
from firmware_iface.roles import LinkDownError


@dataclass(slots=True)
class SerialFaults:
    """What is wrong with the line or the device; each can be switched on and off while it runs."""

    silent: bool = False  # questions are carried out and not answered
    deaf: bool = False  # questions do not arrive
    # answers come this much later; longer than the asker waits, it is a late reply. Answers keep their order
    delay_s: float = 0.0
    garbage_bytes: int = 0  # so many random bytes in place of each answer
    # so many bits of each answer are turned over. On a line with parity, a byte with an odd number of them is
    # dropped, as the receiver does
    bit_errors: int = 0
    question_bit_errors: int = 0  # so many bits of each question are turned over
    cut_bytes: int = 0  # so many bytes are missing at the end of each answer
    frozen: bool = False  # the measured value stays what it was


class SerialDevice:
    """Hears bytes, says bytes. A device overrides `received`, and `restart` if it can lose settings.

    Parameters
    ----------
    settings : SerialSettings
        Of the line; its pace.
    seed : int
        For garbage and bit errors.

    Attributes
    ----------
    faults : SerialFaults
        Switches.
    draw_faults : callable or None
        When set, called for every question, and for every answer: random faults.
    """

    def __init__(self, settings: SerialSettings, seed: int = 0) -> None:
        self.settings = settings
        self.faults = SerialFaults()
        self.draw_faults: Callable[[], SerialFaults] | None = None
        self._random = random.Random(seed)
        self._transmit: Callable[[bytes], None] | None = None
        self._free_s = 0.0  # until then the line is taken by what is being said
        self._due: set[asyncio.TimerHandle] = set()

    def attach(self, transmit: Callable[[bytes], None]) -> None:
        """The wire is plugged in: what is said goes to `transmit`."""
        self._transmit = transmit

    def detach(self) -> None:
        """The wire is pulled: whatever was on its way is lost."""
        self._transmit = None
        self._free_s = 0.0
        for timer in self._due:
            timer.cancel()
        self._due.clear()

    def power_cycle(self) -> None:
        """Off and on again: nothing more of what was to be said, settings as after power-up."""
        transmit = self._transmit
        self.detach()
        self._transmit = transmit
        self.restart()

    def restart(self) -> None:
        """Settings as after power-up."""

    def hear(self, data: bytes) -> None:
        """Bytes begin to arrive; the device has them when the last one is in."""
        self._later(asyncio.get_running_loop().time() + len(data) * self.settings.char_s, self._arrived, data)

    def _arrived(self, data: bytes) -> None:
        faults = self._drawn()
        if not faults.deaf:
            self.received(self._hit(data, faults.question_bit_errors))

    def received(self, data: bytes) -> None:
        """Bytes arrived: for the device to answer with `say`."""
        raise NotImplementedError

    def say(self, answer: bytes) -> None:
        """Send an answer, as the faults let it."""
        faults = self._drawn()
        if faults.silent:
            return
        data = self._spoilt(answer, faults)
        begin_s = max(asyncio.get_running_loop().time() + faults.delay_s, self._free_s)
        self._free_s = begin_s + len(data) * self.settings.char_s
        self._later(self._free_s, self._sent, data)

    def _sent(self, data: bytes) -> None:
        if self._transmit is not None and data:
            self._transmit(data)

    def _spoilt(self, answer: bytes, faults: SerialFaults) -> bytes:
        if faults.garbage_bytes:
            return self._random.randbytes(faults.garbage_bytes)
        return self._hit(answer[: max(0, len(answer) - faults.cut_bytes)], faults.bit_errors)

    def _hit(self, data: bytes, bit_errors: int) -> bytes:
        """With so many bits turned over, as the receiver at the other end gets it."""
        if not bit_errors:
            return data
        spoilt, hits = bytearray(data), bytearray(len(data))
        for bit in self._random.sample(range(8 * len(data)), min(bit_errors, 8 * len(data))):
            spoilt[bit // 8] ^= 1 << bit % 8
            hits[bit // 8] ^= 1
        if self.settings.parity == "N":
            return bytes(spoilt)
        return bytes(byte for byte, odd in zip(spoilt, hits, strict=True) if not odd)

    def _drawn(self) -> SerialFaults:
        return self.faults if self.draw_faults is None else self.draw_faults()

    def _later(self, when_s: float, call: Callable[[bytes], None], data: bytes) -> None:
        def run() -> None:
            self._due.discard(timer)
            call(data)

        timer = asyncio.get_running_loop().call_at(when_s, run)
        self._due.add(timer)


class LineDevice(SerialDevice):
    """A device that is asked in lines of text; one overrides `line`."""

    end = b"\n"

    def __init__(self, settings: SerialSettings, seed: int = 0) -> None:
        super().__init__(settings, seed)
        self._heard = b""

    def received(self, data: bytes) -> None:
        """Answer every line that is complete."""
        *lines, self._heard = (self._heard + data).split(self.end)
        for line in lines:
            self.line(line.strip().decode("ascii", "replace"))

    def restart(self) -> None:
        """Half a line is forgotten."""
        self._heard = b""

    def line(self, text: str) -> None:
        """One line arrived."""
        raise NotImplementedError


# What lies between a program and an emulated serial device: a pseudo-terminal, or nothing but time.

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
