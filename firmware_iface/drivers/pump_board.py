"""The membrane pump board over Modbus TCP or RTU as a `Bench`."""

from __future__ import annotations

from firmware_iface.drivers.linked_device import LinkedDevice
from firmware_iface.links.modbus_links import ModbusLinks
from firmware_iface.links.modbus_rules import ModbusLink
from firmware_iface.register_map import default_map
from firmware_iface.roles import (
    BenchCommand,
    BenchIdentity,
    BenchReading,
    DeviceRefusedError,
    LinkDownError,
    LinkError,
)

_KIND = "membrane pump board"
_HEARTBEATS = 2**16


class PumpBoard(LinkedDevice):
    """All sensors, pump and vent of the bench on one board.

    After a lost link (LinkDownError) call `open` again, as often as wanted: it tries when its back-off allows.
    Whether the watchdog tripped meanwhile is in the next reading; nothing but `clear_faults` clears it, and until
    then the board keeps the pump off.

    Parameters
    ----------
    url : str
        `tcp://HOST:PORT` (502 when left out) or `rtu:///dev/ttyUSB0?baud=115200`.
    unit_id : int
        Modbus unit.
    timeout_s : float
        For connecting and for each reply.
    watchdog_s : float
        The board turns the pump off when it gets no `write` for this long.
    link : ModbusLink, optional
        A link that is there already (one in memory, in virtual time), in place of the URL's.

    Raises
    ------
    ValueError
        The URL is none, or the board cannot have this watchdog period.
    """

    def __init__(
        self,
        url: str,
        unit_id: int = 1,
        timeout_s: float = 0.2,
        watchdog_s: float = 0.5,
        link: ModbusLink | None = None,
    ) -> None:
        if link is None:
            link = ModbusLinks().link(url, unit_id, timeout_s)
        registers = default_map()
        self._map_version = registers.map_version
        self._device_kind = registers.device_kind
        self._identity = registers.block("identity")
        self._sensors = registers.block("sensors")
        self._settings = registers.block("settings")
        self._command = registers.block("command")
        self._reset = registers.block("reset")
        self._heartbeat_echo = registers.register("heartbeat_echo")
        period = registers.register("watchdog_period_s")
        if not period.allows(watchdog_s):
            raise ValueError(
                f"watchdog_s = {watchdog_s:g}: the board takes {period.minimum:g} .. {period.maximum:g} s"
            )
        self._watchdog_s = watchdog_s
        self._heartbeat = 0
        self._link = link
        super().__init__(self._link)

    async def open(self) -> BenchIdentity:
        """Connect, check kind and map version, arm the watchdog and read it back.

        The watchdog runs from here on: write within its period, pump 0 too.

        Raises
        ------
        LinkError
            No connection or no valid answer.
        DeviceRefusedError
            Another kind of device, an unknown map version, or a watchdog that does not take its setting.
        """
        await self._link.connect()
        try:
            firmware = await self._identify()
            # go on from the heartbeat that the board was fed last: the first write has to differ from it
            (self._heartbeat,) = await self._link.read_holding(self._heartbeat_echo.address, 1)
            period_s = await self._arm()
        except LinkError:
            await self._link.close()
            raise
        return BenchIdentity(_KIND, self._map_version, firmware, period_s)

    async def _identify(self) -> str:
        # these two never move; the rest means something only when they are right
        kind, version = await self._link.read_holding(self._identity.address, 2)
        if kind != self._device_kind:
            raise DeviceRefusedError(f"{self._link.name}: device kind {kind} is not a {_KIND} ({self._device_kind})")
        if version != self._map_version:
            raise DeviceRefusedError(
                f"{self._link.name}: register map version {version}, this program knows {self._map_version}; "
                "update the firmware or the program"
            )
        words = await self._link.read_holding(self._identity.address, self._identity.count)
        firmware = int(self._identity.decode(words)["firmware_version"])
        return f"{firmware >> 16}.{firmware >> 8 & 0xFF}.{firmware & 0xFF}"

    async def _arm(self) -> float:
        settings = {"watchdog_period_s": self._watchdog_s, "watchdog_arm": 1.0}
        words = self._settings.encode(settings)
        await self._link.write_registers(self._settings.address, words)
        found_words = await self._link.read_holding(self._settings.address, self._settings.count)
        found = self._settings.decode(found_words)
        if found_words != words:
            raise DeviceRefusedError(
                f"{self._link.name}: watchdog set to {settings}, read back as {found}; not safe to run"
            )
        return found["watchdog_period_s"]

    async def read(self) -> BenchReading:
        """One sample of everything, in one transaction.

        Raises
        ------
        LinkError
            No valid answer.
        LinkDownError
            No connection, or the board restarted and lost its settings: call `open` again.
        """
        words = await self._link.read_holding(self._sensors.address, self._sensors.count)
        values = self._sensors.decode(words)
        if not values["watchdog_armed"]:
            await self._link.close()
            raise LinkDownError(f"{self._link.name}: the watchdog is off, so the board restarted; open it again")
        return BenchReading(
            displacement_um=values["displacement_um"],
            displacement_quality=int(values["displacement_quality"]),
            gauge_pressure_pa=values["gauge_pressure_pa"],
            ambient_pressure_pa=values["ambient_pressure_pa"],
            air_temperature_c=values["air_temperature_c"],
            gas_temperature_c=values["gas_temperature_c"],
            pump_fraction=values["pump_readback_fraction"],
            vent_fraction=values["vent_readback_fraction"],
            sample_counter=int(values["sample_counter"]),
            device_time_s=values["device_time_s"] + values["device_time_fraction_s"],
            watchdog_tripped=bool(values["watchdog_tripped"]),
            latched_faults=int(values["latched_faults"]),
        )

    async def write(self, command: BenchCommand) -> None:
        """Write pump and vent with a new heartbeat, in one transaction: what feeds the watchdog.

        Raises
        ------
        ValueError
            A fraction that is not within 0..1, or NaN; nothing is sent.
        LinkError
            No valid answer: the board may or may not have it.
        """
        for name, fraction in (("pump", command.pump_fraction), ("vent", command.vent_fraction)):
            if not 0.0 <= fraction <= 1.0:
                raise ValueError(f"{name}_fraction = {fraction} is not within 0..1")
        self._heartbeat = (self._heartbeat + 1) % _HEARTBEATS
        values = {
            "pump_command_fraction": command.pump_fraction,
            "vent_command_fraction": command.vent_fraction,
            "heartbeat": self._heartbeat,
        }
        await self._link.write_registers(self._command.address, self._command.encode(values))

    async def clear_faults(self) -> None:
        """Clear all latched faults of the board; the pump stays off until the next `write`. Raises LinkError."""
        await self._link.write_registers(self._reset.address, [0xFFFF])

    async def close(self) -> None:
        """Disarm the watchdog and close the link; never raises.

        The board refuses to be disarmed while the pump is commanded: then the watchdog stays and turns it off.
        """
        if self._link.connected:
            try:
                words = self._settings.encode({"watchdog_period_s": self._watchdog_s, "watchdog_arm": 0.0})
                await self._link.write_registers(self._settings.address, words)
            except LinkError:
                pass  # the watchdog then does what it is for
        await self._link.close()
