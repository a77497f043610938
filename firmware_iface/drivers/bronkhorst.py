"""Bronkhorst EL-FLOW and EL-PRESS, whichever protocol they speak.

Parameters have a process and a number; Modbus and ProPar are two ways to reach them. Sources:
manual 9.17.027 (RS232 interface, ProPar), 9.17.035 (Modbus slave interface, section 4.4.6:
parameters), 9.17.023 (meaning of parameters).
"""

import contextlib
import math
from dataclasses import replace
from typing import Protocol

from firmware_iface.drivers.bronkhorst_parameter import InstrumentParameter
from firmware_iface.roles import DeviceIdentity, DeviceRefusedError, LinkDownError, LinkError

FULL_SCALE = 32_000  # of measure and setpoint: 100 %
BUS_SETPOINT = 0  # control mode: the setpoint comes over the interface
# device type (113, 1) of an EL-FLOW, and of its sister for liquids
FLOW_CONTROLLERS = (
    "DMFC",
    "DLFC",
)
PRESSURE_INSTRUMENTS = ("DEPC", "DEPM")  # EL-PRESS controller and meter
# a pressure "(a)" against vacuum would be 1e5 Pa off
_GAUGE_UNITS_PA = {
    "bar(g)": 1e5,
    "mbar(g)": 1e2,
    "bar(d)": 1e5,
    "mbar(d)": 1e2,
    "kPa(g)": 1e3,
    "kPa(d)": 1e3,
    "Pa(g)": 1.0,
    "Pa(d)": 1.0,
}


MEASURE = InstrumentParameter("measure", 1, 0, "u16")
SETPOINT = InstrumentParameter("setpoint", 1, 1, "u16")
CONTROL_MODE = InstrumentParameter("control mode", 1, 4, "u8")
CAPACITY = InstrumentParameter("capacity", 1, 13, "f32")
CAPACITY_UNIT = InstrumentParameter("capacity unit", 1, 31, "text", 7)
FMEASURE = InstrumentParameter("fmeasure", 33, 0, "f32")
FSETPOINT = InstrumentParameter("fsetpoint", 33, 3, "f32")
TEMPERATURE = InstrumentParameter("temperature", 33, 7, "f32")
DEVICE_TYPE = InstrumentParameter("device type", 113, 1, "text", 6)
SERIAL_NUMBER = InstrumentParameter("serial number", 113, 3, "text", 16)
FIRMWARE = InstrumentParameter("firmware version", 113, 5, "text", 5)
ALL = (
    *(MEASURE, SETPOINT, CONTROL_MODE, CAPACITY, CAPACITY_UNIT),
    *(FMEASURE, FSETPOINT, TEMPERATURE, DEVICE_TYPE, SERIAL_NUMBER, FIRMWARE),
)


class ParameterPort(Protocol):
    """Parameters of one instrument over some protocol. All raise LinkError kinds."""

    @property
    def name(self) -> str:
        """For messages."""

    async def connect(self) -> None:
        """Connect, unless that is done."""

    async def number(self, parameter: InstrumentParameter) -> float:
        """Read a number in a way that detects flipped bits."""

    async def text(self, parameter: InstrumentParameter) -> str:
        """A text."""

    async def write(self, parameter: InstrumentParameter, value: int) -> None:
        """Write, and verify that the instrument has it.

        Parameters
        ----------
        parameter : InstrumentParameter
            One of kind `u8` or `u16`.
        value : int
            In the instrument's counts: for a setpoint, 32000 is 100 % of the capacity.
        """

    async def close(self) -> None:
        """Disconnect. Never raises."""

    def describe(self) -> dict[str, str]:
        """Port, settings, manual."""


async def identify(port: ParameterPort, types: tuple[str, ...], serial: str) -> DeviceIdentity:
    """Connect and identify an instrument.

    Parameters
    ----------
    port : ParameterPort
        Its parameters, over either protocol.
    types : tuple of str
        Expected device types.
    serial : str
        Expected serial number; empty for any.

    Returns
    -------
    DeviceIdentity

    Raises
    ------
    DeviceRefusedError
        Another type of instrument, or another serial number.
    """
    # Type and serial number before anything else: the meaning of the other parameters, and whether
    # they may be written, follows from them.
    await port.connect()
    found = await port.text(DEVICE_TYPE)
    number = await port.text(SERIAL_NUMBER)
    if found not in types:
        raise DeviceRefusedError(
            f"{port.name}: a {found or 'nameless device'} answers, expected {' or '.join(types)}"
        )
    if serial and number != serial:
        raise DeviceRefusedError(
            f"{port.name}: serial number {number} answers, but the configuration names {serial}"
        )
    firmware = await port.text(FIRMWARE)
    capacity = await port.number(CAPACITY)
    unit = await port.text(CAPACITY_UNIT)
    if not (math.isfinite(capacity) and capacity > 0):
        raise DeviceRefusedError(
            f"{port.name}: capacity {capacity:g} {unit}; the instrument is not set up"
        )
    return DeviceIdentity(f"Bronkhorst {found}", number, firmware, f"0 .. {capacity:g} {unit}")


class BronkhorstFlow:
    """An EL-FLOW as the pump: fraction 1 is its capacity.

    It has no watchdog: without a host it continues with its last setpoint.

    Parameters
    ----------
    port : ParameterPort
        Its parameters, over Modbus or ProPar.
    serial : str
        Serial number of the only instrument that is accepted; empty: any.
    """

    def __init__(self, port: ParameterPort, serial: str = "") -> None:
        self._port = port
        self._serial = serial

    async def open(self) -> DeviceIdentity:
        """Identify it, close its valve, take the control mode "bus". Raises LinkError,
        DeviceRefusedError.
        """
        identity = await identify(self._port, FLOW_CONTROLLERS, self._serial)
        # The setpoint first: in the mode "bus" the valve follows it at once, and the instrument may
        # still have the one of an earlier program.
        await self._port.write(SETPOINT, 0)
        await self._port.write(CONTROL_MODE, BUS_SETPOINT)
        mode = await self._port.number(CONTROL_MODE)
        if mode != BUS_SETPOINT:
            raise DeviceRefusedError(
                f"{self._port.name}: control mode stays {mode:g}, expected {BUS_SETPOINT}"
            )
        return identity

    async def set_pump(self, fraction: float) -> None:
        """Set the flow, 0..1 of the capacity. Raises LinkError, and ValueError outside 0..1."""
        if not 0.0 <= fraction <= 1.0:
            raise ValueError(f"pump fraction {fraction} is not within 0..1")
        await self._port.write(SETPOINT, round(fraction * FULL_SCALE))

    async def pump_fraction(self) -> float:
        """The setpoint that the instrument has. Raises LinkError."""
        return await self._port.number(SETPOINT) / FULL_SCALE

    async def close(self) -> None:
        """Close the valve and disconnect. Never raises."""
        # out of reach: it keeps its last setpoint (see the class)
        with contextlib.suppress(LinkError):
            await self._port.write(SETPOINT, 0)
        await self._port.close()

    def describe(self) -> dict[str, str]:
        """Port, settings, manual."""
        return {
            **self._port.describe(),
            "watchdog": "none of its own: keeps its last setpoint without a host",
        }


class BronkhorstPressure:
    """An EL-PRESS as the gauge pressure sensor.

    Parameters
    ----------
    port : ParameterPort
        Its parameters, over Modbus or ProPar.
    serial : str
        Serial number of the only instrument that is accepted; empty: any.
    """

    # slightly below zero (noise), above full scale up to the sensor's limit (131.07 % of 32000 is
    # 41942)
    _FRACTIONS = (-0.1, 1.3107)

    def __init__(self, port: ParameterPort, serial: str = "") -> None:
        self._port = port
        self._serial = serial
        self._full_pa = math.nan
        self._unit_pa = math.nan

    async def open(self) -> DeviceIdentity:
        """Identify it and learn its unit. Raises LinkError, DeviceRefusedError."""
        identity = await identify(self._port, PRESSURE_INSTRUMENTS, self._serial)
        unit = await self._port.text(CAPACITY_UNIT)
        if unit not in _GAUGE_UNITS_PA:
            raise DeviceRefusedError(
                f"{self._port.name}: its unit is {unit!r}; set it to a gauge pressure, for "
                "example mbar(g)"
            )
        self._unit_pa = _GAUGE_UNITS_PA[unit]
        self._full_pa = await self._port.number(CAPACITY) * self._unit_pa
        low, high = self._FRACTIONS
        return replace(identity, shows=(low * self._full_pa, high * self._full_pa))

    async def gauge_pressure_pa(self) -> float:
        """The measured value. Raises LinkError, also for impossible values."""
        value_pa = await self._port.number(FMEASURE) * self._unit_pa
        low, high = self._FRACTIONS
        if math.isnan(self._full_pa):
            raise LinkDownError(f"{self._port.name}: not open")
        if not low * self._full_pa <= value_pa <= high * self._full_pa:
            raise LinkError(
                f"{self._port.name}: {value_pa:g} Pa is not within its range of "
                f"{self._full_pa:g} Pa"
            )
        return value_pa

    async def close(self) -> None:
        """Disconnect. Never raises."""
        await self._port.close()

    def describe(self) -> dict[str, str]:
        """Port, settings, manual."""
        return self._port.describe()
