"""The device end of a serial line: paced like the real wire, with faults that can be switched on.

What a device says is kept apart from how its bytes travel: a `PtyWire` carries them through the kernel, a
`MemoryWire` through nothing, in virtual time.
"""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable
from dataclasses import dataclass

from firmware_iface.links.serial_port import SerialSettings


@dataclass(slots=True)
class SerialFaults:
    """What is wrong with the line or the device; each can be switched on and off while it runs.

    Attributes
    ----------
    silent : bool
        Questions are carried out and not answered.
    deaf : bool
        Questions do not arrive.
    delay_s : float
        Answers come this much later; longer than the asker waits, it is a late reply. Answers keep their order.
    garbage_bytes : int
        So many random bytes in place of each answer.
    bit_errors : int
        So many bits of each answer are turned over. On a line with parity, a byte with an odd number of them is
        dropped, as the receiver does.
    question_bit_errors : int
        So many bits of each question are turned over.
    cut_bytes : int
        So many bytes are missing at the end of each answer.
    frozen : bool
        The measured value stays what it was.
    """

    silent: bool = False
    deaf: bool = False
    delay_s: float = 0.0
    garbage_bytes: int = 0
    bit_errors: int = 0
    question_bit_errors: int = 0
    cut_bytes: int = 0
    frozen: bool = False


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
