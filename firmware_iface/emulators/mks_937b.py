"""An MKS 937B or 946 with a capacitance manometer on one channel (937B manual page 86, 946 manual page 103)."""

import math

from firmware_iface.emulators.serial_device import LineDevice, Sensor

_SYNTAX, _ARGUMENT = "160", "169"
_PASCALS = {"TORR": 133.322368, "MBAR": 100.0, "PASCAL": 1.0, "MICRON": 0.133322368}


class Mks937bEmulator(LineDevice):
    """Measures the gauge pressure in Pa (NaN: over range); `unit` is what its front panel shows."""

    end = b";FF"

    def __init__(
        self, gauge_pa: Sensor, baud: int = 115_200, parity: str = "N", address: int = 253, channel: int = 1
    ):
        super().__init__(baud, parity=parity)
        self.model, self.serial, self.unit = "937B", "0123456789", "TORR"
        self.sensors = ["NG"] * 6
        self.sensors[channel - 1] = "CM"
        self.locked = False  # parameter setting disabled at the front panel
        self._gauge_pa, self._address = gauge_pa, address
        self._held = ""

    def line(self, text: str) -> None:
        """One command, if it has this controller's address."""
        head, command = text[:4], text[4:]
        if head == f"@{self._address:03d}":
            self.say(f"{head}{self._answer(command)};FF".encode("ascii"))

    def _answer(self, command: str) -> str:
        if command.startswith("U!"):
            if self.locked or command[2:].upper() not in _PASCALS:
                return f"NAK{_ARGUMENT}"
            self.unit = command[2:].upper()
            return f"ACK{self.unit}"
        told = self._told(command[:-1]) if command.endswith("?") else None
        return f"NAK{_SYNTAX}" if told is None else f"ACK{told}"

    def _told(self, name: str) -> str | None:
        if len(name) == 3 and name[:2] == "ST" and name[2] in "ABC":
            first = 2 * "ABC".index(name[2])
            return "".join(self.sensors[first : first + 2])
        if len(name) == 3 and name[:2] == "PR" and name[2] in "123456":
            return self._pressure(self.sensors[int(name[2]) - 1])
        return {"MD": self.model, "SN": self.serial, "FV6": "1.27", "U": self.unit}.get(name)

    def _pressure(self, sensor: str) -> str:
        if sensor != "CM":
            return "NOGAUGE!"
        if not self.frozen:
            value = self._gauge_pa() / _PASCALS[self.unit]
            mantissa, _, exponent = f"{value:.3E}".partition("E")
            self._held = "OVER" if math.isnan(value) else f"{mantissa}E{int(exponent):+d}"
        return self._held
