"""Emulators of pressure gauges on their serial lines.

MKS 937B or 946 with a capacitance manometer on one channel: 937B manual page 86, 946 manual page
103. Vaisala PTB330: user's guide M210855EN, pages 70-103.
"""

import asyncio
import math
import re

from firmware_iface.emulators.serial_device import LineDevice, Sensor, Transmit

_SYNTAX, _ARGUMENT = "160", "169"
_PASCALS = {"TORR": 133.322368, "MBAR": 100.0, "PASCAL": 1.0, "MICRON": 0.133322368}
_MODULES = ("A", "B", "C")  # of two sensors each
_SENSORS = ("1", "2", "3", "4", "5", "6")
_PERIOD_S = 0.1  # of its measurements
_WORD = re.compile(r'"[^"]*"|\S+')
_DEFAULT_FORMAT = '"P= " 4.2 P " " U3 #r #n'


class Mks937bEmulator(LineDevice):
    """Measures the gauge pressure.

    Parameters
    ----------
    gauge_pa : callable
        The pressure; NaN: over range.
    baud, parity : int, str
        Of the line.
    address : int
        Of the controller, 1..254.
    channel : int
        That of the capacitance manometer, 1..6; the others have other sensors.

    Attributes
    ----------
    unit : str
        As chosen at its front panel, or by a command.
    """

    end = b";FF"

    def __init__(
        self,
        gauge_pa: Sensor,
        baud: int = 115_200,
        parity: str = "N",
        address: int = 253,
        channel: int = 1,
    ):
        super().__init__(baud, parity=parity)
        self.model = "937B"
        self.serial = "0123456789"
        self.unit = "TORR"
        self.sensors = ["NG"] * 6
        self.sensors[channel - 1] = "CM"
        self.locked = False  # parameter setting disabled at the front panel
        self._gauge_pa = gauge_pa
        self._address = address
        self._held = ""

    def line(self, text: str) -> None:
        """One command, if it has this controller's address."""
        head, command = text[:4], text[4:]
        if head == f"@{self._address:03d}":
            self.send_answer(f"{head}{self._answer(command)};FF".encode("ascii"))

    def _answer(self, command: str) -> str:
        if command.startswith("U!"):
            if self.locked or command[2:].upper() not in _PASCALS:
                return f"NAK{_ARGUMENT}"
            self.unit = command[2:].upper()
            return f"ACK{self.unit}"
        setting = None
        if command.endswith("?"):
            setting = self._answer_setting(command[:-1])
        if setting is None:
            return f"NAK{_SYNTAX}"
        return f"ACK{setting}"

    def _answer_setting(self, name: str) -> str | None:
        command, index = name[:2], name[2:]
        # STA, STB, STC: the two sensors of a module
        if command == "ST" and index in _MODULES:
            first = 2 * _MODULES.index(index)
            return "".join(self.sensors[first : first + 2])
        # PR1 to PR6: the pressure of a sensor
        if command == "PR" and index in _SENSORS:
            sensor = self.sensors[int(index) - 1]
            return self._format_pressure(sensor)
        texts = {"MD": self.model, "SN": self.serial, "FV6": "1.27", "U": self.unit}
        return texts.get(name)

    def _format_pressure(self, sensor: str) -> str:
        if sensor != "CM":
            return "NOGAUGE!"
        if not self.frozen:
            value = self._gauge_pa() / _PASCALS[self.unit]
            mantissa, _, exponent = f"{value:.3E}".partition("E")
            if math.isnan(value):
                self._held = "OVER"
            else:
                self._held = f"{mantissa}E{int(exponent):+d}"
        return self._held


class VaisalaPtb330Emulator(LineDevice):
    """Measures the air pressure.

    Parameters
    ----------
    ambient_pressure_pa : callable
        The pressure; NaN: it cannot be measured.
    baud : int
        Of the line.
    running : bool
        Whether an earlier program left it sending without requests.
    model : str
        As it identifies itself.

    Attributes
    ----------
    error_flags : str
        A digit for each of its three modules; 1 is a fault.
    """

    end = b"\r"

    def __init__(
        self,
        ambient_pressure_pa: Sensor,
        baud: int = 4800,
        running: bool = False,
        model: str = "PTB330",
    ) -> None:
        super().__init__(baud, data_bits=7, parity="E")
        self.error_flags = "000"
        self.serial = "A1234567"
        self._ambient_pressure_pa = ambient_pressure_pa
        self._model = model
        self._format = _DEFAULT_FORMAT
        self._unit = "hPa"
        self._echo = True
        self._running = running
        self._pressure_pa = math.nan
        self._counter = 0
        self._stream: asyncio.TimerHandle | None = None

    def restart(self) -> None:
        """Format and unit are kept; the echo is on again."""
        super().restart()
        self._echo = True

    def attach(self, transmit: Transmit) -> None:
        """The wire is plugged in."""
        super().attach(transmit)
        if self._running:
            self._stream = asyncio.get_running_loop().call_later(_PERIOD_S, self._run)

    def detach(self) -> None:
        """The wire is pulled."""
        if self._stream is not None:
            self._stream.cancel()
            self._stream = None
        super().detach()

    def _run(self) -> None:
        self._stream = None
        if self._running:
            self.send_answer(self._format_message())
            self._stream = asyncio.get_running_loop().call_later(_PERIOD_S, self._run)

    def line(self, text: str) -> None:
        """One command."""
        echo = f"{text}\r\n" if self._echo else ""
        answer = self._answer(text)
        prompt = ">" if self._echo else ""
        if whole := echo.encode("ascii", "replace") + answer + prompt.encode("ascii"):
            self.send_answer(whole)

    def _answer(self, text: str) -> bytes:
        command, _, rest = text.partition(" ")
        if command.upper() == "SEND":
            return self._format_message()
        return self._answer_command(command.upper(), rest).replace("\n", "\r\n").encode("ascii")

    def _answer_command(self, command: str, rest: str) -> str:
        if command == "S":
            self._running = False
        elif command == "VERS":
            return f"{self._model} / 1.01\n"
        elif command == "?":
            return self._format_identity()
        elif command == "ERRS":
            if "1" not in self.error_flags:
                return "PASS\nNo errors\n"
            return "FAIL\nModule error\n"
        elif command == "ECHO":
            self._echo = rest.upper() != "OFF"
            return f"Echo           : {'ON' if self._echo else 'OFF'}\n"
        elif command == "UNIT":
            self._unit = rest.split()[1]
            return f"P              : {self._unit}\nP3h            : hPa\nTP1            : 'C\n"
        elif command == "FORM" and rest == "?":
            return "Output format  : " + self._format.replace("#", "\\") + "\n"
        elif command == "FORM":
            self._format = _DEFAULT_FORMAT if rest == "/" else rest
            return "OK\n"
        elif command:
            return "Unknown command\n"
        return ""

    def _format_identity(self) -> str:
        modules = "".join(
            f"Module {n}       : {'BARO-1' if n < 4 else 'EMPTY'}\n" for n in range(1, 5)
        )
        return (
            f"{self._model} / 1.01\nSerial number  : {self.serial}\nBatch number   : B8901234\n"
            f"Output format  : {self._format}\nAdjust. date   : 2007-05-03\nAdjust. info   : "
            "VAISALA\n"
            "Date           : 2007-05-08\nTime           : 13:42:01\nStart mode     : STOP\n"
            f"Baud P D S     : {self.settings.baud} E 7 1\nOutput interval: 1 s\nAddress     "
            "   : 0\n"
            f"Echo           : {'ON' if self._echo else 'OFF'}\n{modules}"
        )

    def _format_message(self) -> bytes:
        """Table 12 (page 71): number format before a quantity, quoted text as it is, the rest by
        name.
        """
        if not self.frozen:
            self._counter = int(asyncio.get_running_loop().time() / _PERIOD_S)
            self._pressure_pa = self._ambient_pressure_pa()
        # A number format such as 4.2 holds for the quantities after it; CS4 is the checksum of the
        # text so far.
        text, digits, decimals = "", 4, 2
        for word in _WORD.findall(self._format):
            if number := re.fullmatch(r"(\d)\.(\d)", word):
                digits, decimals = int(number[1]), int(number[2])
            else:
                text += self._format_field(word, text, digits, decimals)
        return text.encode("ascii")

    def _format_field(self, word: str, so_far: str, digits: int, decimals: int) -> str:
        if word.startswith('"'):
            return word[1:-1]
        width = digits + 1 + decimals
        pressure = self._pressure_pa / {"hPa": 100.0, "kPa": 1000.0, "Pa": 1.0}[self._unit]
        fields = {
            "P": "*" * width if math.isnan(pressure) else f"{pressure:{width}.{decimals}f}",
            "U3": f"{self._unit:3.3}",
            "ERR": f"{self.error_flags:3}",
            "MCTR": f"{self._counter}",
            "SN": self.serial,
            "CS4": f"{sum(so_far.encode('ascii')) % 2**16:04X}",
            "#R": "\r",
            "#N": "\n",
        }
        return fields[word.upper()]
