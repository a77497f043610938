"""Vaisala PTB330 barometer on RS-232.

Manual: PTB330 user's guide M210855EN; FORM and its modifiers pages 70-72, UNIT, ECHO page 83, `?`
and ERRS pages 87-88. Its factory setting is 4800 7E1.

Each message is configured to carry pressure, unit, the modules' error flags, the running counter of
measurements (which reveals a frozen value), the serial number (which reveals another instrument)
and a checksum (sum of all bytes before it modulo 65536): `FORM 4.3 P U3 ERR MCTR SN CS4`.
"""

import asyncio
import math
import re
from dataclasses import dataclass

from firmware_iface import roles, settings
from firmware_iface.links import line_link, serial_port

FORMAT = '4.3 P " " U3 " " ERR " " MCTR " " SN " " CS4 #r #n'
PA_PER_HPA = 100.0
RANGE_PA = (50_000.0, 110_000.0)  # of the instrument
_MESSAGE = re.compile(r"(( *\d{3,4}\.\d{3}|\*+) hPa ([01]{1,3}) * *(\d+) +(\w+) )([0-9A-F]{4})\r\n")
_IDENTITY = re.compile(
    r".*?(PTB330) / (\S+).*?Serial number\s*: *(\S+).*?Module 4\s*:[^\r\n]*\r\n", re.DOTALL
)
# the echo may still be on at the first question
_VERSION = re.compile(r"(?:.*\r\n)?>? *\S+ / \S+ *\r\n>?", re.DOTALL)
_UNIT = re.compile(r"P\s*: hPa *\r\n(?:[^\r\n]*\r\n)*")  # other quantities follow
_OK = re.compile(r"(?:OK|Output format\s*:[^\r\n]*)\s*\r\n")
_FORM = re.compile(r"Output format\s*:([^\r\n]*)\r\n")
_ERRORS = re.compile(r"(?:(?:PASS|FAIL)\s*\r\n)?([^\r\n]+)\r\n")


@dataclass(frozen=True, slots=True)
class BarometerMessage:
    """One measurement: `pressure_pa` NaN when the instrument has none, `counter` its running
    number.
    """

    pressure_pa: float
    counter: int
    serial: str


class VaisalaPtb330(line_link.LineDriver):
    """A `Barometer`. A task polls it every `period_s`; the newest value is served.

    Parameters
    ----------
    config : VaisalaPtb330Config
        Port, period of the requests, and age at which a value no longer counts.
    port : SerialPort or None
        Replaces the configured one, for tests.
    """

    manual = "PTB330 user's guide M210855EN, pages 70-88"

    def __init__(
        self, config: settings.VaisalaPtb330Config, port: serial_port.SerialPort | None = None
    ) -> None:
        settings = serial_port.SerialSettings(config.baud, data_bits=7, parity="E")
        fence = line_link.LineFence("VERS", _VERSION)
        super().__init__(
            port or serial_port.SerialPort(config.port, settings), "\r\n", config.timeout_s, fence
        )
        self._period_s = config.period_s
        self._age_max_s = config.age_max_s
        self._task: asyncio.Task[None] | None = None
        self._newest = BarometerMessage(math.nan, -1, "")
        self._newest_s = -math.inf
        self._down: roles.LinkDownError | None = None
        self._identity: roles.DeviceIdentity | None = None

    async def open(self) -> roles.DeviceIdentity:
        """Open the port, stop its own output, check its identity, set unit and format, start to
        poll.

        Raises LinkError (no valid answer; LinkDownError without a port), DeviceRefusedError
        (another instrument, or a format that it does not take).
        """
        await self.close()
        self._newest = BarometerMessage(math.nan, -1, "")
        self._newest_s = -math.inf
        self._down = None
        identity = await self._open_port(self._begin, "\r\nS\r\nECHO OFF\r\n")
        self._task = asyncio.create_task(self._keep_reading(), name="barometer")
        return identity

    async def _begin(self) -> roles.DeviceIdentity:
        identity = await self._accept_reading()
        if identity is None:
            identity = await self._identify()
            await self._apply_settings()
            self._identity = identity
            await self._read_message()
        return identity

    async def _accept_reading(self) -> roles.DeviceIdentity | None:
        """The known identity, if a message of the right form and serial number comes at once; this
        saves a second.
        """
        if self._identity is not None:
            try:
                await self._read_message()
            except roles.LinkDownError:
                raise
            except roles.LinkError:
                return None
        return self._identity

    async def _identify(self) -> roles.DeviceIdentity:
        try:
            about = await self._link.query("?", _IDENTITY, 1000)
        except (roles.LinkDownError, roles.DeviceRefusedError):
            raise
        except roles.LinkError as error:
            raise roles.DeviceRefusedError(f"{error} (or it is not a PTB330)") from error
        errors = await self._link.query("ERRS", _ERRORS, 400)
        return roles.DeviceIdentity(f"Vaisala {about[1]}", about[3], about[2], errors[1].strip())

    async def _apply_settings(self) -> None:
        await self._link.query("UNIT P hPa", _UNIT, 600)
        await self._link.query(f"FORM {FORMAT}", _OK, 200)
        found = (await self._link.query("FORM ?", _FORM, 200))[1]
        # it is shown with backslashes in place of hash signs
        if found.replace("\\", "#").casefold().split() != FORMAT.casefold().split():
            raise roles.DeviceRefusedError(
                f"{self._link.name}: FORM set to {FORMAT!r}, read back {found.strip()!r}"
            )

    async def _keep_reading(self) -> None:
        while True:
            await asyncio.sleep(self._period_s)
            try:
                await self._read_message()
            except roles.LinkDownError as error:
                self._down = error
                return
            except roles.LinkError:
                pass  # the age of the newest value shows it

    async def _read_message(self) -> None:
        answer = await self._link.query("SEND", _MESSAGE)
        message = decode_message(answer, self._link.name)
        if self._identity is not None and message.serial != self._identity.serial:
            wanted, self._identity = self._identity.serial, None
            raise roles.LinkError(
                f"{self._link.name}: this is barometer {message.serial}, before it was {wanted}"
            )
        if message.counter == self._newest.counter:
            return
        self._newest = message
        self._newest_s = asyncio.get_running_loop().time()

    async def ambient_pressure_pa(self) -> float:
        """The newest value, NaN when it is too old or the instrument has none.

        Raises LinkDownError (the port is gone: open it again).
        """
        if self._down is not None:
            raise roles.LinkDownError(str(self._down))
        if not self._link.port.is_open:
            raise roles.LinkDownError(f"{self._link.name}: not connected")
        fresh = asyncio.get_running_loop().time() - self._newest_s <= self._age_max_s
        if fresh:
            return self._newest.pressure_pa
        return math.nan

    async def close(self) -> None:
        """Stop asking and close the port. Never raises."""
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            await asyncio.wait([task])
        await self._link.close()

    @property
    def _shown(self) -> str:
        return f"asked every {self._period_s:g} s, NaN when older than {self._age_max_s:g} s"


def decode_message(message: re.Match[str], name: str) -> BarometerMessage:
    """Check and convert a message that has the form of `FORMAT`.

    Parameters
    ----------
    message : re.Match
        The match.
    name : str
        Of the instrument, for the error.

    Returns
    -------
    BarometerMessage
        Its pressure is NaN if the instrument reports a fault of its own.

    Raises
    ------
    LinkError
        Wrong checksum, or a pressure that the instrument cannot measure.
    """
    # The sum of all characters, then the fault flags of the instrument.
    checked, pressure, flags, counter, serial, checksum = message.groups()
    if sum(checked.encode("ascii")) % 2**16 != int(checksum, 16):
        raise roles.LinkError(f"{name}: wrong checksum; noise on the line")
    if "*" in pressure or "1" in flags:
        return BarometerMessage(math.nan, int(counter), serial)
    pressure_pa = float(pressure) * PA_PER_HPA
    if not RANGE_PA[0] <= pressure_pa <= RANGE_PA[1]:
        raise roles.LinkError(
            f"{name}: {pressure_pa:.0f} Pa is outside of {RANGE_PA[0]:.0f} .. {RANGE_PA[1]:.0f} Pa"
        )
    return BarometerMessage(pressure_pa, int(counter), serial)
