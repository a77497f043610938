"""The emulated board over a real socket, seen by a plain Modbus client."""

from __future__ import annotations

import re
from collections.abc import AsyncIterator

import pytest
from counting_plant import CountingPlant, ManualClock
from pymodbus.client import AsyncModbusTcpClient

from firmware_iface.generate import DOCS_PATH
from firmware_iface.register_map import load_default_map
from tests.worlds.faulty_board import PumpBoardEmulator

DOCS = DOCS_PATH.read_text(encoding="utf-8")
ROW = re.compile(r"\| (\d+) \| `(\w+)` \| (\w\d\d) \| \S+ \| (\d+) \|")

KEY = [0x1234, 0x5678]
CLAIM = [500, 1, 0, 7, *KEY]  # period, armed, id, key


@pytest.fixture
async def client(board: PumpBoardEmulator) -> AsyncIterator[AsyncModbusTcpClient]:
    plain = AsyncModbusTcpClient(
        "127.0.0.1", port=board.port, timeout=5, retries=0, reconnect_delay=0
    )
    assert await plain.connect()
    yield plain
    plain.close()


async def _documented(client: AsyncModbusTcpClient, docs: str) -> dict[str, float]:
    """Every register of the documentation, read as the documentation says."""
    kinds = {"u16": client.DATATYPE.UINT16, "u32": client.DATATYPE.UINT32}
    kinds |= {"i32": client.DATATYPE.INT32, "f32": client.DATATYPE.FLOAT32}
    values = {}
    for address, name, kind, counts in ROW.findall(docs):
        words = 1 if kind == "u16" else 2
        reply = await client.read_holding_registers(int(address), count=words, device_id=1)
        raw = client.convert_from_registers(reply.registers, kinds[kind], word_order="big")
        assert isinstance(raw, int | float)
        values[name] = raw / int(counts)
    return values


async def test_a_plain_client_reads_the_documented_values(
    board: PumpBoardEmulator, plant: CountingPlant, client: AsyncModbusTcpClient
) -> None:
    board.faults.frozen = True  # so that all reads see the same sample
    sample = board._sample
    values = await _documented(client, DOCS)
    assert set(values) == {register.name for register in load_default_map()}
    assert values["displacement_um"] == pytest.approx(sample.displacement_um, abs=0.0005)
    assert values["ambient_pressure_pa"] == pytest.approx(sample.ambient_pressure_pa, abs=0.0005)
    assert values["gas_temperature_c"] == -3.125
    assert values["sample_counter"] == sample.sample_counter
    assert values["device_kind"] == 0x4D42
    assert values["gauge_pressure_limit_pa"] == 800.0


@pytest.mark.parametrize(
    ("address", "words", "code"),
    [(56, [50_001, 0, 1, 0, 1], 3), (56, [1], 2), (16, [0, 0], 2), (200, [1], 2)],
)
async def test_wrong_writes_get_an_exception(
    board: PumpBoardEmulator,
    client: AsyncModbusTcpClient,
    address: int,
    words: list[int],
    code: int,
) -> None:
    reply = await client.write_registers(address, words, device_id=1)
    assert reply.isError()
    assert reply.exception_code == code
    assert board.state.pump_fraction == 0.0


async def test_function_codes_6_and_23_reach_the_registers(
    plant: CountingPlant, board: PumpBoardEmulator, client: AsyncModbusTcpClient
) -> None:
    assert not (await client.write_registers(48, CLAIM, device_id=1)).isError()
    reply = await client.readwrite_registers(
        read_address=32, read_count=2, address=56, values=[10_000, 5_000, 1, *KEY], device_id=1
    )
    assert reply.registers == [10_000, 5_000]
    assert plant.outputs[-1] == (0.2, 0.1)
    assert not (await client.write_register(72, 1, device_id=1)).isError()
    assert plant.outputs[-1] == (0.0, 0.1)


async def test_another_unit_is_not_there(
    board: PumpBoardEmulator, client: AsyncModbusTcpClient
) -> None:
    reply = await client.read_holding_registers(0, count=1, device_id=2)
    assert reply.exception_code == 11


async def test_the_plant_is_driven_off_at_start_and_at_stop(
    plant: CountingPlant, clock: ManualClock
) -> None:
    emulator = PumpBoardEmulator(plant, clock=clock)
    await emulator.start()
    assert plant.outputs == [(0.0, 0.0)]
    emulator.state.write(48, CLAIM)
    emulator.state.write(56, [50_000, 10_000, 1, *KEY])
    await plant.reaches((1.0, 0.2))
    await emulator.stop()
    assert plant.outputs[-1] == (0.0, 0.2)
    await emulator.stop()  # a second time is nothing


async def test_a_failing_plant_is_not_hidden(
    plant: CountingPlant, clock: ManualClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    emulator = PumpBoardEmulator(plant, clock=clock)
    await emulator.start()

    def broken(pump_fraction: float, vent_fraction: float) -> None:
        plant.actuated.set()
        raise RuntimeError("wire off")

    plant.actuated.clear()
    monkeypatch.setattr(plant, "actuate", broken)
    emulator.state.write(48, CLAIM)
    emulator.state.write(56, [50_000, 0, 1, *KEY])
    await plant.actuated.wait()
    with pytest.raises(RuntimeError, match="wire off"):
        await emulator.stop()
