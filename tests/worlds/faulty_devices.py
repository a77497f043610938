"""Emulated serial devices with faults that can be switched on, and a wire in virtual time."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from firmware_iface.emulators import (
    keyence_dl_rs1a,
    modbus_pdu,
    optoncdt1420,
    pressure_gauges,
    pumps,
    rtu_bus,
    serial_device,
)
from firmware_iface.links.serial_port import Receiver, SerialPort
from firmware_iface.roles import LinkDownError

_FEW = 8  # registers that a gateway with a small buffer still passes


@dataclass(slots=True)
class SerialFaults:
    """Faults of the line or the device; each can be switched on and off while it runs."""

    silent: bool = False  # questions are executed but not answered
    deaf: bool = False  # questions do not arrive
    # delay of answers; beyond the asker's time-out the reply is late. Answers keep their order
    delay_s: float = 0.0
    garbage_bytes: int = 0  # so many random bytes instead of each answer
    # so many bits of each answer are flipped. On a line with parity, a byte with an odd number of
    # them is dropped, as the receiver does
    bit_errors: int = 0
    question_bit_errors: int = 0  # so many bits of each question are flipped
    cut_bytes: int = 0  # so many bytes are missing at the end of each answer
    frozen: bool = False  # the measured value does not change
    # the program's adapter returns each question as it sends it
    echo: bool = False


class SerialDevice(serial_device.SerialDevice):
    """A device whose answers and questions are corrupted on their way, according to `faults`.

    `draw_faults`, when set, is called for every question, and for every answer: random faults.
    """

    def __init__(self, *arguments: Any, seed: int = 0, **keywords: Any) -> None:
        super().__init__(*arguments, **keywords)
        self.faults = SerialFaults()
        self.draw_faults: Callable[[], SerialFaults] | None = None
        self.random = random.Random(seed)

    @property
    def frozen(self) -> bool:  # type: ignore[override]
        return self.faults.frozen

    def receive(self, data: bytes) -> None:
        if self.faults.echo:
            self._call_later(
                asyncio.get_running_loop().time() + len(data) * self.settings.char_s,
                self._transmit_bytes,
                data,
            )
        super().receive(data)

    def arrived(self, data: bytes) -> None:
        faults = self._drawn()
        if not faults.deaf:
            super().arrived(self._hit(data, faults.question_bit_errors))

    def send_answer(self, answer: bytes, delay_s: float = 0.0) -> None:
        faults = self._drawn()
        if not faults.silent:
            super().send_answer(self._spoilt(answer, faults), faults.delay_s)

    def _spoilt(self, answer: bytes, faults: SerialFaults) -> bytes:
        if faults.garbage_bytes:
            return self.random.randbytes(faults.garbage_bytes)
        return self._hit(answer[: max(0, len(answer) - faults.cut_bytes)], faults.bit_errors)

    def _hit(self, data: bytes, bit_errors: int) -> bytes:
        """The bytes with flipped bits, as the receiver gets them."""
        if not bit_errors:
            return data
        spoilt, hits = bytearray(data), bytearray(len(data))
        for bit in self.random.sample(range(8 * len(data)), min(bit_errors, 8 * len(data))):
            spoilt[bit // 8] ^= 1 << bit % 8
            hits[bit // 8] ^= 1
        if self.settings.parity == "N":
            return bytes(spoilt)
        return bytes(byte for byte, odd in zip(spoilt, hits, strict=True) if not odd)

    def _drawn(self) -> SerialFaults:
        return self.faults if self.draw_faults is None else self.draw_faults()


class KeyenceDlRs1aEmulator(SerialDevice, keyence_dl_rs1a.KeyenceDlRs1aEmulator):
    pass


class Optoncdt1420Emulator(SerialDevice, optoncdt1420.Optoncdt1420Emulator):
    """With noise of a single value; one byte in `lose_bytes_every` is lost from the stream (0:
    none).
    """

    lose_bytes_every = 0

    def __init__(self, *arguments: Any, noise_um: float = 0.0, **keywords: Any) -> None:
        super().__init__(*arguments, **keywords)
        self._noise_um = noise_um

    def stream(self, data: bytes) -> None:
        if self.lose_bytes_every:
            data = bytes(byte for byte in data if self.random.randrange(self.lose_bytes_every))
        super().stream(data)

    def digital(self, displacement_um: float) -> int:
        return super().digital(displacement_um + self.random.gauss(0.0, self._noise_um))


class Mks937bEmulator(SerialDevice, pressure_gauges.Mks937bEmulator):
    pass


class VaisalaPtb330Emulator(SerialDevice, pressure_gauges.VaisalaPtb330Emulator):
    pass


class VentusEmulator(SerialDevice, pumps.VentusEmulator):
    pass


class ProparDevice(SerialDevice, pumps.ProparDevice):
    pass


class RtuBusEmulator(SerialDevice, rtu_bus.RtuBusEmulator):
    """A bus whose answers carry the next unit id, the next function code, or an exception (0:
    off). `short_replies`: answers to reads of many registers lack the last.
    """

    wrong_unit = wrong_function = short_replies = False
    exception_code = 0

    def answer(self, unit: int, pdu: bytes) -> bytes:
        if self.exception_code:
            return bytes([unit]) + modbus_pdu.exception_pdu(pdu, self.exception_code)
        if not (body := super().answer(unit, pdu)):
            return b""
        if self.short_replies and pdu[0] == modbus_pdu.READ_HOLDING and body[2] > 2 * _FEW:
            body = body[:2] + bytes([body[2] - 2]) + body[3:-2]
        return bytes([body[0] + self.wrong_unit, body[1] + self.wrong_function]) + body[2:]


class MemoryWire(SerialPort):
    """A `SerialPort` with the emulated device at its other end, for runs in virtual time."""

    def __init__(self, device: SerialDevice, name: str = "memory") -> None:
        super().__init__("/memory", device.settings)
        self._port = name
        self.plugged = True
        self._device = device

    @property
    def is_open(self) -> bool:
        """Whether bytes can flow."""
        return self._receiver is not None

    @property
    def retry_in_s(self) -> float:
        """No wait between attempts."""
        return 0.0

    def open(self, receiver: Receiver) -> None:
        """Open again. Raises LinkDownError when it is not plugged in."""
        if not self.plugged:
            raise LinkDownError(f"{self.name}: there is no such port")
        self._receiver = receiver
        self._device.attach(receiver.received)

    def write(self, data: bytes) -> None:
        """Hand over bytes. Raises LinkDownError."""
        if self._receiver is None:
            raise LinkDownError(f"{self.name}: not open")
        self._device.receive(data)

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
