"""A board under test: the conformance test's access to it."""

import asyncio
import secrets
from collections.abc import Awaitable, Callable, Sequence
from functools import partial

from firmware_iface import register_map, roles
from firmware_iface.links.modbus_link import ModbusLink
from firmware_iface.requirement import ConformanceError, require

PUMP_FRACTION = 0.05  # below what starts a diaphragm pump
PERIOD_S = 0.3  # watchdog period during the test
REST_S = 10.0  # watchdog period between the checks and where a check is not about it
_U32_MAX = 2**32 - 1


class BoardUnderTest:
    """A connected board, the test's claim on it, and its heartbeat.

    Parameters
    ----------
    link : ModbusLink
        To the board, connected.
    sleep : callable
        Waits for seconds of the board's clock; another one lets tests run in virtual time.
    """

    def __init__(
        self, link: ModbusLink, sleep: Callable[[float], Awaitable[None]] = asyncio.sleep
    ) -> None:
        self._link = link
        self._sleep = sleep
        # of the board, once its version is known
        self._registers: register_map.RegisterMap = register_map.load_default_map()
        # its own protections, from map version 3 on
        self._gauge_fitted = False
        self._gauge_timeout_s = 0.0
        self._interlocks_fitted = 0
        self._heartbeat = 0
        self._id = 1 + secrets.randbelow(_U32_MAX)
        self._key = 1 + secrets.randbelow(_U32_MAX)

    @property
    def _claims(self) -> bool:
        return self._registers.map_version >= 2

    @property
    def _guards(self) -> bool:
        return self._registers.map_version >= 3

    async def _read_block(self, block: register_map.Block) -> dict[str, float]:
        return block.decode(await self._link.read_holding(block.address, block.count))

    async def _read_sensors(self) -> dict[str, float]:
        return await self._read_block(self._registers.block("sensors"))

    async def _write_block(self, name: str, values: dict[str, float]) -> None:
        block = self._registers.block(name)
        await self._link.write_registers(block.address, block.encode(values))

    def _make_command(self, pump: float, vent: float, key: int = 0) -> dict[str, float]:
        return {
            "pump_command_fraction": pump,
            "vent_command_fraction": vent,
            "heartbeat": self._heartbeat,
            "command_key": key or self._key,
        }

    async def _write_command(self, pump: float, vent: float = 0.0, *, fresh: bool = True) -> None:
        self._heartbeat = (self._heartbeat + fresh) % 2**16
        await self._write_block("command", self._make_command(pump, vent))

    async def _arm_watchdog(self, period_s: float = PERIOD_S, arm: float = 1.0) -> None:
        claim = {"claim_id": self._id, "claim_key": self._key}
        await self._write_block(
            "settings", {"watchdog_period_s": period_s, "watchdog_arm": arm, **claim}
        )

    async def _clear_faults(self, key: int = 0) -> None:
        await self._write_block("reset", {"clear_faults": 0xFFFF, "clear_key": key or self._key})

    async def _bring_to_rest(self) -> None:
        """Pump off, faults cleared, watchdog off: the state before and after every check."""
        steps: tuple[Callable[[], Awaitable[None]], ...] = (
            partial(self._arm_watchdog, REST_S),
            self._clear_faults,
            partial(self._write_command, 0.0),
            partial(self._arm_watchdog, arm=0.0),
        )
        for step in steps:
            try:
                await step()
            except roles.LinkDownError:
                raise
            except roles.LinkError:
                continue  # the check of this feature reports that the board lacks it

    async def _expect_trip(self, after: str) -> None:
        found = await self._read_sensors()
        value = found["pump_readback_fraction"]
        require(value == 0, f"holds the pump at {value:g} after {after}")
        mask = self._registers.make_fault_mask("watchdog")
        require(found["watchdog_tripped"] == 1, f"does not report watchdog_tripped after {after}")
        require(
            bool(int(found["latched_faults"]) & mask),
            f"does not latch the watchdog fault after {after}",
        )

    async def _expect_refusal(
        self, words: Sequence[int], address: int, what: str, why: str
    ) -> None:
        try:
            await self._link.write_registers(address, words)
        except roles.DeviceRefusedError:
            return
        raise ConformanceError(f"accepts {what}, which is outside its {why}")

    async def _expect_busy(self, write: Awaitable[None], what: str) -> None:
        """Expect the refusal of a write because another program holds the board."""
        try:
            await write
        except roles.DeviceBusyError:
            return
        except roles.DeviceRefusedError as error:
            raise ConformanceError(f"refuses {what}, but not with exception 6: {error}") from None
        raise ConformanceError(f"accepts {what}")

    def _claim_as_other(
        self, key: int, period_s: float = REST_S, arm: float = 1.0
    ) -> Awaitable[None]:
        """Another program's claim."""
        claim = {"claim_id": self._id ^ 1 or 2, "claim_key": key}
        return self._write_block(
            "settings", {"watchdog_period_s": period_s, "watchdog_arm": arm, **claim}
        )


def other_key(key: int) -> int:
    """A key that is not this one."""
    return key % _U32_MAX + 1
