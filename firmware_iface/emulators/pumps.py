"""Emulators of what drives gas, over any plant.

Ventus disc pump's driver board on its UART: TN003 Communications Guide. Bronkhorst EL-FLOW and
EL-PRESS, as Modbus registers or as a ProPar device on a serial line.
"""

import asyncio
import math
import re
import struct
from collections.abc import Callable, Sequence

from firmware_iface.drivers import (
    bronkhorst,
    bronkhorst_modbus,
    bronkhorst_parameter,
    bronkhorst_propar,
)
from firmware_iface.emulators import modbus_pdu, serial_device
from firmware_iface.emulators.serial_device import Drive, LineDevice, Transmit
from firmware_iface.links.serial_port import SerialSettings

_COMMAND = re.compile(r"#(?:W(\d+),(-?\d+(?:\.\d+)?)|R(\d+))")
_VENTUS_READ_ONLY = (31, 36, 37, 38, 39)
_FLOATS = (23, 39)
# the vendor's defaults: enabled, driven by an analogue input
_DEFAULTS = {
    0: 1.0,
    1: 1000.0,
    2: 0.0,
    10: 0.0,
    11: 3.0,
    23: 250.0,
    31: 0.0,
    36: 2.0,
    37: 3.0,
    38: 7.0,
    39: 0.0,
}
_STREAM_PERIOD_S = 0.02
ANALOG_INPUT = 1  # control mode after power-up: not the bus
_COUNTS_MAX = 41_942
_NODE_ANY = 128
_PARAMETER_ERROR = 4
_TYPE_ERROR = 5
_VALUE_ERROR = 6
_COMMAND_ERROR = 2
_READ_ONLY = 13
_BY_PLACE = {(parameter.process, parameter.number): parameter for parameter in bronkhorst.ALL}
_FORMATS = {"u8": ">B", "u16": ">H", "f32": ">f"}
_TYPES = {"u8": 0x00, "u16": 0x20, "f32": 0x40, "text": 0x60}
WRITABLE = (bronkhorst.SETPOINT, bronkhorst.FSETPOINT, bronkhorst.CONTROL_MODE)
_BUFFER_BYTES_MAX = 4096  # of messages that have not ended


class VentusEmulator(LineDevice):
    """Drives gas.

    Parameters
    ----------
    drive : callable
        Gets the power as a fraction of `power_max_mw`, 0..1, whenever it changes.
    power_max_mw : float
        Power of full drive, as the driver is configured.
    streaming : bool
        Whether an earlier program left it streaming.
    """

    def __init__(self, drive: Drive, power_max_mw: float = 1000.0, streaming: bool = False) -> None:
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
        self._set_flow()

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
        self._set_flow()

    def line(self, text: str) -> None:
        """One command; anything else is ignored."""
        found = _COMMAND.fullmatch(text)
        if found is None:
            return
        if found[3] is not None:
            self._read(int(found[3]))
        elif (number := int(found[1])) in self.registers and number not in _VENTUS_READ_ONLY:
            self.registers[number] = float(found[2])
            self._set_flow()

    def _read(self, number: int) -> None:
        if number in self.registers:
            value = self.registers[number]
            text = f"{value:.3f}" if number in _FLOATS else f"{value:.0f}"
            self.send_answer(f"#R{number},{text}\n".encode("ascii"))

    def _set_flow(self) -> None:
        fraction = min(max(self._power_mw() / self._power_max_mw, 0.0), 1.0)
        if fraction != self._driven:
            self._driven = fraction
            self._drive(fraction)
        if self.registers[2] and self._stream is None and self._transmit is not None:
            self._stream = asyncio.get_running_loop().call_later(_STREAM_PERIOD_S, self._send_state)

    def _power_mw(self) -> float:
        # manual mode from SetVal is the only one with a known power; the analogue input is open, at
        # zero
        manual = self.registers[0] and not self.registers[10] and not self.registers[11]
        if not manual:
            return 0.0
        return min(self.registers[23], self.registers[1])

    def _send_state(self) -> None:
        self._stream = None
        if self.registers[2]:
            self.send_answer(
                f"#S{self.registers[0]:.0f},0.000,0.000,21000,0.000,0.000,0.000,0.000\n".encode(
                    "ascii"
                )
            )
            self._set_flow()


class Instrument:
    """The instrument behind its interfaces.

    Parameters
    ----------
    device_type : str
        "DMFC" (EL-FLOW) or "DEPC" (EL-PRESS).
    serial : str
        Serial number.
    capacity : float
        100 %, in `unit`.
    unit : str
        Such as "mln/min" or "mbar(g)".
    measured : callable or None
        The sensor's value in `unit`; None: a flow controller that measures its own setpoint.
    actuate : callable or None
        Gets the flow over the capacity, 0..1, whenever it changes.
    """

    def __init__(
        self,
        device_type: str,
        serial: str,
        capacity: float,
        unit: str,
        measured: Callable[[], float] | None = None,
        actuate: Callable[[float], None] | None = None,
    ) -> None:
        self._texts = {
            bronkhorst.DEVICE_TYPE: device_type,
            bronkhorst.SERIAL_NUMBER: serial,
            bronkhorst.CAPACITY_UNIT: unit,
            bronkhorst.FIRMWARE: "V1.10",
        }
        self._capacity = capacity
        self._measured = measured
        self._actuate = actuate
        self.restart()

    def restart(self) -> None:
        """Power-up: valve closed, and the setpoint from the analog input again."""
        self._settings = {bronkhorst.SETPOINT: 0, bronkhorst.CONTROL_MODE: ANALOG_INPUT}
        self._drive()

    @property
    def fraction(self) -> float:
        """Present flow over the capacity."""
        if self._settings[bronkhorst.CONTROL_MODE] != bronkhorst.BUS_SETPOINT:
            return 0.0
        return self._settings[bronkhorst.SETPOINT] / bronkhorst.FULL_SCALE

    def _drive(self) -> None:
        if self._actuate is not None:
            self._actuate(self.fraction)

    def raw(self, parameter: bronkhorst_parameter.InstrumentParameter) -> bytes:
        """A parameter as bytes, big end first; a text has its full length."""
        if parameter.kind == "text":
            return self._texts[parameter].encode().ljust(parameter.chars, b"\0")[: parameter.chars]
        return struct.pack(_FORMATS[parameter.kind], self._read_parameter(parameter))

    def _read_parameter(self, parameter: bronkhorst_parameter.InstrumentParameter) -> float:
        # `measure` is a signed number in 16 bits: below zero down to what is left above the largest
        # count (manual 9.17.023, "measure").
        if parameter in self._settings:
            return self._settings[parameter]
        if self._measured is None:
            measured = self.fraction * self._capacity
        else:
            measured = self._measured()
        counts = round(measured / self._capacity * bronkhorst.FULL_SCALE)
        return {
            bronkhorst.MEASURE: min(max(counts, _COUNTS_MAX - 0x10000 + 1), _COUNTS_MAX) % 0x10000,
            bronkhorst.FMEASURE: measured,
            bronkhorst.FSETPOINT: self._settings[bronkhorst.SETPOINT]
            / bronkhorst.FULL_SCALE
            * self._capacity,
            bronkhorst.CAPACITY: self._capacity,
            bronkhorst.TEMPERATURE: 20.0,
        }[parameter]

    def write(self, parameter: bronkhorst_parameter.InstrumentParameter, raw: bytes) -> bool:
        """Store a setting.

        Parameters
        ----------
        parameter : InstrumentParameter
            One of `WRITABLE`; `fsetpoint` sets the same as `setpoint`, in the capacity's unit.
        raw : bytes
            Its value, big end first, as long as its kind.

        Returns
        -------
        bool
            False if the value is impossible: nothing is stored.
        """
        if parameter == bronkhorst.FSETPOINT:
            parameter = bronkhorst.SETPOINT
            (flow,) = struct.unpack(">f", raw)
            if not math.isfinite(flow):
                return False
            value = round(flow / self._capacity * bronkhorst.FULL_SCALE)
        else:
            (value,) = struct.unpack(_FORMATS[parameter.kind], raw)
        most = bronkhorst.FULL_SCALE if parameter == bronkhorst.SETPOINT else 255
        if not 0 <= value <= most:
            return False
        self._settings[parameter] = value
        self._drive()
        return True


class BronkhorstRegisters:
    """The instrument as Modbus registers: a `RegisterTable` for any server."""

    def __init__(self, instrument: Instrument) -> None:
        self._instrument = instrument

    def read(self, address: int, count: int) -> list[int]:
        """Words of one instant. Raises RegisterRefusal if a register does not exist.

        Parameters
        ----------
        address : int
            First register on the wire, from 0.
        count : int
            Registers; they may span several parameters.
        """
        # Only the parameters that the span touches: each read asks the instrument.
        words: dict[int, int] = {}
        for parameter in bronkhorst.ALL:
            first, length = bronkhorst_modbus.register_of(parameter)
            if first < address + count and address < first + length:
                raw = self._instrument.raw(parameter).rjust(2, b"\0")
                raw += b"\0" * (2 * length - len(raw))
                words.update(enumerate(struct.unpack(f">{length}H", raw), first))
        try:
            return [words[at] for at in range(address, address + count)]
        except KeyError:
            raise modbus_pdu.RegisterRefusal(modbus_pdu.ILLEGAL_ADDRESS) from None

    def write(self, address: int, words: Sequence[int]) -> None:
        """Write one parameter. Raises RegisterRefusal.

        Parameters
        ----------
        address : int
            First register of the parameter, on the wire, from 0.
        words : sequence of int
            All its registers, unsigned 16 bit; a part of a parameter is an illegal address.
        """
        for parameter in WRITABLE:
            if bronkhorst_modbus.register_of(parameter) == (address, len(words)):
                raw = struct.pack(f">{len(words)}H", *words)
                if parameter.kind == "u8" and raw[0]:
                    raise modbus_pdu.RegisterRefusal(modbus_pdu.ILLEGAL_VALUE)
                if parameter.kind == "u8":
                    raw = raw[1:]
                if not self._instrument.write(parameter, raw):
                    raise modbus_pdu.RegisterRefusal(modbus_pdu.ILLEGAL_VALUE)
                return
        raise modbus_pdu.RegisterRefusal(modbus_pdu.ILLEGAL_ADDRESS)


class ProparDevice(serial_device.SerialDevice):
    """The instrument on a serial line; answers in the form of the question, binary or ASCII.

    Parameters
    ----------
    instrument : Instrument
        What it answers for.
    settings : SerialSettings
        Of the line.
    node : int
        Its address; it also answers to 128, which is any.
    """

    def __init__(self, instrument: Instrument, settings: SerialSettings, node: int = 3) -> None:
        super().__init__(settings)
        self.instrument = instrument
        self._node = node
        self._buffer = b""

    def restart(self) -> None:
        """Power-up."""
        self._buffer = b""
        self.instrument.restart()

    def received(self, data: bytes) -> None:
        """Answer every whole message."""
        self._buffer = (self._buffer + data)[-_BUFFER_BYTES_MAX:]
        if b"\x10\x02" in self._buffer:
            messages, self._buffer = bronkhorst_propar.split_binary(self._buffer)
            for message in messages:
                self._handle_frame(message, bronkhorst_propar.binary_frame)
        while b"\r\n" in self._buffer:
            line, self._buffer = self._buffer.split(b"\r\n", 1)
            ascii_message = bronkhorst_propar.parse_ascii(line)
            if ascii_message is not None:
                self._handle_frame(ascii_message, bronkhorst_propar.ascii_frame)

    def _handle_frame(
        self,
        message: bronkhorst_propar.ProparMessage,
        frame: Callable[[bronkhorst_propar.ProparMessage], bytes],
    ) -> None:
        if message.node not in (self._node, _NODE_ANY):
            return
        try:
            answer = self._answer(message.data)
        except (ValueError, IndexError):
            answer = bytes([bronkhorst_propar.STATUS, _COMMAND_ERROR, 0])
        if answer:
            self.send_answer(
                frame(bronkhorst_propar.ProparMessage(message.sequence, message.node, answer))
            )

    def _answer(self, data: bytes) -> bytes:
        if data[0] == bronkhorst_propar.REQUEST:
            return self._answer_request(data)
        if data[0] in (bronkhorst_propar.WRITE, bronkhorst_propar.VALUES):
            status = self._write_parameters(data)
            if data[0] != bronkhorst_propar.WRITE:
                return b""
            return bytes([bronkhorst_propar.STATUS, status, len(data)])
        return bytes([bronkhorst_propar.STATUS, _COMMAND_ERROR, 0])

    def _write_parameters(self, data: bytes) -> int:
        for process, number, raw in bronkhorst_propar.parse_values(data):
            parameter = _BY_PLACE.get((process, number))
            if parameter is None:
                return _PARAMETER_ERROR
            if parameter not in WRITABLE:
                return _READ_ONLY
            if len(raw) != struct.calcsize(_FORMATS[parameter.kind]):
                return _TYPE_ERROR
            if not self.instrument.write(parameter, raw):
                return _VALUE_ERROR
        return 0

    def _answer_request(self, data: bytes) -> bytes:
        """The answer to a request: each value under the indices that the request gave it."""
        answer, at, chained = bytearray([bronkhorst_propar.VALUES]), 1, False
        while at < len(data):
            # A process's index precedes its first parameter; the highest bit of a parameter's index
            # announces another one of the same process.
            if not chained:
                answer.append(data[at])
                at += 1
            index, process, requested = data[at], data[at + 1], data[at + 2]
            chained, kind = bool(index & 0x80), requested & 0x60
            at += 3
            parameter = _BY_PLACE.get((process, requested & 0x1F))
            if parameter is None:
                return bytes([bronkhorst_propar.STATUS, _PARAMETER_ERROR, at])
            if kind != _TYPES[parameter.kind]:
                return bytes([bronkhorst_propar.STATUS, _TYPE_ERROR, at])
            answer.append(index)
            raw = self.instrument.raw(parameter)
            # Texts have a length: 0 asks for one that ends with a zero byte.
            if kind == 0x60:
                length, at = data[at], at + 1
                if length == 0:
                    raw = raw.rstrip(b"\0") + b"\0"
                else:
                    raw = raw.ljust(length, b" ")[:length]
                answer.append(length)
            answer += raw
        return bytes(answer)
