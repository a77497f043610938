"""Micro-Epsilon optoNCDT 1420 laser triangulation sensor on RS-422.

Manual: optoNCDT 1420 instruction manual; commands in its appendix A 3 (pages 93-110), digital
values and error codes in 7.5.2 (pages 65-67). A command ends in LF, its answer in `->` (line ends
after it are accepted), an error is `Exxx` before that. The answer may repeat the command and write
a rate as `4`, `4.0` or `4 kHz`.

The sensor streams; a reading is the mean of the middle half of everything since the last one (at 4
kHz and 50 Hz: 40 of 80 values). A corrupted byte, which the protocol cannot detect, is one outlier
among many and is dropped; and unlike the median, the mean resolves less than a digital step (0.8 µm
at 50 mm range).

In the stream (pages 65-67) a value is 18 bits in three bytes of six, marked in their two highest
bits: low `00`, middle `01`, high `10` for the first value of a measurement and `11` for further
ones. Here a measurement is distance and measurement counter (`OUTADD_RS422 COUNTER`), six bytes.
There is no checksum, and lost bytes can join two measurements to a false one: a measurement is
trusted only when its counter is the last one plus one.
"""

import asyncio
import contextlib
import math
import re

import numpy as np
from numpy.typing import NDArray

from firmware_iface import roles, settings
from firmware_iface.drivers import step_gate
from firmware_iface.links import serial_port

_IN_RANGE = (643, 64_877)  # page 65: below and above are reserves, measured but not specified
_PROMPT = b"->"
_ERROR = re.compile(r"E(\d{3})([^\r\n]*)")
_RATE = re.compile(r"(\d+(?:\.\d*)?)(?: ?kHz)?")
_MIDDLE_MIN = 8  # the median for fewer values
_BUFFER_BYTES_MAX = 65_536  # of the answer to a command, and of a stream that stops before it
_BATCHES_MAX = 1024  # without a caller; old ones are dropped first
_SILENT_MAX = 3  # readings without a single value: the sensor restarted or lost its power
_BYTES = 6  # a measurement
_COUNTER_MODULUS = 2**18
_RAW_MAX = 65_520  # above it an error code
_MARKS = (0, 1, 2, 0, 1, 3)


class StreamParser:
    """Bytes in any portions to measurements.

    It counts `bytes_lost`, which belonged to no measurement, and `untrusted` measurements, whose
    counter did not follow the one before.
    """

    def __init__(self) -> None:
        self.bytes_lost = 0
        self.untrusted = 0
        self._rest = b""
        self._counter = -1

    def feed(self, data: bytes) -> NDArray[np.int64]:
        """Digital values or error codes (n,) of the trusted measurements that are complete with
        these bytes.
        """
        # A frame begins where the two upper bits of six successive bytes have the marks of a frame.
        # All places are compared at once: at 4 kHz there are 24,000 bytes a second.
        stream = np.frombuffer(self._rest + data, np.uint8)
        marks = stream >> 6
        candidates = np.arange(max(0, len(stream) - _BYTES + 1))
        is_start = np.ones(len(candidates), bool)
        for offset, mark in enumerate(_MARKS):
            is_start &= marks[offset : offset + len(candidates)] == mark
        starts = candidates[is_start]
        # Keep the bytes that may begin the next frame; all others outside of frames are lost.
        if len(starts):
            used = int(starts[-1]) + _BYTES
        else:
            used = len(candidates)
        self.bytes_lost += used - _BYTES * len(starts)
        self._rest = stream[used:].tobytes()
        if not len(starts):
            return np.empty(0, np.int64)
        # Three bytes of six bits make a number, the lowest first: the value, then the counter
        bits = (stream & 0x3F).astype(np.int64)
        raw = bits[starts] | bits[starts + 1] << 6 | bits[starts + 2] << 12
        counters = bits[starts + 3] | bits[starts + 4] << 6 | bits[starts + 5] << 12
        # A value is trusted if its counter is the next one
        before = np.concatenate(([self._counter], counters[:-1]))
        trusted = counters == (before + 1) % _COUNTER_MODULUS
        self._counter = int(counters[-1])
        self.untrusted += int(np.count_nonzero(~trusted))
        values: NDArray[np.int64] = raw[trusted]
        return values


def distance_mm(raw: float, range_mm: float) -> float:
    """Return the distance from the start of the measuring range: (1.02 x / 65520 - 0.01) range
    (manual, page 65, without mastering).

    Parameters
    ----------
    raw : float
        Digital value x.
    range_mm : float
        Measuring range of the sensor.
    """
    return (1.02 * raw / _RAW_MAX - 0.01) * range_mm


class Optoncdt1420:
    """A `DisplacementSensor`: displacement = direction * (distance - zero).

    The sensor is behind the mirror: when the bowl deepens the vertex comes nearer, so the default
    direction is -1. Counter and time are the driver's: trusted values so far, time of arrival. A
    sensor that repeats a value repeats its counter too, so the value is not new.

    Parameters
    ----------
    config : Optoncdt1420Config
        Port, rate, range, zero and direction.
    port : SerialPort or None
        Replaces the configured one, for tests.
    """

    def __init__(
        self, config: settings.Optoncdt1420Config, port: serial_port.SerialPort | None = None
    ) -> None:
        self._config = config
        self._port = port or serial_port.SerialPort(
            config.port, serial_port.SerialSettings(config.baud)
        )
        self._reset_stream()

    def _reset_stream(self) -> None:
        self._range_mm = self._zero_mm = math.nan
        self._buffer: bytes | None = b""  # None while streaming
        self._arrival = asyncio.Event()
        self._parser = StreamParser()
        self._batches: list[NDArray[np.int64]] = []
        self._gate = step_gate.StepGate(self._config.step_max_um)
        self._counted = 0
        self._arrived_s = 0.0
        self._silent = 0

    async def open(self) -> roles.DeviceIdentity:
        """Open the port, stop the stream, check its identity, set it and read it back, start the
        stream.

        Raises LinkError (no valid answer; LinkDownError without a port), DeviceRefusedError
        (another device, another range, or a setting that the sensor does not take).
        """
        await self.close()
        self._reset_stream()
        self._port.open(self)
        try:
            # The sensor may hold the first half of a command that an earlier program left: it
            # refuses that together with this one. The second time the command arrives alone.
            with contextlib.suppress(roles.DeviceRefusedError):
                await self._send_command("OUTPUT NONE")
            await self._send_command("OUTPUT NONE")
            identity = await self._identify()
            for setting in self._list_settings():
                await self._write_setting(setting)
            # The answer to this command comes mixed with the first data, so it is not awaited: the
            # parser skips it as bytes outside of frames.
            self._port.write(b"OUTPUT RS422\n")
            self._buffer = None
            await self._first_readings()
        except roles.LinkError:
            await self.close()
            raise
        self._port.succeeded()
        return identity

    def _list_settings(self) -> list[str]:
        return [
            f"MEASRATE {self._config.rate_khz:g}",
            "LASERPOW FULL",
            "OUTREDUCEDEVICE NONE",
            "OUTHOLD NONE",  # an error must show, not the value before it
            "OUTADD_RS422 COUNTER",
        ]

    async def _identify(self) -> roles.DeviceIdentity:
        # Model and range must be those of the configuration
        text = await self._send_command("GETINFO")
        fields = dict(re.findall(r"^\s*([\w. -]+?):\s*(.*?)\s*$", text, re.MULTILINE))
        name = fields.get("Name", "")
        measuring_range = fields.get("Measuring range", "")
        found = re.match(r"([\d.]+)\s*mm", measuring_range)
        if "1420" not in name or found is None:
            raise roles.DeviceRefusedError(
                f"{self._port.name}: {name or text[:40]!r} is not an optoNCDT 1420"
            )
        self._range_mm = float(found[1])
        if self._config.range_mm is not None and self._range_mm != self._config.range_mm:
            raise roles.DeviceRefusedError(
                f"{self._port.name}: {name} measures {self._range_mm:g} mm, range_mm = "
                f"{self._config.range_mm:g}"
            )
        # The displacements at the ends of the range
        if self._config.zero_mm is None:
            self._zero_mm = self._range_mm / 2
        else:
            self._zero_mm = self._config.zero_mm
        ends = [
            1000 * self._config.direction * (end_mm - self._zero_mm)
            for end_mm in (0.0, self._range_mm)
        ]
        serial, version = fields.get("Serial", ""), fields.get("Version", "")
        return roles.DeviceIdentity(
            name, serial, version, f"{self._range_mm:g} mm", (min(ends), max(ends))
        )

    async def _write_setting(self, setting: str) -> None:
        name = setting.split()[0]
        await self._send_command(setting)
        text = await self._send_command(name)
        found = re.search(rf"^\s*{name} +(.+?)\s*$", text, re.MULTILINE)
        if found is None or _format_rate(found[1]) != _format_rate(setting.split()[1]):
            raise roles.DeviceRefusedError(
                f"{self._port.name}: set {setting!r}, read back {text.strip()[:60]!r}"
            )

    async def _send_command(self, command: str) -> str:
        """The answer without its prompt. Raises LinkError, DeviceRefusedError."""
        self._buffer = b""
        self._port.write(command.encode("ascii") + b"\n")
        what = f"{self._port.name}: {command}"
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(self._config.timeout_s):
                while not self._buffer.rstrip().endswith(_PROMPT):
                    await self._wait_for_bytes()
        # it may have arrived while this process was suspended
        if not self._buffer.rstrip().endswith(_PROMPT):
            hint = (
                f"no answer within {self._config.timeout_s:g} s; is it on, wired and set to "
                f"{self._port.settings}?"
            )
            if self._buffer.strip() == command.encode("ascii"):
                hint = (
                    "only what was sent comes back: the sensor is silent and the adapter echoes, "
                    "or the line's two directions are joined"
                )
            elif self._buffer:
                hint = (
                    f"{len(self._buffer)} bytes but no prompt within {self._config.timeout_s:g} "
                    "s; wrong baud rate?"
                )
            raise roles.LinkError(f"{what}: {hint}")
        # bytes of a stream that is just stopping contain no text that could be an error: see the
        # marks
        text = self._buffer.rstrip()[: -len(_PROMPT)].decode("ascii", "replace")
        if error := _ERROR.search(text):
            raise roles.DeviceRefusedError(f"{what}: E{error[1]}{error[2]}")
        return text

    async def _first_readings(self) -> None:
        """Give the gate two readings: it accepts the first value only if a second confirms it."""
        for _ in range(2):
            await self._wait_for_values()
            values = self._take_batches()
            good = values[values <= _RAW_MAX]
            if len(good):
                self._gate.passes(self._displacement_um(mean_of_middle(good)))

    async def displacement(self) -> roles.DisplacementSample:
        """Mean of the middle half of all values since the last call; waits for one when there is
        none yet.

        Raises LinkError (no value in time, or an impossible one, which is dropped), LinkDownError
        (the port is gone, or the sensor stopped streaming: open it again).
        """
        # A sensor that has restarted does not stream: after a few readings without any value it
        # must be opened again, which sends its settings.
        try:
            await self._wait_for_values()
        except roles.LinkDownError:
            raise
        except roles.LinkError as error:
            self._silent += 1
            if self._silent < _SILENT_MAX:
                raise
            await self.close()
            raise roles.LinkDownError(
                f"{error}; it restarted or lost its power: open it again"
            ) from error
        self._silent = 0
        self._port.succeeded()
        # At least half of the values must be measurements; else the most frequent error code counts
        values = self._take_batches()
        good = values[values <= _RAW_MAX]
        if 2 * len(good) <= len(values):
            codes, counts = np.unique(values[values > _RAW_MAX], return_counts=True)
            return roles.DisplacementSample(
                math.nan, int(codes[np.argmax(counts)]), self._counted, self._arrived_s
            )
        # A single jump is dropped: a wrong byte can pass the marks and the counter
        raw = mean_of_middle(good)
        displacement_um = self._displacement_um(raw)
        if not self._gate.passes(displacement_um):
            raise roles.LinkError(
                f"{self._port.name}: a jump to {displacement_um:.1f} µm is ignored until it repeats"
            )
        quality = 0 if _IN_RANGE[0] <= raw <= _IN_RANGE[1] else int(raw)
        return roles.DisplacementSample(
            math.nan if quality else displacement_um, quality, self._counted, self._arrived_s
        )

    def _displacement_um(self, raw: float) -> float:
        return 1000 * self._config.direction * (distance_mm(raw, self._range_mm) - self._zero_mm)

    async def _wait_for_values(self) -> None:
        if not self._port.is_open:
            raise roles.LinkDownError(f"{self._port.name}: not connected")
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(self._config.timeout_s):
                while not self._batches:
                    await self._wait_for_bytes()
        if not self._batches:
            raise roles.LinkError(
                f"{self._port.name}: no value within {self._config.timeout_s:g} s"
            )

    def _take_batches(self) -> NDArray[np.int64]:
        values = np.concatenate(self._batches)
        self._batches.clear()
        return values

    async def _wait_for_bytes(self) -> None:
        """Wait for bytes or the end of the link. Raises LinkDownError."""
        self._arrival.clear()
        await self._arrival.wait()
        if not self._port.is_open:
            raise roles.LinkDownError(f"{self._port.name}: the port is gone")

    def received(self, data: bytes) -> None:
        """Bytes came (called by the port)."""
        if self._buffer is not None:
            self._buffer = (self._buffer + data)[-_BUFFER_BYTES_MAX:]
        elif len(batch := self._parser.feed(data)):
            self._counted += len(batch)
            self._arrived_s = asyncio.get_running_loop().time()
            self._batches.append(batch)
            del self._batches[:-_BATCHES_MAX]
        self._arrival.set()

    def lost(self, error: roles.LinkDownError) -> None:
        """The port is gone (called by the port)."""
        self._arrival.set()

    async def close(self) -> None:
        """Close the port; the laser stays on and streams on. Never raises."""
        self._port.close()
        self._arrival.set()

    def describe(self) -> dict[str, str]:
        """For people: port, settings, manual."""
        zero = "middle of the range"
        if self._config.zero_mm is not None:
            zero = f"{self._config.zero_mm:g} mm"
        return {
            "port": f"{self._port.name}, {self._port.settings}",
            "settings": f"{self._config.rate_khz:g} kHz, zero at {zero}, direction "
            f"{self._config.direction:+d}",
            "lost": f"{self._parser.bytes_lost} bytes outside of values, {self._parser.untrusted} "
            "values untrusted",
            "manual": "optoNCDT 1420 instruction manual, 7.5.2 and appendix A 3",
        }


def _format_rate(value: str) -> str:
    """A rate without unit and trailing zeros, anything else unchanged."""
    rate = _RATE.fullmatch(value)
    return f"{float(rate[1]):g}" if rate else value


def mean_of_middle(values: NDArray[np.int64]) -> float:
    """Mean of the middle half of values (n,), the median of a few."""
    if len(values) < _MIDDLE_MIN:
        return float(np.median(values))
    quarter = len(values) // 4
    return float(np.sort(values)[quarter : len(values) - quarter].mean())
