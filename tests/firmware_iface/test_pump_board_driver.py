"""The driver against the emulated board: from SI values to bytes and back, and every fault."""

from __future__ import annotations

import asyncio
import math
import random
from collections.abc import AsyncIterator

import pytest
from counting_plant import CountingPlant, ManualClock
from pymodbus.client import AsyncModbusTcpClient

from firmware_iface.drivers.pump_board import PumpBoard
from firmware_iface.emulators.pump_board import StoredSettings
from firmware_iface.links.modbus_rtu import parse_tcp_url
from firmware_iface.register_map import load_default_map
from firmware_iface.roles import (
    ALL_FAULTS,
    BenchCommand,
    BenchIdentity,
    BenchReading,
    DeviceRefusedError,
    LinkDownError,
    LinkError,
)
from tests.worlds.faulty_board import Faults, PumpBoardEmulator

WATCHDOG_S = 0.5
OFF = BenchCommand(0.0, 0.0)
every_map = pytest.mark.parametrize("map_version", [1, 2, 3])


@pytest.fixture
async def driver(board: PumpBoardEmulator) -> AsyncIterator[PumpBoard]:
    made = PumpBoard(f"tcp://127.0.0.1:{board.port}", timeout_s=5.0, watchdog_s=WATCHDOG_S)
    yield made
    await made.close()


def impatient(board: PumpBoardEmulator, timeout_s: float = 0.3) -> PumpBoard:
    return PumpBoard(f"tcp://127.0.0.1:{board.port}", timeout_s=timeout_s, watchdog_s=WATCHDOG_S)


def agrees(reading: BenchReading) -> bool:
    """Whether every value belongs to the reading's own sample."""
    return (
        abs(reading.displacement_um - CountingPlant.displacement_um(reading.sample_counter)) < 1e-3
        and abs(reading.ambient_pressure_pa - 101_325.0 - 0.5 * (reading.sample_counter % 100))
        < 1e-2
        and abs(reading.device_time_s - reading.sample_counter / 128) < 2e-4
    )


@every_map
async def test_open_identifies_the_board_and_arms_the_watchdog(
    driver: PumpBoard, board: PumpBoardEmulator, map_version: int
) -> None:
    identity = await driver.open()
    gauge_timeout_s = 15.0 if map_version == 3 else math.inf
    assert identity == BenchIdentity(
        "membrane pump board",
        map_version,
        "1.1.0",
        WATCHDOG_S,
        800.0,
        1.0,
        gauge_timeout_s=gauge_timeout_s,
    )
    assert board.state.read(48, 2) == [500, 1]
    assert (await driver.read()).foreign == 0


async def test_a_reading_is_one_new_sample_in_si_units(
    driver: PumpBoard, plant: CountingPlant
) -> None:
    await driver.open()
    seen = plant.counter
    reading = await driver.read()
    assert reading.sample_counter > seen
    assert agrees(reading)
    assert (reading.gauge_pressure_pa, reading.air_temperature_c, reading.gas_temperature_c) == (
        600.0,
        20.25,
        -3.125,
    )
    assert (reading.displacement_quality, reading.watchdog_tripped, reading.latched_faults) == (
        0,
        False,
        0,
    )


@every_map
async def test_interlock_inputs_are_read_where_the_board_has_them(
    driver: PumpBoard, plant: CountingPlant, map_version: int
) -> None:
    plant.interlock_inputs = 0b1010
    await driver.open()
    assert (await driver.read()).interlock_inputs == (0b1010 if map_version == 3 else 0)


@pytest.mark.parametrize(
    ("stored", "found"),
    [
        (StoredSettings(), (True, 15.0, 0)),
        (
            StoredSettings(gauge_fitted=False, gauge_timeout_s=2.5, interlocks_fitted=6),
            (False, 2.5, 6),
        ),
    ],
)
async def test_the_identity_states_which_protections_the_board_has(
    driver: PumpBoard,
    board: PumpBoardEmulator,
    stored: StoredSettings,
    found: tuple[bool, float, int],
) -> None:
    board.state.stored = stored
    identity = await driver.identify()
    assert (identity.gauge_fitted, identity.gauge_timeout_s, identity.interlocks_fitted) == found


@every_map
async def test_a_command_reaches_the_plant_and_is_read_back(
    driver: PumpBoard, plant: CountingPlant
) -> None:
    await driver.open()
    await driver.write(BenchCommand(0.125, 1.0))
    assert plant.outputs[-1] == (0.125, 1.0)
    reading = await driver.read()
    assert (reading.pump_fraction, reading.vent_fraction) == (0.125, 1.0)
    await driver.write(OFF)


@pytest.mark.parametrize("fraction", [math.nan, -0.001, 1.001, math.inf])
async def test_an_impossible_command_never_reaches_the_wire(
    driver: PumpBoard, board: PumpBoardEmulator, fraction: float
) -> None:
    await driver.open()
    before = board.state.read(56, 3)
    with pytest.raises(ValueError, match=r"pump_fraction = .* is not within"):
        await driver.write(BenchCommand(fraction, 0.0))
    with pytest.raises(ValueError, match=r"vent_fraction = .* is not within"):
        await driver.write(BenchCommand(0.0, fraction))
    assert board.state.read(56, 3) == before


@pytest.mark.parametrize(
    ("url", "target"),
    [("tcp://bench.local:5020", ("bench.local", 5020)), ("tcp://127.0.0.1", ("127.0.0.1", 502))],
)
def test_urls(url: str, target: tuple[str, int]) -> None:
    assert parse_tcp_url(url) == target


@pytest.mark.parametrize(
    "url", ["127.0.0.1:5020", "http://h", "tcp://", "tcp://h:x", "tcp://h:70000", "tcp://h/p"]
)
def test_a_wrong_url_is_named(url: str) -> None:
    with pytest.raises(ValueError, match=url):
        PumpBoard(url)


@pytest.mark.parametrize("watchdog_s", [0.0, 0.049, 10.1, math.nan])
def test_a_watchdog_period_the_board_cannot_have_is_refused(watchdog_s: float) -> None:
    with pytest.raises(ValueError, match=r"the board takes 0.05 \.\. 10 s"):
        PumpBoard("tcp://127.0.0.1:1", watchdog_s=watchdog_s)


async def test_an_unknown_map_version_is_refused_with_both_named(
    driver: PumpBoard, board: PumpBoardEmulator
) -> None:
    board.faults.map_version = 9
    with pytest.raises(DeviceRefusedError, match="version 9, this program knows 1, 2, 3"):
        await driver.open()
    assert board.state.read(49, 1) == [0]  # nothing was written to it
    with pytest.raises(LinkDownError):
        await driver.read()


async def test_another_kind_of_device_is_refused(
    driver: PumpBoard, board: PumpBoardEmulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = board.state.read
    monkeypatch.setattr(
        board.state, "read", lambda address, count: [word ^ 1 for word in read(address, count)]
    )
    with pytest.raises(DeviceRefusedError, match="device kind 19779 is not a membrane pump board"):
        await driver.open()


@every_map
async def test_a_watchdog_that_does_not_take_its_setting_is_refused(
    driver: PumpBoard, board: PumpBoardEmulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(board.state, "write", lambda address, words: None)
    with pytest.raises(DeviceRefusedError, match="not safe to run"):
        await driver.open()


async def test_a_missing_displacement_is_nan(driver: PumpBoard, board: PumpBoardEmulator) -> None:
    await driver.open()
    board.faults.no_displacement = True
    reading = await driver.read()
    assert math.isnan(reading.displacement_um)
    assert reading.gauge_pressure_pa == 600.0


async def test_a_frozen_board_shows_in_counter_and_time(
    driver: PumpBoard, board: PumpBoardEmulator
) -> None:
    await driver.open()
    board.faults.frozen = True
    first, second = await driver.read(), await driver.read()
    assert (first.sample_counter, first.device_time_s) == (
        second.sample_counter,
        second.device_time_s,
    )
    board.faults.frozen = False
    assert (await driver.read()).sample_counter > first.sample_counter


@pytest.mark.parametrize(
    "fault",
    [
        Faults(short_reply=True),
        Faults(wrong_function=True),
        Faults(exception_code=4),
        Faults(hang_up=True),
    ],
)
async def test_a_wrong_answer_is_an_error_at_once_and_the_next_right_one_is_taken(
    driver: PumpBoard, board: PumpBoardEmulator, fault: Faults
) -> None:
    await driver.open()
    await driver.read()
    board.faults = fault
    with pytest.raises(LinkError):
        await driver.read()
    board.faults = Faults()
    if fault.hang_up:
        await driver.open()
    assert agrees(await driver.read())


@pytest.mark.parametrize(
    "fault", [Faults(silent=True), Faults(delay_s=10.0), Faults(wrong_transaction=True)]
)
async def test_no_answer_in_time_is_an_error(board: PumpBoardEmulator, fault: Faults) -> None:
    driver = impatient(board)
    await driver.open()
    board.faults = fault
    with pytest.raises(LinkError, match="no valid answer"):
        await driver.read()
    with pytest.raises(LinkError, match="no valid answer"):
        await driver.write(OFF)
    board.faults = Faults()
    assert agrees(await driver.read())
    await driver.close()


async def test_a_late_answer_is_never_taken_for_a_later_sample(
    board: PumpBoardEmulator, plant: CountingPlant
) -> None:
    driver = impatient(board)
    await driver.open()
    board.faults.delay_s = 0.45
    with pytest.raises(LinkError):
        await driver.read()
    board.faults.delay_s = 0.0
    for _ in range(200):
        seen = plant.counter
        assert (await driver.read()).sample_counter > seen
    await driver.close()


async def test_watchdog_trips_when_the_client_stops(
    driver: PumpBoard, plant: CountingPlant, clock: ManualClock
) -> None:
    await driver.open()
    await driver.write(BenchCommand(0.5, 0.25))
    clock.now_s += WATCHDOG_S + 0.001
    await plant.reaches((0.0, 0.25))  # by the board's own task: nobody talks to it
    reading = await driver.read()
    assert reading.watchdog_tripped
    assert reading.latched_faults == load_default_map().make_fault_mask("watchdog")


async def test_watchdog_trips_when_only_readers_are_there(
    driver: PumpBoard, board: PumpBoardEmulator, plant: CountingPlant, clock: ManualClock
) -> None:
    await driver.open()
    await driver.write(BenchCommand(0.5, 0.0))
    other = AsyncModbusTcpClient(
        "127.0.0.1", port=board.port, timeout=5, retries=0, reconnect_delay=0
    )
    assert await other.connect()
    for _ in range(6):
        clock.now_s += 0.1
        assert len((await other.read_holding_registers(16, count=22, device_id=1)).registers) == 22
        await driver.read()
    assert plant.outputs[-1] == (0.0, 0.0)
    other.close()


async def test_the_watchdog_trips_when_the_heartbeat_stops(
    board: PumpBoardEmulator, driver: PumpBoard, plant: CountingPlant, clock: ManualClock
) -> None:
    stuck = AsyncModbusTcpClient(
        "127.0.0.1", port=board.port, timeout=5, retries=0, reconnect_delay=0
    )
    assert await stuck.connect()
    await stuck.write_registers(48, [500, 1, 0, 7, 0, 9], device_id=1)
    for _ in range(6):
        reply = await stuck.write_registers(56, [25_000, 0, 77, 0, 9], device_id=1)
        assert not reply.isError()
        clock.now_s += 0.1
    await plant.reaches((0.0, 0.0))
    await driver.open()
    assert (await driver.read()).watchdog_tripped
    stuck.close()


async def test_writing_every_tick_keeps_the_pump_on(
    driver: PumpBoard, plant: CountingPlant, clock: ManualClock
) -> None:
    await driver.open()
    for _ in range(50):
        await driver.write(BenchCommand(0.5, 0.0))
        clock.now_s += 0.4
        await driver.read()
    assert plant.outputs[-1] == (0.5, 0.0)
    await driver.write(OFF)


@every_map
async def test_after_a_trip_only_a_person_gets_the_pump_back(
    driver: PumpBoard, board: PumpBoardEmulator, plant: CountingPlant, clock: ManualClock
) -> None:
    await driver.open()
    await driver.write(BenchCommand(0.5, 0.0))
    board.drop_connections()
    clock.now_s += 1.0
    await plant.reaches((0.0, 0.0))
    await driver.open()
    assert (await driver.read()).watchdog_tripped  # what happened while we were away
    await driver.write(BenchCommand(0.5, 0.0))
    assert (await driver.read()).pump_fraction == 0.0
    await driver.clear_faults(ALL_FAULTS)
    reading = await driver.read()
    assert (reading.pump_fraction, reading.watchdog_tripped, reading.latched_faults) == (
        0.0,
        False,
        0,
    )
    await driver.write(BenchCommand(0.5, 0.0))
    assert (await driver.read()).pump_fraction == 0.5
    await driver.write(OFF)


@every_map
async def test_a_reconnect_within_the_period_causes_no_trip(
    driver: PumpBoard, board: PumpBoardEmulator, plant: CountingPlant, clock: ManualClock
) -> None:
    await driver.open()
    await driver.write(BenchCommand(0.5, 0.0))
    board.drop_connections()
    with pytest.raises(LinkDownError):
        await driver.read()
    clock.now_s += 0.4
    await driver.open()
    await driver.write(BenchCommand(0.5, 0.0))
    clock.now_s += 0.4
    reading = await driver.read()
    assert (reading.watchdog_tripped, reading.foreign) == (False, 0)
    assert plant.outputs[-1] == (0.5, 0.0)
    await driver.write(OFF)


@every_map
async def test_a_restarted_board_is_not_read_on(
    driver: PumpBoard, board: PumpBoardEmulator
) -> None:
    await driver.open()
    await driver.write(BenchCommand(0.5, 0.0))
    board.power_cycle()
    with pytest.raises(LinkDownError, match="restarted"):
        await driver.read()
    with pytest.raises(LinkDownError, match="not connected"):
        await driver.write(OFF)
    await driver.open()
    assert (await driver.read()).pump_fraction == 0.0


async def test_over_pressure_is_acted_on_by_the_board_itself(
    driver: PumpBoard, plant: CountingPlant
) -> None:
    await driver.open()
    await driver.write(BenchCommand(0.5, 0.0))
    plant.gauge_pressure_pa = 801.0
    await plant.reaches((0.0, 1.0))
    assert (await driver.read()).latched_faults == load_default_map().make_fault_mask(
        "over_pressure"
    )


@every_map
async def test_a_clean_close_disarms_the_watchdog(
    driver: PumpBoard, board: PumpBoardEmulator, clock: ManualClock
) -> None:
    await driver.open()
    await driver.write(OFF)
    await driver.close()
    clock.now_s += 10
    await driver.open()
    assert not (await driver.read()).watchdog_tripped


@every_map
async def test_a_close_with_the_pump_on_leaves_it_to_the_watchdog(
    driver: PumpBoard, plant: CountingPlant, clock: ManualClock
) -> None:
    await driver.open()
    await driver.write(BenchCommand(0.5, 0.0))
    await driver.close()
    clock.now_s += WATCHDOG_S + 0.001
    await plant.reaches((0.0, 0.0))


async def test_close_never_raises(board: PumpBoardEmulator) -> None:
    driver = impatient(board)
    await driver.close()
    await driver.open()
    board.faults.silent = True
    await driver.close()
    await driver.close()
    board.faults.silent = False


def _random_fault(source: random.Random) -> Faults:
    if source.random() < 0.85:
        return Faults()
    return source.choice(
        [
            Faults(silent=True),
            Faults(delay_s=0.005),
            Faults(delay_s=0.02),
            Faults(short_reply=True),
            Faults(wrong_function=True),
            Faults(wrong_transaction=True),
            Faults(exception_code=source.choice([2, 4, 6])),
            Faults(hang_up=True),
        ]
    )


async def _reopen(driver: PumpBoard) -> None:
    """Open like an owner, again and again: on a busy machine 10 ms may be short even for a healthy
    board.
    """
    for _ in range(10):
        try:
            await driver.open()
        except LinkError:
            await asyncio.sleep(driver._link.retry_in_s)
        else:
            return
    raise AssertionError("the board cannot be opened any more")


@pytest.mark.parametrize("count", [400, pytest.param(1250, marks=pytest.mark.campaign)])
async def test_no_wrong_value_is_accepted_under_random_faults(
    board: PumpBoardEmulator, plant: CountingPlant, count: int
) -> None:
    source = random.Random(20_260)
    driver = impatient(board, timeout_s=0.01)
    await _reopen(driver)
    accepted = refused = 0
    for _ in range(count):
        seen = plant.counter
        command = BenchCommand(source.randrange(50_001) / 50_000, source.randrange(50_001) / 50_000)
        try:
            board.faults = _random_fault(source)
            reading = await driver.read()
            assert reading.sample_counter > seen
            assert agrees(reading)
            board.faults = _random_fault(source)
            await driver.write(command)
            assert plant.outputs[-1] == (command.pump_fraction, command.vent_fraction)
            accepted += 1
        except LinkError as error:
            refused += 1
            if isinstance(error, LinkDownError):
                board.faults = Faults()
                await _reopen(driver)
    board.faults = Faults()
    assert accepted > 0.4 * count
    assert refused > 0.12 * count
    await driver.close()
