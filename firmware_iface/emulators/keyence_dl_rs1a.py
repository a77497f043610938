"""Emulator of Keyence laser amplifiers behind a DL-RS1A on its serial line."""

import math

from firmware_iface.emulators.serial_device import LineDevice, Sensor

_WRITABLE = ("001",)


class KeyenceDlRs1aEmulator(LineDevice):
    """One amplifier that measures the mirror, and others that measure nothing of interest.

    Parameters
    ----------
    displacement_um : callable
        Of the mirror's centre; NaN: the amplifier is in error.
    direction : int
        1 or -1: sign of the measured value over the displacement.
    baud, parity : int, str
        Of the line.
    amplifiers : int
        How many; the first one measures the mirror.

    Attributes
    ----------
    error_state : int
        Data number 033 of all amplifiers.
    zero_shift_mm : float
        Taken off the judgment value.
    """

    end = b"\r"

    def __init__(
        self,
        displacement_um: Sensor,
        direction: int = -1,
        baud: int = 9600,
        parity: str = "N",
        amplifiers: int = 1,
    ) -> None:
        super().__init__(baud, parity=parity)
        self.error_state = 0
        self.zero_shift_mm = 0.0
        self._displacement_um = displacement_um
        self._direction = direction
        self._amplifiers = amplifiers
        self._value_mm = math.nan

    def line(self, text: str) -> None:
        """One command."""
        if text:  # of CR LF, the LF is left over
            self.send_answer(self._answer(text).encode("ascii", "replace") + b"\r\n")

    def _answer(self, text: str) -> str:
        command, *parameters = text.split(",")
        if command == "M0":
            return "M0," + ",".join(self._judged(number) for number in range(self._amplifiers))
        if command not in ("SR", "SW"):
            return f"ER,{command[:2]},00"
        if len(parameters) != {"SR": 2, "SW": 3}[command]:
            return f"ER,{command},21"
        amplifier, number = parameters[:2]
        if not amplifier.isdigit() or int(amplifier) >= self._amplifiers:
            return f"ER,{command},65"
        if command == "SR":
            return self._read(amplifier, number)
        return self._write(amplifier, number, parameters[2])

    def _read(self, amplifier: str, number: str) -> str:
        values = {
            "033": f"{self.error_state:05d}",
            "037": self._judged(int(amplifier)),
            "038": _format_value(self._measured_mm(int(amplifier))),
        }
        if number not in values:
            return "ER,SR,22"
        return f"SR,{amplifier},{number},{values[number]}"

    def _write(self, amplifier: str, number: str, value: str) -> str:
        if number not in _WRITABLE or value not in ("0", "1"):
            return "ER,SW,22"
        if value == "1":
            self.zero_shift_mm = self._measured_mm(0)
        return f"SW,{amplifier},{number}"

    def _judged(self, amplifier: int) -> str:
        return _format_value(self._measured_mm(amplifier) - self.zero_shift_mm)

    def _measured_mm(self, amplifier: int) -> float:
        if amplifier:
            return 10.0 + amplifier
        if not self.frozen:
            self._value_mm = self._direction * self._displacement_um() / 1000
        return self._value_mm


def _format_value(value_mm: float) -> str:
    """Page 11: sign, two digits, three decimals; page 12 without a value."""
    if math.isnan(value_mm):
        return "+EE.EEE"
    return f"{max(-99.999, min(99.999, value_mm)):+07.3f}"
