"""The membrane pump board over Modbus TCP or RTU as a `Bench`."""

import contextlib
import math
import secrets
from collections.abc import Mapping
from dataclasses import replace

from firmware_iface import register_map, roles
from firmware_iface.links import modbus_link, modbus_rtu

_KIND = "membrane pump board"
# of a board of map version 1, for people
NO_CLAIM = (
    "this board has no claim (register map 1): any program that reaches it can run its pump, and "
    "two programs on two machines are not kept apart; update its firmware"
)
_HEARTBEATS = 2**16
_U32_MAX = 2**32 - 1
# refused writes in a row until a claim counts as lost although its name is still there: one may be
# a gateway's answer
_BUSY_WRITES_MAX = 3


class PumpBoard:
    """All sensors, pump and vent of the bench on one board.

    After a lost link (LinkDownError) call `open` again, as often as wanted: it tries when its
    back-off allows. Whether the watchdog tripped meanwhile is in the next reading; nothing but
    `clear_faults` clears it, and until then the board keeps the pump off.

    `open` claims a board of map version 2 for this object: until it is closed, or its watchdog has
    run out, the board takes commands from no other program. A board of map version 1 has no claim
    and obeys every program. Boards before map version 3 do not stop the pump when their gauge
    fails, and have no interlock inputs: readings show none closed.

    Parameters
    ----------
    url : str
        `tcp://HOST[:PORT]` (502 when left out) or `rtu:///dev/ttyUSB0?baud=115200`.
    unit_id : int
        Modbus unit.
    timeout_s : float
        Of one exchange.
    watchdog_s : float
        The board turns the pump off when it gets no `write` for so long.
    link : ModbusLink or None
        Replaces the URL, for tests and emulated boards.

    Raises
    ------
    ValueError
        The URL is invalid, or the board cannot have this watchdog period.
    """

    def __init__(
        self,
        url: str,
        unit_id: int = 1,
        timeout_s: float = 0.2,
        watchdog_s: float = 0.5,
        link: modbus_link.ModbusLink | None = None,
    ) -> None:
        if link is None:
            link = modbus_rtu.ModbusLinks().link(url, unit_id, timeout_s)
        # of the board that answers, once its version is known
        self._registers = register_map.load_default_map()
        period = self._registers.register("watchdog_period_s")
        if not period.allows(watchdog_s):
            raise ValueError(
                f"watchdog_s = {watchdog_s:g}: the board takes {period.minimum:g} .. "
                f"{period.maximum:g} s"
            )
        # as the board will read it back
        self._watchdog_s = period.to_value(period.to_raw(watchdog_s))
        # The same for every opening by this object, so that a claim whose answer was lost can be
        # repeated. The name is public, the key is secret.
        self._claim_id = 1 + secrets.randbelow(_U32_MAX)
        self._claim_key = 1 + secrets.randbelow(_U32_MAX)
        self._armed = False  # by this object, since it last connected
        self._heartbeat = 0
        self._busy_writes = 0  # in a row
        self._link = link

    async def open(self) -> roles.BenchIdentity:
        """Connect, check kind and map version, claim the board, arm its watchdog and read both
        back.

        The watchdog runs from here on: write within its period, pump 0 too. Raises LinkError (no
        connection or no valid answer), DeviceBusyError (another program holds the board),
        DeviceRefusedError (another kind of device, an unknown map version, or a watchdog that does
        not take its setting).
        """
        identity = await self.identify()
        try:
            await self._arm_watchdog()
        except roles.LinkError:
            await self._link.close()
            raise
        return replace(identity, watchdog_s=self._watchdog_s)

    async def identify(self) -> roles.BenchIdentity:
        """Connect and check kind and map version; nothing is written. `read` then works, `write`
        does not.

        Raises as `open`; the identity's `watchdog_s` is NaN, as nothing was set.
        """
        self._armed = False
        await self._link.connect()
        try:
            return await self._identify()
        except roles.LinkError:
            await self._link.close()
            raise

    async def _identify(self) -> roles.BenchIdentity:
        # Kind and version are at the same addresses in every version of the map; where the other
        # registers are follows from them.
        identity = register_map.load_default_map().block("identity")
        kind, version = await self._link.read_holding(identity.address, 2)
        if kind != register_map.load_default_map().device_kind:
            raise roles.DeviceRefusedError(
                f"{self._link.name}: device kind {kind} is not a {_KIND} "
                f"({register_map.load_default_map().device_kind})"
            )
        if version not in register_map.list_known_maps():
            known = ", ".join(str(known) for known in register_map.list_known_maps())
            raise roles.DeviceRefusedError(
                f"{self._link.name}: register map version {version}, this program knows {known}; "
                "update the firmware or the program"
            )
        self._registers = register_map.list_known_maps()[version]
        found = await self._read_block(self._registers.block("identity"))
        firmware = int(found["firmware_version"])
        return roles.BenchIdentity(
            _KIND,
            version,
            f"{firmware >> 16}.{firmware >> 8 & 0xFF}.{firmware & 0xFF}",
            math.nan,
            found["gauge_pressure_limit_pa"],
            found["pump_limit_fraction"],
            # registers of map version 3
            gauge_fitted=found.get("gauge_fitted", 1.0) != 0.0,
            gauge_timeout_s=found.get("gauge_timeout_s", math.inf),
            interlocks_fitted=int(found.get("interlocks_fitted", 0)),
        )

    async def _arm_watchdog(self) -> None:
        try:
            await self._write_settings(arm=1.0)
        except roles.DeviceBusyError:
            raise await self._held_by_another() from None
        # Read back what the board has: another program may have written between the two requests.
        settings = await self._read_block(self._registers.block("settings"))
        sensors = await self._read_sensors()
        set_s = settings["watchdog_period_s"]
        as_written = (set_s, settings["watchdog_arm"]) == (self._watchdog_s, 1.0)
        if not as_written or self._find_foreign_settings(sensors):
            raise roles.DeviceRefusedError(
                f"{self._link.name}: watchdog set to {self._watchdog_s:g} s and armed, read back "
                f"as {set_s:g} s, armed {settings['watchdog_arm']:g}, claim "
                f"{int(sensors.get('claim_in_force', 0)):#x}; not safe to run"
            )
        # continue from the heartbeat that last fed the board: the first write must differ from it
        self._heartbeat = int(sensors["heartbeat_echo"])
        self._armed = True
        self._busy_writes = 0

    async def _held_by_another(self) -> roles.DeviceBusyError:
        sensors = await self._read_sensors()
        period_s = sensors["period_in_force_s"]
        return roles.DeviceBusyError(
            f"{self._link.name}: another program holds the board (claim "
            f"{int(sensors['claim_in_force']):#x}, watchdog {period_s:g} s); stop that one first",
            lapses_in_s=period_s,
        )

    async def read(self) -> roles.BenchReading:
        """One sample of everything, in one transaction.

        Raises LinkError (no valid answer), LinkDownError (no connection, or the board restarted and
        lost its settings: call `open` again).
        """
        values = await self._read_sensors()
        # A board that restarts has its watchdog off: its pump would run without a guard.
        if self._armed and not values["watchdog_armed"]:
            await self._link.close()
            raise roles.LinkDownError(
                f"{self._link.name}: the watchdog is off, so the board restarted; open it again"
            )
        return roles.BenchReading(
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
            foreign=self._find_foreign_settings(values) if self._armed else 0,
            interlock_inputs=int(values.get("interlock_inputs", 0)),
        )

    def _find_foreign_settings(self, sensors: Mapping[str, float]) -> int:
        """Which of the board's claim and period differ from what this object set; a board without
        claims cannot show that.
        """
        if self._registers.map_version == 1:
            return 0
        # The claim's name is public: another program may claim with the same one and another key.
        # Then the name is right, and every write is refused as busy.
        has_other_name = sensors["claim_in_force"] != self._claim_id
        is_refused = self._busy_writes >= _BUSY_WRITES_MAX
        found = 0
        if has_other_name or is_refused:
            found |= roles.FOREIGN_CLAIM
        if sensors["period_in_force_s"] != self._watchdog_s:
            found |= roles.FOREIGN_PERIOD
        return found

    async def write(self, command: roles.BenchCommand) -> None:
        """Write pump and vent with a new heartbeat, in one transaction, which feeds the watchdog.

        Raises ValueError (a fraction that is not within 0..1, or NaN; nothing is sent), LinkError
        (no valid answer: the board may or may not have it), DeviceBusyError (another program has
        the board by now).
        """
        for name, fraction in (("pump", command.pump_fraction), ("vent", command.vent_fraction)):
            if not 0.0 <= fraction <= 1.0:
                raise ValueError(f"{name}_fraction = {fraction} is not within 0..1")
        self._heartbeat = (self._heartbeat + 1) % _HEARTBEATS
        values = {
            "pump_command_fraction": command.pump_fraction,
            "vent_command_fraction": command.vent_fraction,
            "heartbeat": self._heartbeat,
            "command_key": self._claim_key,
        }
        try:
            await self._write_block("command", values)
        except roles.DeviceBusyError:
            self._busy_writes += 1
            raise
        self._busy_writes = 0

    async def clear_faults(self, mask: int) -> None:
        """Clear these latched faults of the board; the pump stays off until the next `write`.
        Raises LinkError.
        """
        await self._write_block("reset", {"clear_faults": mask, "clear_key": self._claim_key})

    async def stop(self) -> None:
        """Stop the pump of an identified board, even if another program holds it. Raises LinkError.

        The vent stays as it is.

        A board of map version 2 latches it as a fault. One of version 1 gets pump 0 without a
        heartbeat, which neither feeds nor arms its watchdog: its holder may run the pump again with
        the next command.
        """
        if self._registers.map_version == 1:
            await self._link.write_register(
                self._registers.register("pump_command_fraction").address, 0
            )
        else:
            await self._write_block("stop", {"stop": 1.0})

    def dead_guards(self) -> tuple[str, ...]:
        """None: the watchdog is the board's own, and its state is in each reading."""
        return ()

    def link_state(self) -> roles.LinkState:
        """Nothing: there is one link, whose errors are raised."""
        return roles.NO_LINK_STATE

    async def close(self) -> None:
        """Disarm the watchdog, which gives the claim back, and close the link; never raises.

        The board refuses to be disarmed while the pump is commanded: then the watchdog stays and
        turns it off.
        """
        if self._armed and self._link.connected:
            with contextlib.suppress(roles.LinkError):  # the watchdog then stops the pump
                await self._write_settings(arm=0.0)
        self._armed = False
        await self._link.close()

    async def _read_block(self, block: register_map.Block) -> dict[str, float]:
        return block.decode(await self._link.read_holding(block.address, block.count))

    async def _read_sensors(self) -> dict[str, float]:
        return await self._read_block(self._registers.block("sensors"))

    async def _write_settings(self, arm: float) -> None:
        claim = {"claim_id": self._claim_id, "claim_key": self._claim_key}
        await self._write_block(
            "settings", {"watchdog_period_s": self._watchdog_s, "watchdog_arm": arm, **claim}
        )

    async def _write_block(self, name: str, values: Mapping[str, float]) -> None:
        block = self._registers.block(name)
        await self._link.write_registers(block.address, block.encode(values))
