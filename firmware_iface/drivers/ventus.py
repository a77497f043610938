"""Lee (TTP) Ventus disc pump with a GP driver or smart pump module, on a UART.

Source: Technical Note TN003, Communications Guide (registers), and the vendor's
python-control-Development-Kit. `#W<register>,<value>` LF writes and is not answered, `#R<register>`
LF is answered `#R<register>,<value>`.

The pump has no watchdog: it runs on at its last power when the host is gone, and after power-up it
follows its analogue input until a host commands it. Where gas must stop without a host, another
device must stop it.
"""

import contextlib
import re

from firmware_iface import roles, settings
from firmware_iface.links import line_link, serial_port

ENABLE = 0
POWER_LIMIT_MW = 1
STREAM = 2
MODE = 10
MANUAL_SOURCE = 11
SET_VALUE = 23
ERROR = 31
FIRMWARE, DEVICE_TYPE, FIRMWARE_MINOR = 36, 37, 38
DEVICE_TYPES = {2: "general purpose driver", 3: "smart pump module"}
_MODE_MANUAL = 0
_SOURCE_SET_VALUE = 0
_OFF = 0
_ON = 1
# what a corrupted write or a power cycle could change unseen: read back with every command
_KEPT = (POWER_LIMIT_MW, MODE, MANUAL_SOURCE)
_STATE = (ENABLE, SET_VALUE, ERROR, *_KEPT)
_NUMBER = r"-?\d+(?:\.\d+)?"
_STEP_MW = 0.0011  # values are written with three decimals


class Ventus(line_link.LineDriver):
    """A `Pump`: the fraction is that of `power_max_mw`.

    Parameters
    ----------
    config : VentusConfig
        Port, and the power of full drive.
    port : SerialPort or None
        Replaces the configured one, for tests.
    """

    manual = "TN003 Communications Guide; no watchdog: the pump runs on when the host is gone"

    def __init__(
        self, config: settings.VentusConfig, port: serial_port.SerialPort | None = None
    ) -> None:
        self._power_max_mw = config.power_max_mw
        # streamed lines may be on their way when the stream is switched off
        answer = re.compile(rf"(?:#S[^\n]*\n)*#R{DEVICE_TYPE},({_NUMBER})\r?\n")
        fence = line_link.LineFence(f"#R{DEVICE_TYPE}", answer)
        port = port or serial_port.SerialPort(config.port, serial_port.SerialSettings(115_200))
        super().__init__(port, "\n", config.timeout_s, fence)
        self._commanded_mw = 0.0

    async def open(self) -> roles.DeviceIdentity:
        """Open the port, stop the pump, check its identity, apply the settings and read them back.

        Raises LinkError (no valid answer; LinkDownError without a port), DeviceRefusedError
        (another device, or a setting that it does not take).
        """
        await self._link.close()
        # off at once, also when nothing else works; a stream would never leave the line quiet
        return await self._open_port(self._begin, f"\n#W{ENABLE},{_OFF}\n#W{STREAM},0\n")

    async def _begin(self) -> roles.DeviceIdentity:
        about = await self._write_and_read({}, DEVICE_TYPE, FIRMWARE, FIRMWARE_MINOR)
        kind = int(about[DEVICE_TYPE])
        if kind not in DEVICE_TYPES:
            raise roles.DeviceRefusedError(
                f"{self._link.name}: device type {kind} is not a Ventus driver (2 or 3)"
            )
        # Manual mode with the power from the register: only there the power is what is written.
        # The pump stays off meanwhile (`open` has switched it off).
        wanted = self._list_wanted_settings()
        found = await self._write_and_read(wanted, *wanted)
        if found != wanted:
            raise roles.DeviceRefusedError(
                f"{self._link.name}: registers set to {wanted}, read back {found}"
            )
        await self.set_pump(0.0)
        return roles.DeviceIdentity(
            f"Ventus {DEVICE_TYPES[kind]}", "", f"{about[FIRMWARE]:g}.{about[FIRMWARE_MINOR]:g}"
        )

    def _list_wanted_settings(self) -> dict[int, float]:
        return {
            STREAM: 0.0,
            MODE: float(_MODE_MANUAL),
            MANUAL_SOURCE: float(_SOURCE_SET_VALUE),
            POWER_LIMIT_MW: float(round(self._power_max_mw)),
        }

    async def set_pump(self, fraction: float) -> None:
        """Command the pump and read it back.

        Raises ValueError (not within 0..1; nothing is sent), LinkError (no valid answer: the pump
        may or may not have it), LinkDownError (the port is gone, or the pump has another value than
        written: open it again).
        """
        if not 0.0 <= fraction <= 1.0:
            raise ValueError(f"pump fraction = {fraction} is not within 0..1")
        self._commanded_mw = fraction * self._power_max_mw
        writes = {SET_VALUE: self._commanded_mw, ENABLE: float(_ON if fraction > 0 else _OFF)}
        await self._check_state(await self._write_and_read(writes, *_STATE))

    async def pump_fraction(self) -> float:
        """Read back the pump's setting.

        Raises LinkError (no valid answer, or the pump reports an error), LinkDownError (the port is
        gone, or the pump has a setting that this program did not command: open it again).
        """
        return await self._check_state(await self._write_and_read({}, *_STATE)) / self._power_max_mw

    async def _check_state(self, state: dict[int, float]) -> float:
        """Power in mW if all is as commanded; asked once more before a difference is accepted."""
        if not self._as_commanded(state):
            state = await self._write_and_read({}, *_STATE)
        if not self._as_commanded(state):
            await self._link.close()
            raise roles.LinkDownError(
                f"{self._link.name}: commanded {self._commanded_mw:.3f} mW, the pump has "
                f"{state[SET_VALUE]:g} mW (on: {state[ENABLE]:g}, mode: {state[MODE]:g}, source: "
                f"{state[MANUAL_SOURCE]:g}, limit: {state[POWER_LIMIT_MW]:g} mW); noise on the "
                "line, or it restarted: open it again"
            )
        if error := state[ERROR]:
            raise roles.LinkError(
                f"{self._link.name}: the pump reports error {error:g}; see its manual"
            )
        return state[SET_VALUE] if state[ENABLE] else 0.0

    def _as_commanded(self, state: dict[int, float]) -> bool:
        settings = self._list_wanted_settings()
        return (
            abs(state[SET_VALUE] - self._commanded_mw) < _STEP_MW
            and bool(state[ENABLE]) == (self._commanded_mw > 0)
            and all(state[register] == settings[register] for register in _KEPT)
        )

    async def _write_and_read(self, writes: dict[int, float], *registers: int) -> dict[int, float]:
        """Write and read in one exchange: a write has no answer of its own."""
        lines = [
            f"#W{register},{_format_value(register, value)}" for register, value in writes.items()
        ]
        lines += [f"#R{register}" for register in registers]
        answer = await self._link.query(
            "\n".join(lines), _make_answer_form(*registers), 24 * len(registers)
        )
        return {
            register: float(value)
            for register, value in zip(registers, answer.groups(), strict=True)
        }

    async def close(self) -> None:
        """Switch the pump off and close the port. Never raises."""
        if self._link.port.is_open:
            # out of reach: this program can no longer stop the gas
            with contextlib.suppress(roles.LinkError):
                await self.set_pump(0.0)
        await self._link.close()

    @property
    def _shown(self) -> str:
        return f"full drive {self._power_max_mw:g} mW"


def _make_answer_form(*registers: int) -> re.Pattern[str]:
    """The form of the answers to `#R` of these, in order."""
    return re.compile("".join(rf"#R{register},({_NUMBER})\r?\n" for register in registers))


def _format_value(register: int, value: float) -> str:
    """Power values are floats and written with three decimals, the others are integers."""
    if register == SET_VALUE:
        return f"{value:.3f}"
    return f"{value:.0f}"
