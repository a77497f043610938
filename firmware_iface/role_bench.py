"""A `Bench` composed of single devices, one per role.

The actuators decide whether the bench is there. Without the pump (and the vent, if there is one)
nothing can be made safe, so their errors are raised, and the loss of their link is the loss of the
bench's. A failed sensor is a missing value: NaN, on which the controller holds the flow, ramps down
or continues without it, and the sensor is reopened in the background, so that a replugged cable
gives good readings within its back-off.

Watchdog: only the pump board has its own. An instrument keeps its last setpoint, so this bench
watches itself: without a `write` within `watchdog_s` it sets the pump to 0 and reports that. This
covers a controller that hangs in a tick, not one that is killed: then the last flow continues until
the gas is shut off by hand or by a relief valve, as docs/decisions/35-single-instruments.md and
`check` state.
"""

import asyncio
import contextlib
import math
import time
from collections.abc import Awaitable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

from firmware_iface import roles

T = TypeVar("T")
WATCHDOG_BIT = 0  # in latched_faults, as on the pump board
NO_ANSWER = roles.NO_ANSWER
_ANY = (-math.inf, math.inf)
_RETRY_S = 0.1  # between two attempts to open a lost sensor; its link has the longer back-off


@dataclass(frozen=True, slots=True)
class RoleDevices:
    """Which device fills which role; None where the bench has none. `others` are further ones of
    `roles.SENSORS`.
    """

    displacement: roles.DisplacementSensor | None
    pump: roles.Pump
    gauge_pressure: roles.PressureSensor
    vent: roles.Vent | None = None
    others: Mapping[str, roles.Device] = field(default_factory=dict)

    def by_role(self) -> dict[str, roles.Device]:
        """The filled roles, actuators last: nothing may move gas
        before the sensors are connected.
        """
        filled: dict[str, roles.Device | None] = {
            "displacement": self.displacement,
            **self.sensors(),
            "vent": self.vent,
            "pump": self.pump,
        }
        return {role: device for role, device in filled.items() if device is not None}

    def sensors(self) -> dict[str, roles.Device]:
        """The sensors that give one value a tick, by role."""
        return {"gauge_pressure": self.gauge_pressure, **self.others}


class RoleBench:
    """Reads all sensors at once and drives pump and vent.

    Parameters
    ----------
    devices : RoleDevices
        One for each role, not yet open.
    watchdog_s : float
        Without a `write` for so long this program sets the pump to 0.
    clock : callable
        Monotonic time, s.
    """

    def __init__(
        self, devices: RoleDevices, watchdog_s: float = 0.5, clock: roles.Clock = time.monotonic
    ) -> None:
        self._devices = devices
        self._watchdog_s = watchdog_s
        self._clock = clock
        self._tasks: dict[str, asyncio.Task[None]] = {}  # reopening lost sensors, by role
        self._watchdog: asyncio.Task[None] | None = None
        self._last_sample = roles.DisplacementSample(math.nan, NO_ANSWER, 0, 0.0)
        self._fed_s = math.inf
        self._commanded = 0.0
        self._tripped = False
        self._silent: dict[str, str] = {}  # why a sensor gave no valid answer, by role
        self._answered_s: dict[str, float] = {}  # when, by role, in this reading
        self.identities: dict[str, roles.DeviceIdentity] = {}

    async def open(self) -> roles.BenchIdentity:
        """Open every device, sensors first, and start the watchdog; its latches stay.

        Raises LinkError, naming the role of the first device that is absent or not as configured.
        """
        await self._stop_reopening()  # an earlier watchdog stays: the pump may still run
        if self._commanded > 0:  # lost while running: stopping it must not wait for lost sensors
            with contextlib.suppress(Exception):
                await self._devices.pump.open()
                await self._devices.pump.set_pump(0.0)
                self._commanded = 0.0
        # Each device, or none: a bench that lacks one is closed again.
        for role, device in self._devices.by_role().items():
            try:
                self.identities[role] = await answer(role, device.open())
            except roles.LinkError as error:
                await self.close()
                raise type(error)(f"{role}: {error}") from error
        # The watchdog runs in this program, because single instruments have none.
        await self._stop_watchdog()
        self._fed_s = self._clock()
        self._commanded = 0.0
        self._watchdog = asyncio.create_task(self._run_watchdog(), name="software watchdog")
        # What the devices state of themselves, as of one bench.
        kinds = ", ".join(f"{role} {identity.kind}" for role, identity in self.identities.items())
        firmware = ", ".join(
            dict.fromkeys(i.firmware for i in self.identities.values() if i.firmware)
        )
        displacement_range_um = _ANY
        if "displacement" in self.identities:
            displacement_range_um = self.identities["displacement"].shows
        return roles.BenchIdentity(
            f"composed of {kinds}",
            0,
            firmware,
            self._watchdog_s,
            displacement_range_um=displacement_range_um,
            gauge_range_pa=self.identities["gauge_pressure"].shows,
        )

    async def read(self) -> roles.BenchReading:
        """Read all sensors at once; missing values are NaN.

        Raises LinkError (pump or vent gave no valid answer; LinkDownError if its link is lost, or
        the watchdog has ended).
        """
        await self._require_watchdog()
        self._answered_s.clear()
        sensors = asyncio.ensure_future(self._read_sensors())  # never raises
        try:
            pump, vent = await self._read_actuators()
        finally:
            sample, values = await sensors
        if sample.quality == NO_ANSWER and math.isfinite(values["gauge_pressure_pa"]):
            # the laser is lost, or there is none, and the bench is not: counted downwards, as no
            # laser does
            sample = replace(
                sample,
                sample_counter=min(sample.sample_counter, 0) - 1,
                device_time_s=self._clock(),
            )
            self._last_sample = sample
        return replace(
            roles.NO_READING,
            **values,
            displacement_um=sample.displacement_um,
            displacement_quality=sample.quality,
            pump_fraction=pump,
            vent_fraction=vent,
            sample_counter=sample.sample_counter,
            device_time_s=sample.device_time_s,
            watchdog_tripped=self._tripped,
            latched_faults=int(self._tripped) << WATCHDOG_BIT,
        )

    async def write(self, command: roles.BenchCommand) -> None:
        """Command pump and vent at once, and feed the watchdog; after a trip the pump stays off.

        Raises ValueError (a fraction outside 0..1, or NaN; nothing is sent), LinkError (the device
        may or may not have received it; the other one was commanded anyway).
        """
        for name, fraction in (("pump", command.pump_fraction), ("vent", command.vent_fraction)):
            if not 0.0 <= fraction <= 1.0:
                raise ValueError(f"{name}_fraction = {fraction} is not within 0..1")
        await self._require_watchdog()
        pump = 0.0 if self._tripped else command.pump_fraction
        self._commanded = max(self._commanded, pump)  # the pump may have it before it answers
        actions = [answer("pump", self._devices.pump.set_pump(pump))]
        if self._devices.vent is not None:
            actions.append(answer("vent", self._devices.vent.set_vent(command.vent_fraction)))
        _raise_first(await asyncio.gather(*actions, return_exceptions=True))
        self._commanded = pump
        self._fed_s = self._clock()

    async def clear_faults(self, mask: int) -> None:
        """Forget a trip of the watchdog, if the mask has its bit."""
        if mask & 1 << WATCHDOG_BIT:
            self._tripped = False
            self._fed_s = self._clock()

    def dead_guards(self) -> tuple[str, ...]:
        """The software watchdog, if its task has ended while the bench is open."""
        if self._watchdog is None or not self._watchdog.done():
            return ()
        return ("software watchdog",)

    def link_state(self) -> roles.LinkState:
        """Sensors without a valid answer to the last reading, and the device that answered last."""
        answered_s = self._answered_s
        slowest = ""
        if answered_s:
            slowest = max(answered_s, key=answered_s.__getitem__)
        return roles.LinkState(tuple(self._silent.items()), slowest)

    async def close(self) -> None:
        """Close every device, the pump first. Never raises."""
        await self._stop_reopening()
        await self._stop_watchdog()
        for device in reversed(self._devices.by_role().values()):
            # one driver's mistake must not leave the next device open
            with contextlib.suppress(Exception):
                await device.close()

    async def _read_sensors(self) -> tuple[roles.DisplacementSample, dict[str, Any]]:
        """The displacement, and the values of the other sensors by
        their field of `BenchReading`.
        """
        requests = asyncio.gather(*(self._newest_value(role) for role in roles.SENSORS.values()))
        sample, values = await asyncio.gather(self._newest_sample(), requests)
        return sample, dict(zip(roles.SENSORS, values, strict=True))

    async def _read_actuators(self) -> tuple[float, float]:
        """Read-back of pump and vent; NaN for a vent that the bench does not have."""
        vent = self._devices.vent
        if vent is None:
            return await self._time_answer("pump", self._devices.pump.pump_fraction()), math.nan
        requests = (
            self._time_answer("pump", self._devices.pump.pump_fraction()),
            self._time_answer("vent", vent.vent_fraction()),
        )
        found = await asyncio.gather(*requests, return_exceptions=True)
        _raise_first(found)
        pump_fraction, vent_fraction = (value for value in found if isinstance(value, float))
        return pump_fraction, vent_fraction

    async def _newest_sample(self) -> roles.DisplacementSample:
        """The newest sample; without one, the last counter and time, which then do not advance."""
        laser = self._devices.displacement
        self._last_sample = replace(self._last_sample, displacement_um=math.nan, quality=NO_ANSWER)
        if laser is not None and "displacement" not in self._tasks:
            try:
                self._last_sample = await self._time_answer("displacement", laser.displacement())
                self._silent.pop("displacement", None)
            except roles.LinkError as error:
                self._note_failure("displacement", error)
        return self._last_sample

    async def _newest_value(self, role: roles.Role) -> float:
        """The newest value of a sensor; NaN without one, and while it is reopened."""
        device = self._devices.sensors().get(role.name)
        if device is None or role.name in self._tasks:
            return math.nan
        try:
            value: float = await self._time_answer(role.name, getattr(device, role.reads)())
        except roles.LinkError as error:
            self._note_failure(role.name, error)
            return math.nan
        self._silent.pop(role.name, None)
        return value

    async def _time_answer(self, role: str, request: Awaitable[T]) -> T:
        """`answer`, with its time noted."""
        try:
            return await answer(role, request)
        finally:
            self._answered_s[role] = self._clock()

    def _note_failure(self, role: str, error: roles.LinkError) -> None:
        self._silent[role] = str(error)
        if isinstance(error, roles.LinkDownError) and role not in self._tasks:
            self._tasks[role] = asyncio.create_task(
                self._reopen_sensor(role), name=f"open {role} again"
            )

    async def _reopen_sensor(self, role: str) -> None:
        """Reopen a lost sensor until the same one is back; a different one in its place needs a
        person.
        """
        device = self._devices.by_role()[role]
        while True:
            try:
                if await answer(role, device.open()) == self.identities[role]:
                    break
                self._silent[role] = "another device than before answers; open the bench again"
            except roles.LinkWaitsError:
                pass  # the failure after which it waits states more
            except roles.LinkError as error:
                self._silent[role] = str(error)
            await asyncio.sleep(_RETRY_S)
        del self._tasks[role]

    async def _run_watchdog(self) -> None:
        """The software watchdog: after any exception of a driver, it retries a quarter of a period
        later.
        """
        while True:
            await asyncio.sleep(self._watchdog_s / 4)
            if self._commanded > 0 and self._clock() - self._fed_s > self._watchdog_s:
                self._tripped = True
                with contextlib.suppress(Exception):
                    await self._devices.pump.set_pump(0.0)
                    self._commanded = 0.0

    async def _require_watchdog(self) -> None:
        """Refuse to read or command without the watchdog.

        A watchdog that has ended leaves an unguarded pump: it is set to 0 here, and the bench
        counts as lost until it is reopened, which starts another watchdog.
        """
        if self._watchdog is not None and not self._watchdog.done():
            return
        error = "was not started"
        if self._watchdog is not None:
            error = _describe_ending(self._watchdog)
        self._tripped = True
        with contextlib.suppress(Exception):
            await self._devices.pump.set_pump(0.0)
        raise roles.LinkDownError(
            f"the software watchdog {error}; the pump was set to 0, open the devices again"
        )

    async def _stop_watchdog(self) -> None:
        task, self._watchdog = self._watchdog, None
        await _stop_tasks([] if task is None else [task])

    async def _stop_reopening(self) -> None:
        tasks, self._tasks = list(self._tasks.values()), {}
        await _stop_tasks(tasks)


async def _stop_tasks(tasks: list[asyncio.Task[None]]) -> None:
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


def _describe_ending(task: asyncio.Task[None]) -> str:
    """How a task ended that should run forever."""
    error = None if task.cancelled() else task.exception()
    if error is None:
        return "was cancelled"
    return f"ended with {type(error).__name__}: {error}"


async def answer(role: str, request: Awaitable[T]) -> T:
    """Wait for a device's answer; an unexpected exception is a fault of that device, not the end of
    the run.

    Parameters
    ----------
    role : str
        Of the device, for the message.
    request : awaitable
        The answer to wait for.

    Raises
    ------
    LinkError
        The device or its driver failed.
    """
    try:
        return await request
    except roles.LinkError:
        raise
    except Exception as error:
        raise roles.LinkError(f"{role}: {type(error).__name__}: {error}") from error


def _raise_first(results: Iterable[object]) -> None:
    """Raise the first result that is an error."""
    for result in results:
        if isinstance(result, BaseException):
            raise result
