"""The controller's interface to sensors and actuators: the roles, and the values exchanged.

A driver converts to these units; nothing beyond it knows registers, counts or byte orders. These
drivers run in the tick and are awaited. `optical_roles` has cameras and displays.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Protocol

Clock = Callable[[], float]  # seconds on any monotonic axis

# The mask of `Bench.clear_faults` that clears all latches
ALL_FAULTS = 0xFFFF
_ROLE = "role"
# `BenchReading.displacement_quality` when the sensor itself does not answer; no instrument's code
NO_ANSWER = 0xFFFF
# bits of `BenchReading.foreign`
FOREIGN_CLAIM, FOREIGN_PERIOD = 1, 2
ACTUATORS = ("pump", "vent")


class LinkError(Exception):
    """A device gave no valid answer. The message states what, where and what to do."""


class LinkDownError(LinkError):
    """The connection is gone (not merely one late or bad answer)."""


class LinkWaitsError(LinkDownError):
    """Too early for the next attempt to connect; the last failure was already reported."""


class DeviceRefusedError(LinkError):
    """The device is reachable but not usable: wrong kind, unknown map version, refused write."""


class DeviceBusyError(LinkError):
    """Another program holds the device, or the device is busy; it may be free later.

    Parameters
    ----------
    message : str
        One line for people.
    lapses_in_s : float
        Time until the other's claim ends unless its watchdog is fed; 0 if unknown.
    """

    def __init__(self, message: str, lapses_in_s: float = 0.0) -> None:
        super().__init__(message)
        self.lapses_in_s = lapses_in_s


@dataclass(frozen=True, slots=True)
class Role:
    """What a device is for: a table `[devices.<name>]` of the configuration.

    Attributes
    ----------
    name : str
        As in the configuration and in messages.
    reads : str
        The driver's method that is asked in every tick. Of a sensor also the quantity that it
        measures: a simulated mirror has an attribute of this name.
    unit : str
        Of the answer.
    needed : bool
        Whether gas may move only with such a device.
    """

    name: str
    reads: str
    unit: str
    needed: bool = False


def _declare_sensor(name: str, reads: str, unit: str, needed: bool = False) -> dict[str, Role]:
    """Return the metadata of a field of `BenchReading` that the sensor of a role fills. Parameters:
    see `Role`.
    """
    return {_ROLE: Role(name, reads, unit, needed)}


@dataclass(frozen=True, slots=True)
class BenchReading:
    """One consistent sample of all sensors.

    A field with a role is filled by the sensor of that role. To add a sensor role, add a field with
    its role here, a row of the same name to the table of telemetry columns, and a rule that uses
    it: configuration, bench, record, check, wizard and emulated lab follow. An instrument of a new
    quantity also needs a contract below and its drivers in `settings.SENSOR_DRIVERS`.

    `sample_counter` and `device_time_s` advance with every sample of the device, to reveal frozen
    values. Quantities the bench lacks are NaN. `displacement_quality` is 0 when good (else the
    laser's error code). `foreign` shows which of claim and watchdog another program has changed
    (FOREIGN_ bits). Bit i of `interlocks_open` is set while the circuit of the configuration's
    interlock i is open, or its signal is lost.
    """

    displacement_um: float
    displacement_quality: int
    gauge_pressure_pa: float = field(
        metadata=_declare_sensor("gauge_pressure", "gauge_pressure_pa", "Pa", needed=True)
    )
    ambient_pressure_pa: float = field(
        metadata=_declare_sensor("barometer", "ambient_pressure_pa", "Pa")
    )
    air_temperature_c: float = field(
        metadata=_declare_sensor("thermometer", "air_temperature_c", "°C")
    )
    gas_temperature_c: float
    pump_fraction: float
    vent_fraction: float
    sample_counter: int
    device_time_s: float
    watchdog_tripped: bool
    latched_faults: int
    foreign: int = 0
    # bit i: the board's interlock input i is closed; 0 without inputs: all open
    interlock_inputs: int = 0
    interlocks_open: int = 0
    film_temperature_c: float = field(
        default=math.nan,
        metadata=_declare_sensor("film_thermometer", "film_temperature_c", "°C"),
    )
    ring_temperature_c: float = field(
        default=math.nan,
        metadata=_declare_sensor("ring_thermometer", "ring_temperature_c", "°C"),
    )
    humidity_percent: float = field(
        default=math.nan, metadata=_declare_sensor("hygrometer", "humidity_percent", "%")
    )


# For a tick without an answer; its integers, which have no NaN, are unused.
NO_READING = BenchReading(
    displacement_um=math.nan,
    displacement_quality=0,
    gauge_pressure_pa=math.nan,
    ambient_pressure_pa=math.nan,
    air_temperature_c=math.nan,
    gas_temperature_c=math.nan,
    pump_fraction=math.nan,
    vent_fraction=math.nan,
    sample_counter=0,
    device_time_s=math.nan,
    watchdog_tripped=False,
    latched_faults=0,
)

# Roles of sensors that give one value a tick, by the field of `BenchReading`.
SENSORS: dict[str, Role] = {
    each.name: each.metadata[_ROLE] for each in fields(BenchReading) if each.metadata
}
# All roles in the order in which a person is asked for their devices: first those that every bench
# needs.
ROLES: dict[str, Role] = {
    role.name: role
    for role in (
        Role("displacement", "displacement", "µm", needed=True),
        Role("pump", "pump_fraction", "of full scale", needed=True),
        *(role for role in SENSORS.values() if role.needed),
        Role("vent", "vent_fraction", "of full scale"),
        *(role for role in SENSORS.values() if not role.needed),
    )
}


@dataclass(frozen=True, slots=True)
class BenchCommand:
    """What a completed tick writes; the write also feeds the device's watchdog."""

    pump_fraction: float
    vent_fraction: float


@dataclass(frozen=True, slots=True)
class BenchIdentity:
    """Identity of a bench, its watchdog period as read back, and its limits (infinite: unknown)."""

    kind: str
    map_version: int
    firmware: str
    watchdog_s: float
    gauge_pressure_limit_pa: float = math.inf  # the board's own limit
    pump_limit_fraction: float = 1.0
    displacement_range_um: tuple[float, float] = (-math.inf, math.inf)  # range of the sensor
    gauge_range_pa: tuple[float, float] = (-math.inf, math.inf)
    gauge_fitted: bool = True  # False: the board has no gauge, and so no over-pressure protection
    # the board itself stops the pump this long after its gauge fails
    gauge_timeout_s: float = math.inf
    # bit i: the board itself stops the pump when interlock input i opens
    interlocks_fitted: int = 0


@dataclass(frozen=True, slots=True)
class LinkState:
    """State of the links to a bench's single devices; empty for a bench of one device.

    Attributes
    ----------
    silent : tuple of (str, str)
        Role of each sensor that gave no valid answer to the last reading, and why, for people.
    slowest : str
        Role of the device that answered the last reading last.
    """

    silent: tuple[tuple[str, str], ...] = ()
    slowest: str = ""


NO_LINK_STATE = LinkState()


class Bench(Protocol):
    """Displacement sensor, pressure sensors, thermometers, pump and vent, however many devices fill
    the roles.
    """

    async def open(self) -> BenchIdentity:
        """Connect, check the identity, arm the watchdog and read it back. Raises LinkError."""

    async def read(self) -> BenchReading:
        """One sample. Raises LinkError; never returns an old or invented value."""

    async def write(self, command: BenchCommand) -> None:
        """Write pump and vent, and feed the watchdog. Raises LinkError."""

    async def clear_faults(self, mask: int) -> None:
        """Clear these latched bits of the devices, and no others. Raises LinkError.

        All (`ALL_FAULTS`) only at a person's request.
        """

    def dead_guards(self) -> tuple[str, ...]:
        """Names of this bench's guards that no longer run; checked in every tick."""

    def link_state(self) -> LinkState:
        """How the single devices answered the last reading."""

    async def close(self) -> None:
        """Close the link; the caller has written the safe state before. Never raises."""


@dataclass(frozen=True, slots=True)
class DeviceIdentity:
    """Identity of a device: kind ("optoNCDT 1420"), serial number and firmware as reported.

    `shows` is the range of a sensor in its role's unit, infinite if unknown to the driver.
    """

    kind: str
    serial: str
    firmware: str
    detail: str = ""
    shows: tuple[float, float] = (-math.inf, math.inf)


@dataclass(frozen=True, slots=True)
class DisplacementSample:
    """The newest sample; for a streaming sensor the median of all values since the last one.

    `quality` is 0 when good, else the device's error code, and then `displacement_um` is NaN.
    Counter and time advance only with new data; the driver provides them if the device has none
    (valid messages so far, time of arrival).
    """

    displacement_um: float
    quality: int
    sample_counter: int
    device_time_s: float


class Device(Protocol):
    """One instrument; it fills one role or several.

    A task of the driver refreshes quantities slower than the tick (a barometer at 4800 baud); the
    driver returns the newest value, or NaN once it is older than a stated limit.
    """

    async def open(self) -> DeviceIdentity:
        """Connect, check the identity, apply the settings and read them back; again after every
        lost link.

        Raises LinkError (no valid answer; LinkDownError without a connection), DeviceRefusedError
        (not the configured device, or one that does not accept its settings).
        """

    async def close(self) -> None:
        """Leave the device safe and close the link. Never raises."""

    def describe(self) -> dict[str, str]:
        """For people: port, settings, manual."""


class DisplacementSensor(Device, Protocol):
    """The laser behind the mirror."""

    async def displacement(self) -> DisplacementSample:
        """The newest sample. Raises LinkError."""


class PressureSensor(Device, Protocol):
    """Gas between the films against the room."""

    async def gauge_pressure_pa(self) -> float:
        """The newest value, NaN for none. Raises LinkError."""


class Barometer(Device, Protocol):
    """Air pressure in the room."""

    async def ambient_pressure_pa(self) -> float:
        """The newest value, NaN for none. Raises LinkError."""


class Thermometer(Device, Protocol):
    """Air temperature beside the mirror."""

    async def air_temperature_c(self) -> float:
        """The newest value, NaN for none. Raises LinkError."""


class FilmThermometer(Device, Protocol):
    """Temperature of the film, by a radiation thermometer."""

    async def film_temperature_c(self) -> float:
        """The newest value, NaN for none. Raises LinkError."""


class RingThermometer(Device, Protocol):
    """Temperature of the ring that clamps the film."""

    async def ring_temperature_c(self) -> float:
        """The newest value, NaN for none. Raises LinkError."""


class Hygrometer(Device, Protocol):
    """Relative humidity of the air beside the mirror."""

    async def humidity_percent(self) -> float:
        """The newest value, NaN for none. Raises LinkError."""


class Pump(Device, Protocol):
    """The source of gas: a pump, or a flow controller on a bottle."""

    async def set_pump(self, fraction: float) -> None:
        """Command it, 0..1 of full scale. Raises LinkError: the device may or may not have received
        it.
        """

    async def pump_fraction(self) -> float:
        """The commanded (or actual) value reported by the device. Raises LinkError."""


class Vent(Device, Protocol):
    """The valve that lets gas out."""

    async def set_vent(self, fraction: float) -> None:
        """Open it, 0..1. Raises LinkError: the device may or may not have received it."""

    async def vent_fraction(self) -> float:
        """The commanded (or actual) value reported by the device. Raises LinkError."""


class InterlockSource(Device, Protocol):
    """A device that reads the circuits of one or several interlocks."""

    async def closed_circuits(self) -> tuple[bool, ...]:
        """Whether each circuit is closed, in the order in which the source was given them. Raises
        LinkError.
        """
