"""A Ventus disc pump's driver board on its UART (TN003 Communications Guide)."""

import asyncio
import re

from firmware_iface.emulators.serial_device import Drive, LineDevice, Transmit

_COMMAND = re.compile(r"#(?:W(\d+),(-?\d+(?:\.\d+)?)|R(\d+))")
_READ_ONLY = (31, 36, 37, 38, 39)
_FLOATS = (23, 39)
# the vendor's defaults: enabled, driven by an analogue input
_DEFAULTS = {0: 1.0, 1: 1000.0, 2: 0.0, 10: 0.0, 11: 3.0, 23: 250.0, 31: 0.0, 36: 2.0, 37: 3.0, 38: 7.0, 39: 0.0}
_STREAM_PERIOD_S = 0.02


class VentusEmulator(LineDevice):
    """Drives gas: `drive` is called with the fraction of `power_max_mw` whenever it changes.

    `streaming`: it was left streaming.
    """

    def __init__(
        self,
        drive: Drive,
        power_max_mw: float = 1000.0,
        streaming: bool = False,
    ) -> None:
        super().__init__(115_200)
        self.registers = dict(_DEFAULTS)
        self.registers[2] = float(streaming)
        self._drive = drive
        self._power_max_mw = power_max_mw
        self._driven = -1.0
        self._stream: asyncio.TimerHandle | None = None

    def attach(self, transmit: Transmit) -> None:
        """The wire is plugged in."""
        super().attach(transmit)
        self._act()

    def detach(self) -> None:
        """The wire is pulled: the pump runs on."""
        if self._stream is not None:
            self._stream.cancel()
            self._stream = None
        super().detach()

    def restart(self) -> None:
        """Back to the stored settings."""
        super().restart()
        self.registers = dict(_DEFAULTS)
        self._act()

    def line(self, text: str) -> None:
        """One command; anything else is ignored."""
        found = _COMMAND.fullmatch(text)
        if found is None:
            return
        if found[3] is not None:
            self._read(int(found[3]))
        elif (number := int(found[1])) in self.registers and number not in _READ_ONLY:
            self.registers[number] = float(found[2])
            self._act()

    def _read(self, number: int) -> None:
        if number in self.registers:
            value = self.registers[number]
            text = f"{value:.3f}" if number in _FLOATS else f"{value:.0f}"
            self.say(f"#R{number},{text}\n".encode("ascii"))

    def _act(self) -> None:
        fraction = min(max(self._power_mw() / self._power_max_mw, 0.0), 1.0)
        if fraction != self._driven:
            self._driven = fraction
            self._drive(fraction)
        if self.registers[2] and self._stream is None and self._transmit is not None:
            self._stream = asyncio.get_running_loop().call_later(_STREAM_PERIOD_S, self._say_state)

    def _power_mw(self) -> float:
        # manual mode from SetVal is the only one with a known power; the analogue input is open, at zero
        manual = self.registers[0] and not self.registers[10] and not self.registers[11]
        return min(self.registers[23], self.registers[1]) if manual else 0.0

    def _say_state(self) -> None:
        self._stream = None
        if self.registers[2]:
            self.say(f"#S{self.registers[0]:.0f},0.000,0.000,21000,0.000,0.000,0.000,0.000\n".encode("ascii"))
            self._act()
