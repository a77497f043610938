"""Keyence DL-RS1A communication unit on RS-232, with the sensor amplifiers of the IL, IG and GT2
series.

Manual: DL-RS1A user's manual, IL edition (96081E): settings page 7, commands pages 8-10, data
numbers pages 11-12, error numbers page 16. A command ends in CR or CR LF, an answer in CR LF; CR
alone is accepted too.

`SR,ii,038` reads the internal value (R.V.) of amplifier ii: unlike the judgment value of `M0`,
neither a zero shift at the amplifier's own keys nor a hold setting moves it, and its answer names
its question. The protocol has no checksum. Even parity at the unit's switches (and here) stops most
corrupted bytes; a value that differs from the two before it by more than `step_max_um` is rejected;
a smaller error passes as noise.
"""

import asyncio
import math
import re

from firmware_iface import roles, settings
from firmware_iface.drivers import step_gate
from firmware_iface.links import line_link, serial_port

_VALUE = r"[+-](?:\d\d\.\d{3}|\d{3}\.\d\d|\d{4}\.\d|E{2}\.E{3}|E{3}\.E{2}|E{4}\.E)"
_ALL = re.compile(rf"(?:M0((?:,{_VALUE})+)|ER,M0,(\d\d))\r\n?")
_ALL_CHARS = 4 + 15 * 8
# page 16
ERRORS = {
    0: "unknown command",
    20: "wrong length",
    21: "wrong number of parameters",
    22: "parameter out of range, or not readable",
    29: "receive error on RS-232: baud rate or parity differ",
    65: "no amplifier of this number",
}
QUALITY_AMPLIFIER_ERROR, QUALITY_OUT_OF_RANGE = 1, 2
_NOT_READABLE = "22"
_STEPS_UM = {3: 1.0, 2: 10.0, 1: 100.0}  # decimals of the millimetre


class KeyenceDlRs1a(line_link.LineDriver):
    """A `DisplacementSensor`: displacement = direction * (value - zero).

    Parameters
    ----------
    config : KeyenceDlRs1aConfig
        Port, amplifier, zero and direction.
    port : SerialPort or None
        Replaces the configured one, for tests.
    """

    manual = "DL-RS1A user's manual, IL edition, pages 7-16"

    def __init__(
        self, config: settings.KeyenceDlRs1aConfig, port: serial_port.SerialPort | None = None
    ) -> None:
        self._config = config
        number = f"{config.amplifier:02d}"
        self._read_command = f"SR,{number},038"
        self._read_answer = re.compile(rf"(?:SR,{number},038,({_VALUE})|ER,SR,(\d\d))\r\n?")
        self._errors_command = f"SR,{number},033"
        self._errors_answer = re.compile(rf"(?:SR,{number},033,(\d{{5}})|ER,SR,(\d\d))\r\n?")
        # the fence must differ from a reading even when refused, as when the amplifier is pulled
        # off: `M0`
        fence = line_link.LineFence("M0", _ALL, _ALL_CHARS)
        settings = serial_port.SerialSettings(config.baud, parity=config.parity)
        super().__init__(
            port or serial_port.SerialPort(config.port, settings), "\r\n", config.timeout_s, fence
        )
        self._gate = step_gate.StepGate(config.step_max_um)
        self._decimals = 3
        self._readings = 0

    async def open(self) -> roles.DeviceIdentity:
        """Open the port and check that the amplifier is present and without error. The unit has no
        settings to apply.

        Raises LinkError (no valid answer; LinkDownError without a port), DeviceRefusedError (no
        such amplifier, one in error, or one with steps coarser than `step_max_um`).
        """
        await self._link.close()
        self._gate = step_gate.StepGate(self._config.step_max_um)
        return await self._open_port(self._identify)

    async def _identify(self) -> roles.DeviceIdentity:
        every = await self._link.query("M0", _ALL, _ALL_CHARS)
        _raise_refusal(self._link.name, every[2])
        values = every[1][1:].split(",")
        if self._config.amplifier >= len(values):
            raise roles.DeviceRefusedError(
                f"{self._link.name}: amplifier = {self._config.amplifier}, but there are only "
                f"{len(values)} (0 is the first)"
            )
        self._decimals = len(values[self._config.amplifier].partition(".")[2])
        if _STEPS_UM[self._decimals] > self._config.step_max_um:
            raise roles.DeviceRefusedError(
                f"{self._link.name}: head with steps of {_STEPS_UM[self._decimals]:g} µm"
            )
        errors = await self._link.query(self._errors_command, self._errors_answer)
        # amplifiers without this number: the value shows their head error
        if errors[2] != _NOT_READABLE:
            _raise_refusal(self._link.name, errors[2])
        if bits := int(errors[1] or 0):
            raise roles.DeviceRefusedError(
                f"{self._link.name}: amplifier in error (state {bits:016b}); see its manual"
            )
        await self._read_values()  # the first one is confirmed by a second
        detail = (
            f"amplifier {self._config.amplifier} of {len(values)}, steps of "
            f"{_STEPS_UM[self._decimals]:g} µm"
        )
        return roles.DeviceIdentity("Keyence DL-RS1A", "", "", detail)

    async def displacement(self) -> roles.DisplacementSample:
        """Ask for the value now.

        Counter and time are the driver's: valid answers so far, time of arrival. Raises LinkError
        (no valid answer, or a jump that is ignored until it repeats), LinkDownError (the port is
        gone).
        """
        quality, displacement_um, passed = await self._read_values()
        if not passed:
            raise roles.LinkError(
                f"{self._link.name}: jump to {displacement_um:.0f} µm, ignored until it repeats"
            )
        self._readings += 1
        return roles.DisplacementSample(
            displacement_um, quality, self._readings, asyncio.get_running_loop().time()
        )

    async def _read_values(self) -> tuple[int, float, bool]:
        """Quality, displacement and whether the gate passed it."""
        answer = await self._link.query(self._read_command, self._read_answer)
        _raise_refusal(self._link.name, answer[2])
        text = answer[1]
        if len(text.partition(".")[2]) != self._decimals:
            raise roles.LinkError(
                f"{self._link.name}: {text} does not have {self._decimals} decimals as before"
            )
        if "E" in text:
            return QUALITY_AMPLIFIER_ERROR, math.nan, True
        # page 12: beyond the display above or below; one less: no value
        if text[1:].replace(".", "") in ("99999", "99998"):
            return QUALITY_OUT_OF_RANGE, math.nan, True
        displacement_um = 1000 * self._config.direction * (float(text) - self._config.zero_mm)
        return 0, displacement_um, self._gate.passes(displacement_um)

    @property
    def _shown(self) -> str:
        config = self._config
        return (
            f"amplifier {config.amplifier}, zero at {config.zero_mm:g} mm, direction "
            f"{config.direction:+d}"
        )


def _raise_refusal(name: str, code: str | None) -> None:
    if code is not None:
        raise roles.DeviceRefusedError(f"{name}: error {code} ({ERRORS.get(int(code), 'unknown')})")
