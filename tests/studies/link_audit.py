"""Serial links under random faults: how many wrong values they accept, and the largest error.

Link, driver and emulated instrument are real, the wire between them is memory and time is virtual:
late answers and timeouts cost nothing, and every run is the same. A tenth of all questions or
answers is disturbed. Only Modbus TCP uses real sockets and real time.
"""

from __future__ import annotations

import asyncio
import itertools
import math
import random
from collections.abc import Callable, Coroutine, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from firmware_iface.drivers.bronkhorst import BronkhorstFlow
from firmware_iface.drivers.bronkhorst_propar import ProparParameters
from firmware_iface.drivers.keyence_dl_rs1a import KeyenceDlRs1a
from firmware_iface.drivers.optoncdt1420 import Optoncdt1420
from firmware_iface.drivers.vaisala_ptb330 import VaisalaPtb330
from firmware_iface.drivers.ventus import Ventus
from firmware_iface.emulators.modbus_pdu import answer_request
from firmware_iface.emulators.modbus_server import Answer, ModbusTcpServer
from firmware_iface.emulators.pumps import Instrument
from firmware_iface.links.modbus_link import ModbusLink
from firmware_iface.links.modbus_rtu import RtuBus
from firmware_iface.links.modbus_tcp import GuardedModbusTcp
from firmware_iface.links.serial_port import SerialSettings
from firmware_iface.roles import Device, DisplacementSensor, LinkDownError, LinkError, Pump
from firmware_iface.settings import (
    KeyenceDlRs1aConfig,
    Optoncdt1420Config,
    VaisalaPtb330Config,
    VentusConfig,
)
from tests.support.virtual_time import run_virtual
from tests.worlds.faulty_devices import (
    KeyenceDlRs1aEmulator,
    MemoryWire,
    Optoncdt1420Emulator,
    ProparDevice,
    RtuBusEmulator,
    SerialDevice,
    SerialFaults,
    VaisalaPtb330Emulator,
    VentusEmulator,
)

TIMEOUT_S = 0.05
TCP_TIMEOUT_S = 0.01  # of real time
CANCELLED = 0.02  # of all calls
HIT = 0.05  # of all questions, and of all answers


@dataclass(slots=True)
class Audit:
    """Results of the transactions of one link. `worst` is the largest
    error of an accepted value.
    """

    believed: int = 0
    refused: int = 0
    cancelled: int = 0
    wrong: int = 0
    worst: float = 0.0

    @property
    def transactions(self) -> int:
        """All of them."""
        return self.believed + self.refused + self.cancelled

    def judge(self, error: float, tolerance: float) -> None:
        """Count one accepted value."""
        self.believed += 1
        self.worst = max(self.worst, error)
        self.wrong += not error <= tolerance  # NaN is wrong


def random_faults(seed: int) -> Callable[[], SerialFaults]:
    """One fault at a time: late by up to four timeouts, lost, cut, garbage, one to three flipped
    bits.
    """
    dice = random.Random(seed)

    def draw() -> SerialFaults:
        if dice.random() >= HIT:
            return SerialFaults()
        kinds: list[Callable[[], SerialFaults]] = [
            lambda: SerialFaults(silent=True),
            lambda: SerialFaults(deaf=True),
            lambda: SerialFaults(delay_s=dice.uniform(0.0, 4 * TIMEOUT_S)),
            lambda: SerialFaults(cut_bytes=dice.randint(1, 4)),
            lambda: SerialFaults(garbage_bytes=dice.randint(1, 12)),
            lambda: SerialFaults(bit_errors=dice.randint(1, 3)),
            lambda: SerialFaults(question_bit_errors=dice.randint(1, 3)),
        ]
        return dice.choice(kinds)()

    return draw


class _Registers:
    """Of one slave."""

    def __init__(self) -> None:
        self.words = [0] * 16

    def read(self, address: int, count: int) -> list[int]:
        return self.words[address : address + count]

    def write(self, address: int, words: Sequence[int]) -> None:
        self.words[address : address + len(words)] = words


async def _rtu(transactions: int, audit: Audit, seed: int) -> None:
    """Two slaves on one bus."""
    tables = {1: _Registers(), 2: _Registers()}
    slaves = {unit: partial(answer_request, table=table) for unit, table in tables.items()}
    emulator = RtuBusEmulator(SerialSettings(115_200), slaves, echo_test=bool(seed % 2), seed=seed)
    emulator.draw_faults = random_faults(seed)
    bus = RtuBus(MemoryWire(emulator), quiet_s=TIMEOUT_S)
    devices = {unit: bus.device(unit, TIMEOUT_S) for unit in tables}
    await _numbers(devices, tables, transactions, audit, random.Random(seed))
    await devices[1].close()


async def _tcp(transactions: int, audit: Audit, seed: int) -> None:
    """A server that is late, silent, short, of another function or transaction, or hangs up."""
    dice, table = random.Random(seed + 1), _Registers()

    def answer(unit: int, pdu: bytes) -> Answer:
        reply = answer_request(pdu, table)
        if dice.random() >= HIT:
            return Answer(reply)
        kinds: list[Callable[[], Answer]] = [
            lambda: Answer(),
            lambda: Answer(reply, delay_s=dice.uniform(0.0, 4 * TCP_TIMEOUT_S)),
            lambda: Answer(reply, transaction_offset=dice.choice((1, -1))),
            lambda: Answer(bytes([23 if reply[0] == 3 else 6]) + reply[1:]),
            lambda: Answer(
                bytes([3, 2]) + reply[2:4] if reply[0] == 3 else reply[:3] + b"\0" + reply[4:]
            ),
            lambda: Answer(hang_up=True),
        ]
        return dice.choice(kinds)()

    server = ModbusTcpServer(answer, "127.0.0.1", 0)
    await server.start()
    seconds = itertools.count()  # the back-off is over at every look
    device = GuardedModbusTcp(
        "127.0.0.1", server.port, 1, TCP_TIMEOUT_S, clock=lambda: 10.0 * next(seconds)
    )
    await _numbers({1: device}, {1: table}, transactions, audit, random.Random(seed))
    await device.close()
    await server.stop()


async def _numbers(
    devices: Mapping[int, ModbusLink],
    tables: Mapping[int, _Registers],
    transactions: int,
    audit: Audit,
    dice: random.Random,
) -> None:
    """Numbers that never come twice are written and read back, to three places of each device.

    A confirmed write must be in the device. A read must give the number last confirmed at this
    place, or one tried since.
    """
    possible = {(unit, address): {0} for unit in tables for address in (0, 4, 8)}
    number = 0
    while audit.transactions < transactions:
        unit, address = place = dice.choice(list(possible))
        while not devices[unit].connected:
            try:
                await devices[unit].connect()
            except (
                LinkDownError
            ):  # the time-out is short: on a busy machine a connection may take longer
                await asyncio.sleep(TCP_TIMEOUT_S)
        number += 1
        if write := dice.random() < 0.5:
            possible[place].add(number)
            call: Coroutine[Any, Any, Any] = devices[unit].write_registers(
                address, divmod(number, 2**16)
            )
        else:
            call = devices[unit].read_holding(address, 2)
        try:
            words = await _perhaps_cancelled(call, dice)
        except asyncio.CancelledError:
            audit.cancelled += 1
        except LinkError:
            audit.refused += 1
        else:
            found = tables[unit].words[address : address + 2] if write else words
            audit.judge(
                float(found[0] * 2**16 + found[1] not in ({number} if write else possible[place])),
                0.0,
            )
            if write:
                possible[place] = {number}


async def _perhaps_cancelled(call: Coroutine[Any, Any, Any], dice: random.Random) -> Any:
    """The result of a call that is sometimes cancelled in flight. Raises CancelledError then."""
    task = asyncio.ensure_future(call)
    if dice.random() < CANCELLED:
        await asyncio.wait([task], timeout=dice.uniform(0.0, TCP_TIMEOUT_S))
        task.cancel()
    return await task


async def _keyence(transactions: int, audit: Audit, seed: int) -> None:
    """Displacement that ramps at the speed of a fill; wrong is more than the driver's own gate."""
    emulator = KeyenceDlRs1aEmulator(_ramp_um, baud=38_400, parity="E", seed=seed)
    driver = KeyenceDlRs1a(
        KeyenceDlRs1aConfig(port="memory", baud=38_400, parity="E", timeout_s=TIMEOUT_S),
        MemoryWire(emulator),
    )
    await _displacements(driver, emulator, transactions, audit, seed)


async def _optoncdt(transactions: int, audit: Audit, seed: int) -> None:
    """The same with a stream; wrong is more than ten times its noise."""
    emulator = Optoncdt1420Emulator(_ramp_um, noise_um=1.0, seed=seed)
    driver = Optoncdt1420(
        Optoncdt1420Config(port="memory", rate_khz=1.0, step_max_um=10.0, timeout_s=TIMEOUT_S),
        MemoryWire(emulator),
    )
    await _displacements(driver, emulator, transactions, audit, seed)


def _ramp_um() -> float:
    time_s = asyncio.get_running_loop().time()
    return 5.0 * abs(time_s % 400.0 - 200.0) - 500.0


async def _displacements(
    driver: DisplacementSensor, emulator: SerialDevice, transactions: int, audit: Audit, seed: int
) -> None:
    dice = random.Random(seed)
    await driver.open()
    emulator.draw_faults = random_faults(seed)
    while audit.transactions < transactions:
        await asyncio.sleep(0.02)
        try:
            sample = await _perhaps_cancelled(driver.displacement(), dice)
        except asyncio.CancelledError:
            audit.cancelled += 1
        except LinkDownError:
            audit.refused += 1
            await _open_again(driver)
        except LinkError:
            audit.refused += 1
        else:
            if sample.quality:
                audit.refused += 1
            else:
                audit.judge(abs(sample.displacement_um - _ramp_um()), 10.0)
    await driver.close()


async def _ventus(transactions: int, audit: Audit, seed: int) -> None:
    """A disc pump; its power has three decimals."""
    driven = [0.0]
    emulator = VentusEmulator(lambda fraction: driven.__setitem__(0, fraction), seed=seed)
    driver = Ventus(VentusConfig(port="memory", timeout_s=TIMEOUT_S), MemoryWire(emulator))
    await _pump(driver, emulator, driven, 1e-5, transactions, audit, seed)


async def _propar(transactions: int, audit: Audit, seed: int) -> None:
    """A flow controller with steps of 1/32000, on a line without checksums."""
    driven = [0.0]
    flow = Instrument(
        "DMFC", "M1", 360.0, "mln/min", actuate=lambda fraction: driven.__setitem__(0, fraction)
    )
    emulator = ProparDevice(flow, SerialSettings(38_400), seed=seed)
    driver = BronkhorstFlow(ProparParameters(MemoryWire(emulator), timeout_s=TIMEOUT_S))
    await _pump(driver, emulator, driven, 1 / 32_000, transactions, audit, seed)


async def _pump(
    driver: Pump,
    emulator: SerialDevice,
    driven: list[float],
    tolerance: float,
    transactions: int,
    audit: Audit,
    seed: int,
) -> None:
    """A confirmed command must drive the gas (`driven[0]`, 0..1)."""
    dice = random.Random(seed)
    await driver.open()
    emulator.draw_faults = random_faults(seed)
    while audit.transactions < transactions:
        fraction = dice.choice((0.0, dice.random()))
        try:
            if dice.random() < 0.5:
                await _perhaps_cancelled(driver.set_pump(fraction), dice)
            else:
                fraction = await _perhaps_cancelled(driver.pump_fraction(), dice)
        except asyncio.CancelledError:
            audit.cancelled += 1
        except LinkDownError:
            audit.refused += 1
            await _open_again(driver)
        except LinkError:
            audit.refused += 1
        else:
            audit.judge(abs(fraction - driven[0]), tolerance)
    await driver.close()


async def _ptb330(transactions: int, audit: Audit, seed: int) -> None:
    """Pressure that rises and falls; message and age together may be off by its change in three
    seconds.
    """

    def pressure_pa() -> float:
        return 101_325.0 + 0.1 * abs(asyncio.get_running_loop().time() % 4000.0 - 2000.0)

    emulator = VaisalaPtb330Emulator(pressure_pa, seed=seed)
    driver = VaisalaPtb330(
        VaisalaPtb330Config(port="memory", timeout_s=TIMEOUT_S, period_s=0.1), MemoryWire(emulator)
    )
    await driver.open()
    emulator.draw_faults = random_faults(seed)
    while audit.transactions < transactions:
        await asyncio.sleep(0.2)
        try:
            found_pa = await driver.ambient_pressure_pa()
        except LinkDownError:
            audit.refused += 1
            await _open_again(driver)
        else:
            if math.isnan(found_pa):
                audit.refused += 1
            else:
                audit.judge(abs(found_pa - pressure_pa()), 0.5)
    await driver.close()


async def _open_again(driver: Device) -> None:
    while True:
        try:
            await driver.open()
            return
        except LinkError:
            await asyncio.sleep(0.02)


LINKS = {
    "Modbus TCP": (_tcp, ""),
    "Modbus RTU": (_rtu, ""),
    "optoNCDT 1420": (_optoncdt, "um"),
    "Keyence DL-RS1A": (_keyence, "um"),
    "ProPar": (_propar, ""),
    "Ventus": (_ventus, ""),
    "PTB330": (_ptb330, "Pa"),
}
REAL_TIME = ("Modbus TCP",)


def audit(name: str, transactions: int, seed: int = 1) -> Audit:
    """Run `transactions` on one link under random faults."""
    result = Audit()
    main = LINKS[name][0](transactions, result, seed)
    asyncio.run(main) if name in REAL_TIME else run_virtual(main)
    return result
