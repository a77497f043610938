"""Two programs and one board: only the holder of the claim moves gas, anybody may stop it, and each
sees why.

The other program is a plain pymodbus client that knows docs/reference/registers.md and nothing of
our driver.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

import pytest
from counting_plant import CountingPlant, ManualClock
from pymodbus.client import AsyncModbusTcpClient

from firmware_iface.drivers.pump_board import PumpBoard
from firmware_iface.roles import (
    FOREIGN_CLAIM,
    FOREIGN_PERIOD,
    BenchCommand,
    DeviceBusyError,
    DeviceRefusedError,
    LinkDownError,
    LinkError,
)
from tests.worlds.faulty_board import PumpBoardEmulator

WATCHDOG_S = 0.5
ON, OFF = BenchCommand(0.5, 0.25), BenchCommand(0.0, 0.0)
SENSORS, SETTINGS, COMMAND, RESET, STOP = 16, 48, 56, 64, 72
ILLEGAL_ADDRESS, ILLEGAL_VALUE, BUSY = 2, 3, 6


class Plain:
    """A foreign program, with its own claim."""

    def __init__(self, port: int, name: int = 0xAAAA_0001, key: int = 0xBBBB_0002) -> None:
        self._client = AsyncModbusTcpClient(
            "127.0.0.1", port=port, timeout=5, retries=0, reconnect_delay=0
        )
        self._name, self._key = list(divmod(name, 2**16)), list(divmod(key, 2**16))
        self._heartbeat = 0

    async def connect(self) -> Plain:
        assert await self._client.connect()
        return self

    def close(self) -> None:
        self._client.close()

    async def put(self, address: int, *words: int) -> int:
        """Write; the exception code of the answer, 0 for none."""
        reply = await self._client.write_registers(address, list(words), device_id=1)
        return reply.exception_code if reply.isError() else 0

    async def claim(self, period_ms: int = 10_000, arm: int = 1) -> int:
        return await self.put(SETTINGS, period_ms, arm, *self._name, *self._key)

    async def command(self, pump: int, vent: int = 0) -> int:
        self._heartbeat += 1
        return await self.put(COMMAND, pump, vent, self._heartbeat, *self._key)

    async def clear(self) -> int:
        return await self.put(RESET, 0xFFFF, *self._key)

    async def stop(self) -> int:
        reply = await self._client.write_register(STOP, 1, device_id=1)
        return reply.exception_code if reply.isError() else 0

    async def sensors(self) -> list[int]:
        return (await self._client.read_holding_registers(SENSORS, count=25, device_id=1)).registers


@pytest.fixture
async def holder(board: PumpBoardEmulator) -> AsyncIterator[PumpBoard]:
    """Our driver, with the pump running."""
    made = PumpBoard(f"tcp://127.0.0.1:{board.port}", timeout_s=5.0, watchdog_s=WATCHDOG_S)
    await made.open()
    await made.write(ON)
    yield made
    await made.close()


@pytest.fixture
async def other(board: PumpBoardEmulator) -> AsyncIterator[Plain]:
    made = await Plain(board.port).connect()
    yield made
    made.close()


async def test_another_program_cannot_pump_feed_arm_disarm_or_clear(
    holder: PumpBoard,
    other: Plain,
    board: PumpBoardEmulator,
    plant: CountingPlant,
    clock: ManualClock,
) -> None:
    before = board.state.read(SETTINGS, 4) + board.state.read(COMMAND, 3)
    sent = {
        "claim": await other.claim(),
        "disarm": await other.claim(arm=0),
        "pump": await other.command(50_000),
        "clear": await other.clear(),
    }
    assert set(sent.values()) == {BUSY}
    for address, words in (
        (COMMAND, [50_000, 0, 9]),
        (COMMAND, [50_000]),
        (SETTINGS, [10_000, 1]),
        (RESET, [0xFFFF]),
    ):
        assert (
            await other.put(address, *words) == ILLEGAL_ADDRESS
        )  # as a client of map version 1 would write
    assert board.state.read(SETTINGS, 4) + board.state.read(COMMAND, 3) == before
    assert plant.outputs[-1] == (0.5, 0.25)
    assert (await holder.read()).foreign == 0
    clock.now_s += 0.4
    await other.command(50_000)
    clock.now_s += 0.11
    await plant.reaches((0.0, 0.25))  # nothing of it has fed the watchdog


async def test_what_the_sensors_show_does_not_help_to_command(
    holder: PumpBoard, other: Plain, board: PumpBoardEmulator
) -> None:
    """The claim's name serves for comparison only."""
    name = int.from_bytes(
        b"".join(word.to_bytes(2, "big") for word in (await other.sensors())[23:25]), "big"
    )
    thief = await Plain(board.port, name=name, key=name).connect()
    assert (await thief.claim(), await thief.command(50_000)) == (BUSY, BUSY)
    thief.close()
    readable = [
        board.state.read(block.address, block.count) for block in board.state.registers.blocks
    ]
    secret = list(divmod(int(board.state._claim_key), 2**16))
    for words in readable:
        assert secret not in [words[at : at + 2] for at in range(len(words) - 1)]


async def test_any_program_may_stop_and_the_holder_reads_that_and_clears_it(
    holder: PumpBoard, other: Plain, plant: CountingPlant
) -> None:
    assert await other.stop() == 0
    assert plant.outputs[-1] == (0.0, 0.25)
    assert (await holder.read()).latched_faults == 0b100
    await holder.write(ON)
    assert plant.outputs[-1] == (0.0, 0.25)
    assert await other.clear() == BUSY
    await holder.clear_faults(0xFFFF)
    await holder.write(ON)
    assert plant.outputs[-1] == (0.5, 0.25)


async def test_the_drivers_stop_needs_no_claim_and_takes_none(
    holder: PumpBoard, board: PumpBoardEmulator, plant: CountingPlant
) -> None:
    stopper = PumpBoard(f"tcp://127.0.0.1:{board.port}", timeout_s=5.0, watchdog_s=10.0)
    await stopper.identify()
    await stopper.stop()
    await stopper.close()
    assert plant.outputs[-1] == (0.0, 0.25)
    reading = await holder.read()
    assert (reading.latched_faults, reading.foreign) == (0b100, 0)


async def test_a_second_driver_is_refused_with_who_holds_it(
    holder: PumpBoard, board: PumpBoardEmulator
) -> None:
    second = PumpBoard(f"tcp://127.0.0.1:{board.port}", timeout_s=5.0, watchdog_s=10.0)
    with pytest.raises(
        DeviceBusyError,
        match=r"another program holds the board \(claim 0x[0-9a-f]+, watchdog 0.5 s",
    ):
        await second.open()
    await second.close()
    reading = await holder.read()
    assert (reading.pump_fraction, reading.foreign) == (0.5, 0)
    assert board.state.read(SETTINGS, 2) == [500, 1]


async def test_the_close_of_one_that_was_refused_disarms_nothing(
    holder: PumpBoard, board: PumpBoardEmulator
) -> None:
    await holder.write(OFF)
    second = PumpBoard(f"tcp://127.0.0.1:{board.port}", timeout_s=5.0, watchdog_s=WATCHDOG_S)
    with pytest.raises(DeviceBusyError):
        await second.open()
    await second.close()
    assert board.state.read(49, 1) == [1]


async def test_a_lost_claim_is_in_the_next_reading(
    holder: PumpBoard, other: Plain, plant: CountingPlant, clock: ManualClock
) -> None:
    clock.now_s += 1.0  # killed or stopped for longer than the period
    await plant.reaches((0.0, 0.25))
    assert (await holder.read()).foreign == 0
    assert await other.claim() == 0
    assert await other.clear() == 0
    assert await other.command(10_000, 5_000) == 0
    assert (await holder.read()).foreign == FOREIGN_CLAIM | FOREIGN_PERIOD
    with pytest.raises(DeviceBusyError):
        await holder.write(ON)
    with pytest.raises(DeviceBusyError):
        await holder.clear_faults(0xFFFF)
    await holder.close()
    assert plant.outputs[-1] == (0.2, 0.1)
    assert (await other.sensors())[19] == 1  # still armed
    await other.command(0)
    await other.claim(arm=0)


async def test_a_thief_of_the_name_shows_by_three_refused_writes(
    holder: PumpBoard, board: PumpBoardEmulator, clock: ManualClock
) -> None:
    name = int(board.state._claim_id)
    clock.now_s += 1.0
    thief = await Plain(board.port, name=name).connect()
    assert await thief.claim(500) == 0
    for refused in range(1, 4):
        with pytest.raises(DeviceBusyError):
            await holder.write(OFF)
        assert (await holder.read()).foreign == (FOREIGN_CLAIM if refused == 3 else 0)
    thief.close()


async def test_a_changed_period_shows_in_the_next_reading(
    holder: PumpBoard, board: PumpBoardEmulator
) -> None:
    board.state._settable["watchdog_period_s"] = 0.501  # by a firmware that is wrong
    assert (await holder.read()).foreign == FOREIGN_PERIOD


async def test_a_claim_whose_answer_was_lost_is_made_again_by_the_same_driver(
    board: PumpBoardEmulator, clock: ManualClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    driver = PumpBoard(f"tcp://127.0.0.1:{board.port}", timeout_s=0.1, watchdog_s=WATCHDOG_S)
    write = board.state.write

    def deaf(address: int, words: list[int]) -> None:
        write(address, words)
        board.faults.silent = True  # executed, but the answer is lost

    monkeypatch.setattr(board.state, "write", deaf)
    with pytest.raises(LinkError):
        await driver.open()
    claim = board.state._claim_key
    assert claim
    monkeypatch.setattr(board.state, "write", write)
    board.faults.silent = False
    await asyncio.sleep(driver._link.retry_in_s)
    await driver.open()
    assert board.state._claim_key == claim
    await driver.write(ON)
    assert board.state.pump_fraction == 0.5
    await driver.write(OFF)
    await driver.close()


async def test_after_a_restart_of_the_board_no_client_commands_before_a_new_claim(
    holder: PumpBoard, other: Plain, board: PumpBoardEmulator
) -> None:
    board.power_cycle()
    assert await other.command(50_000) == ILLEGAL_VALUE
    with pytest.raises(DeviceRefusedError):
        await holder.write(ON)
    with pytest.raises(LinkDownError, match="restarted"):
        await holder.read()
    await holder.open()
    assert await other.claim() == BUSY
    await holder.write(ON)
    assert board.state.pump_fraction == 0.5


@pytest.mark.parametrize("map_version", [1])
async def test_a_board_of_map_1_obeys_every_client_and_stops_unless_fed(
    holder: PumpBoard, board: PumpBoardEmulator, plant: CountingPlant, clock: ManualClock
) -> None:
    stopper = PumpBoard(f"tcp://127.0.0.1:{board.port}", timeout_s=5.0, watchdog_s=10.0)
    assert (await stopper.identify()).map_version == 1
    clock.now_s += 0.4
    await stopper.stop()
    await stopper.close()
    assert plant.outputs[-1] == (0.0, 0.25)
    assert board.state.read(SETTINGS, 2) == [500, 1]
    assert (await holder.read()).foreign == 0
    clock.now_s += 0.11
    await plant.reaches((0.0, 0.25))
    assert (await holder.read()).watchdog_tripped
