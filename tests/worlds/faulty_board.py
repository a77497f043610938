"""The emulated pump board with faults that can be switched on."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

from firmware_iface.emulators import pump_board
from firmware_iface.emulators.modbus_pdu import exception_pdu
from firmware_iface.emulators.modbus_server import Answer
from firmware_iface.emulators.pump_board import BoardSample


@dataclass(slots=True)
class Faults:
    """Faults of the emulated board; each can be switched on and off while it runs."""

    silent: bool = False  # requests are executed but not answered
    delay_s: float = 0.0  # answers come this much later
    frozen: bool = False  # the sensor block stays as it was (counter and time too)
    no_displacement: bool = False  # the laser has no value
    exception_code: int = 0  # every request gets this Modbus exception and is not executed; 0: off
    map_version: int = 0  # the map version that the board reports; 0: the true one
    hang_up: bool = False  # the connection is dropped at every request
    # answers to reads have one register too few, in an otherwise correct frame
    short_reply: bool = False
    wrong_function: bool = False  # answers have function code 23 instead of 3, and 6 instead of 16
    wrong_transaction: bool = False  # answers carry another transaction id


class PumpBoardEmulator(pump_board.PumpBoardEmulator):
    """As `faults` says."""

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        self.faults = Faults()
        super().__init__(*arguments, **keywords)

    def newest(self) -> BoardSample:
        if self.faults.frozen:
            return self._sample
        sample = super().newest()
        return replace(sample, displacement_um=math.nan) if self.faults.no_displacement else sample

    def answer(self, pdu: bytes) -> Answer:
        faults = self.faults
        if faults.hang_up:
            return Answer(hang_up=True)
        if faults.exception_code:
            return Answer(exception_pdu(pdu, faults.exception_code), faults.delay_s)
        self.state.map_version = faults.map_version or self.state.registers.map_version
        reply = super().answer(pdu).pdu
        if faults.silent:
            return Answer()
        if faults.short_reply and reply[0] == 3:
            reply = bytes([3, reply[1] - 2]) + reply[2:-2]
        if faults.wrong_function:
            reply = bytes([{3: 23, 16: 6}.get(reply[0], reply[0])]) + reply[1:]
        return Answer(reply, faults.delay_s, transaction_offset=int(faults.wrong_transaction))
