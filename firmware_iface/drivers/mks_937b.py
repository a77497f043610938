"""MKS 937B and 946 controllers with a capacitance manometer (Baratron), on RS-232 or RS-485.

Manuals: 937B operation manual, page 86 (question `@<aaa><command>?;FF`, answer
`@<aaa>ACK<response>;FF`); 946 instruction manual, page 103 (system commands `U`, `MD`, `SN`, `FV6`,
`STA`..`STC`). An error answers `NAK` and a number.

A reading has neither unit nor checksum. The unit is set to pascal at every opening. A reading that
differs from the two before it by more than `step_max_pa` is refused, and after it the unit is read
again: it could have been changed at the front panel.
"""

import math
import re

from firmware_iface import roles, settings
from firmware_iface.drivers import step_gate
from firmware_iface.links import line_link, serial_port

_NUMBER = re.compile(r" ?([+-]?\d\.\d{1,4}) ?E([+-]?\d{1,2})")
_MODELS = ("937B", "946")
_SENSORS = re.compile(r"([A-Z]{2})[, ]?([A-Z]{2})")  # two channels of a module, such as CMNG
_MANOMETER = "CM"


class Mks937b(line_link.LineDriver):
    """A `PressureSensor`.

    Parameters
    ----------
    config : Mks937bConfig
        Port, address of the controller and channel of the manometer.
    port : SerialPort or None
        Replaces the configured one, for tests.
    """

    manual = "937B operation manual, page 86; 946 instruction manual, page 103"

    def __init__(
        self, config: settings.Mks937bConfig, port: serial_port.SerialPort | None = None
    ) -> None:
        line = serial_port.SerialSettings(config.baud, parity=config.parity)
        self._config = config
        self._to = f"@{config.address:03d}"
        self._answer = re.compile(rf"{self._to}(?:ACK([^;@]{{0,20}})|NAK(\d{{1,3}}));FF")
        # a model has a digit, as no word in place of a reading has, and no decimal point
        fence = line_link.LineFence(
            f"{self._to}MD?", re.compile(rf"{self._to}ACK(?=[A-Z]*\d)[A-Z\d]{{3,6}};FF")
        )
        super().__init__(
            port or serial_port.SerialPort(config.port, line), ";FF", config.timeout_s, fence
        )
        self._reset_step_gate()

    def _reset_step_gate(self) -> None:
        self._gate = step_gate.StepGate(self._config.step_max_pa)
        self._jumped = False

    async def open(self) -> roles.DeviceIdentity:
        """Open the port, check model and sensor, set the unit to pascal and read it back.

        Raises LinkError (no valid answer; LinkDownError without a port), DeviceRefusedError
        (another instrument, no capacitance manometer on the channel, or a unit that it does not
        take).
        """
        await self._link.close()
        self._reset_step_gate()
        # the greeting ends what an earlier program left half sent
        return await self._open_port(self._begin, ";FF")

    async def _begin(self) -> roles.DeviceIdentity:
        config = self._config
        # Is it the configured instrument?
        model, serial, firmware = [
            await self._query_gauge(command) for command in ("MD?", "SN?", "FV6?")
        ]
        if config.serial not in ("", serial):
            raise roles.DeviceRefusedError(
                f"{self._link.name}: serial number {serial}, expected {config.serial}"
            )
        if model not in _MODELS:
            raise roles.DeviceRefusedError(
                f"{self._link.name}: {model} is not a {' or '.join(_MODELS)}"
            )
        # Does its channel have a manometer? Channels 1 and 2 are in module A, 3 and 4 in B, 5 and 6
        # in C; a module answers with the kinds of both, such as CMNG.
        module = "ABC"[(config.channel - 1) // 2]
        kinds = _SENSORS.fullmatch(await self._query_gauge(f"ST{module}?"))
        kind = kinds[1 + (config.channel - 1) % 2] if kinds else "none"
        if kind != _MANOMETER:
            raise roles.DeviceRefusedError(
                f"{self._link.name}: channel {config.channel} has the sensor {kind}, not "
                f"{_MANOMETER}, a capacitance manometer"
            )
        # Its unit, set and read back.
        await self._query_gauge("U!PASCAL")
        await self._require_pascal()
        await self._reading_pa()  # the gate needs a second reading to confirm the first
        full_pa = math.inf if config.range_pa is None else config.range_pa
        return roles.DeviceIdentity(
            f"MKS {model}", serial, firmware, f"channel {config.channel}", (-full_pa, full_pa)
        )

    async def gauge_pressure_pa(self) -> float:
        """The pressure now, NaN when the controller shows a word instead (no sensor, over range).

        Raises LinkError (no valid answer, or a jump that is ignored until it repeats),
        LinkDownError (the port is gone, or the unit was changed: open it again).
        """
        # A jump may be another unit, chosen at the front panel: 1 mbar reads as 1 instead of 100.
        if self._jumped:
            await self._require_pascal()
        pressure_pa, self._jumped = await self._reading_pa()
        if self._jumped:
            raise roles.LinkError(
                f"{self._link.name}: a jump to {pressure_pa:.1f} Pa is ignored until it repeats"
            )
        return pressure_pa

    async def _reading_pa(self) -> tuple[float, bool]:
        """The reading, and whether it is far from the two before it."""
        number = _NUMBER.fullmatch(await self._query_gauge(f"PR{self._config.channel}?"))
        if number is None:
            return math.nan, False
        pressure_pa = float(f"{number[1]}e{number[2]}")
        return pressure_pa, not self._gate.passes(pressure_pa)

    async def _require_pascal(self) -> None:
        unit = await self._query_gauge("U?")
        if unit.upper() != "PASCAL":
            await self._link.close()
            raise roles.LinkDownError(
                f"{self._link.name}: its unit is {unit}, not PASCAL; leave its front panel alone"
            )

    async def _query_gauge(self, command: str) -> str:
        """The response. Raises LinkError, DeviceRefusedError (NAK)."""
        answer = await self._link.query(f"{self._to}{command}", self._answer)
        if answer[2]:
            raise roles.DeviceRefusedError(
                f"{self._link.name}: {command} is refused (NAK {answer[2]}); see its manual"
            )
        return answer[1].strip()

    @property
    def _shown(self) -> str:
        return f"address {self._config.address}, channel {self._config.channel}"
