"""Emulator of the laser sensor optoNCDT 1420 on its serial line."""

import asyncio
import math

from firmware_iface.emulators.serial_device import LineDevice, Sensor, Transmit

NO_PEAK = 262_076
_PERIOD_S = 0.0025  # between two portions of the stream, as an adapter hands them over
# the sensor's settings after power-up, unless others were stored
_DEFAULTS = {
    "OUTPUT": "ANALOG",
    "MEASRATE": "2",
    "LASERPOW": "FULL",
    "OUTREDUCEDEVICE": "NONE",
    "OUTHOLD": "NONE",
    "OUTADD_RS422": "NONE",
}
_CHOICES = {
    "OUTPUT": ("NONE", "RS422", "ANALOG"),
    "MEASRATE": ("0.25", "0.5", "1", "2", "4"),
    "LASERPOW": ("FULL", "OFF"),
    "OUTREDUCEDEVICE": ("NONE", "RS422"),
    "OUTHOLD": ("NONE", "INFINITE"),
    "OUTADD_RS422": ("NONE", "COUNTER"),
}


class Optoncdt1420Emulator(LineDevice):
    """Measures the mirror from behind, with displacement 0 in the middle of its range.

    Parameters
    ----------
    displacement_um : callable
        Of the mirror's centre; NaN: no target.
    range_mm : int
        Measuring range.
    direction : int
        1 or -1: sign of the distance over the displacement.
    baud : int
        Of the line.
    name : str
        Of the sensor; empty: `ILD1420-` with the range.
    """

    def __init__(
        self,
        displacement_um: Sensor,
        range_mm: int = 50,
        direction: int = -1,
        baud: int = 921_600,
        name: str = "",
    ) -> None:
        super().__init__(baud)
        self._displacement_um = displacement_um
        self._range_mm = range_mm
        self._direction = direction
        self._name = name or f"ILD1420-{range_mm}"
        self._register = dict(_DEFAULTS)
        self._counter = 0
        self._raw = NO_PEAK
        self._stream: asyncio.TimerHandle | None = None
        self._streamed_s = 0.0
        self._samples_due = 0.0

    def restart(self) -> None:
        """Settings that were not stored are lost, so it does not stream."""
        super().restart()
        self._stop_stream()
        self._register = dict(_DEFAULTS)
        self._counter = 0

    def detach(self) -> None:
        """The wire is pulled."""
        self._stop_stream()
        super().detach()

    def attach(self, transmit: Transmit) -> None:
        """The wire is plugged in; a stream continues."""
        super().attach(transmit)
        if self._register["OUTPUT"] == "RS422":
            self._start_stream()

    def line(self, text: str) -> None:
        """One command."""
        name, _, value = text.partition(" ")
        if name == "GETINFO":
            answer = self._format_identity()
        elif name not in self._register:
            answer = "E210 Unknown command\r\n"
        elif not value:
            answer = f"{name} {self._register[name]}\r\n"
        elif value not in _CHOICES[name]:
            answer = "E236 Value is out of range or the format is invalid\r\n"
        else:
            self._register[name] = value
            self._stop_stream()
            answer = "\r\n"
        self.send_answer(answer.encode("ascii") + b"->")
        if self._register["OUTPUT"] == "RS422" and self._stream is None:
            self._start_stream()

    def _format_identity(self) -> str:
        return (
            f"Name:             {self._name}\r\nSerial:           15030002\r\nOption:        "
            "   000\r\n"
            "Article:          4120212\r\nCable head:       Wire\r\nMeasuring range:  "
            f"{self._range_mm:.2f}mm\r\n"
            "Version:          001.010\r\nHardware-rev:     00\r\nBoot-version:     001.000\r\n"
        )

    def _start_stream(self) -> None:
        loop = asyncio.get_running_loop()
        self._streamed_s = loop.time()
        self._stream = loop.call_later(_PERIOD_S, self._send_portion)

    def _stop_stream(self) -> None:
        if self._stream is not None:
            self._stream.cancel()
            self._stream = None

    def _send_portion(self) -> None:
        """Send the measurements since the last portion."""
        loop = asyncio.get_running_loop()
        self._samples_due += (
            (loop.time() - self._streamed_s) * 1000 * float(self._register["MEASRATE"])
        )
        self._streamed_s = loop.time()
        count, self._samples_due = int(self._samples_due), self._samples_due % 1
        displacement_um = self._displacement_um() if count else math.nan
        if data := b"".join(self._encode_measurement(displacement_um) for _ in range(count)):
            self.stream(data)
        self._stream = loop.call_later(_PERIOD_S, self._send_portion)

    def stream(self, data: bytes) -> None:
        """Send measurements."""
        self.send_answer(data)

    def digital(self, displacement_um: float) -> int:
        """Page 65, without mastering: x = (d / range + 0.01) 65520 / 1.02;
        page 66 without a value.
        """
        if math.isnan(displacement_um):
            return NO_PEAK
        distance_mm = self._range_mm / 2 + self._direction * displacement_um / 1000
        digital = round((distance_mm / self._range_mm + 0.01) * 65_520 / 1.02)
        if digital < 0:
            return NO_PEAK + 1  # peak before the range
        return digital if digital <= 65_520 else NO_PEAK + 2  # peak behind it

    def _encode_measurement(self, displacement_um: float) -> bytes:
        if not self.frozen:
            self._raw = self.digital(displacement_um)
            self._counter = (self._counter + 1) % 2**18
        data = encode_three_bytes(self._raw, first=True)
        if self._register["OUTADD_RS422"] == "COUNTER":
            data += encode_three_bytes(self._counter, first=False)
        return data


def encode_three_bytes(value: int, first: bool) -> bytes:
    """Encode a value as low, middle and high byte with their marks (manual, page 67).

    Parameters
    ----------
    value : int
        18 bits.
    first : bool
        Whether it is the first value of a measurement.
    """
    low, middle, high = value & 0x3F, value >> 6 & 0x3F, value >> 12 & 0x3F
    return bytes([low, 0x40 | middle, (0x80 if first else 0xC0) | high])
