"""A Vaisala PTB330 on its serial line (user's guide M210855EN, pages 70-103)."""

import asyncio
import math
import re

from firmware_iface.emulators.serial_device import LineDevice, Sensor, Transmit

_PERIOD_S = 0.1  # of its measurements
_WORD = re.compile(r'"[^"]*"|\S+')
_DEFAULT_FORMAT = '"P= " 4.2 P " " U3 #r #n'


class VaisalaPtb330Emulator(LineDevice):
    """Measures the air (NaN: it cannot); `running`: it was left sending. `error_flags` are its three modules'."""

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
        self._format, self._unit, self._echo = _DEFAULT_FORMAT, "hPa", True
        self._running = running
        self._pressure_pa, self._counter = math.nan, 0
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
            self.say(self._message())
            self._stream = asyncio.get_running_loop().call_later(_PERIOD_S, self._run)

    def line(self, text: str) -> None:
        """One command."""
        echo = f"{text}\r\n" if self._echo else ""
        answer = self._answer(text)
        prompt = ">" if self._echo else ""
        if whole := echo.encode("ascii", "replace") + answer + prompt.encode("ascii"):
            self.say(whole)

    def _answer(self, text: str) -> bytes:
        command, _, rest = text.partition(" ")
        if command.upper() == "SEND":
            return self._message()
        return self._words(command.upper(), rest).replace("\n", "\r\n").encode("ascii")

    def _words(self, command: str, rest: str) -> str:
        if command == "S":
            self._running = False
        elif command == "VERS":
            return f"{self._model} / 1.01\n"
        elif command == "?":
            return self._about()
        elif command == "ERRS":
            return "PASS\nNo errors\n" if "1" not in self.error_flags else "FAIL\nModule error\n"
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

    def _about(self) -> str:
        modules = "".join(f"Module {n}       : {'BARO-1' if n < 4 else 'EMPTY'}\n" for n in range(1, 5))
        return (
            f"{self._model} / 1.01\nSerial number  : {self.serial}\nBatch number   : B8901234\n"
            f"Output format  : {self._format}\nAdjust. date   : 2007-05-03\nAdjust. info   : VAISALA\n"
            "Date           : 2007-05-08\nTime           : 13:42:01\nStart mode     : STOP\n"
            f"Baud P D S     : {self.settings.baud} E 7 1\nOutput interval: 1 s\nAddress        : 0\n"
            f"Echo           : {'ON' if self._echo else 'OFF'}\n{modules}"
        )

    def _message(self) -> bytes:
        """Table 12 (page 71): number format before a quantity, quoted text as it is, the rest by name."""
        if not self.frozen:
            self._counter = int(asyncio.get_running_loop().time() / _PERIOD_S)
            self._pressure_pa = self._ambient_pressure_pa()
        text, digits, decimals = "", 4, 2
        for word in _WORD.findall(self._format):
            if number := re.fullmatch(r"(\d)\.(\d)", word):
                digits, decimals = int(number[1]), int(number[2])
            else:
                text += self._field(word, text, digits, decimals)
        return text.encode("ascii")

    def _field(self, word: str, so_far: str, digits: int, decimals: int) -> str:
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
