"""Wiring stages on instruments behind real sockets and serial lines, emulated byte by byte.

The session uses `RealBench`: drivers, claims, software watchdog and time are those of a laboratory.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Coroutine, Iterator
from pathlib import Path
from typing import Any, TypeVar

import pytest

from firmware_iface.emulators.input_module import InputModule
from firmware_iface.emulators.modbus_server import Answer, ModbusTcpServer
from membrane_ctrl.commissioning.guide.bench_access import HandAct, HandMotion
from membrane_ctrl.commissioning.guide.instrument_lab import SteppedPlant
from membrane_ctrl.commissioning.guide.real_bench import RealBench
from membrane_ctrl.commissioning.guide.session_state import CheckVerdict, write_tables
from membrane_ctrl.config.schema import Config, DevicesConfig
from membrane_ctrl.model.errors import Exit
from membrane_ctrl.sim import lab, plant
from tests.commissioning.guided import Person, run_stages, state_of

T = TypeVar("T")
PUMP = "/dev/pump"
SINGLE = {
    "displacement": {"driver": "optoncdt1420", "port": "/dev/laser"},
    "pump": {"driver": "ventus", "port": PUMP},
    "gauge_pressure": {"driver": "mks_937b", "port": "/dev/gauge"},
    "vent": {
        "driver": "modbus_map",
        "link": "tcp://valve",
        "address": 0,
        "raw": [0, 20000],
        "value": [0, 1],
    },
}
TIMES = {"timeout_s": 1.0}


class Laboratory:
    """Emulated instruments and an interlock module, on a thread of their own."""

    def __init__(self, devices: dict[str, Any]) -> None:
        config = Config()
        twin = config.twin.model_copy(update={"from_flat": True})
        self._plant = SteppedPlant(plant.Plant(twin, config.pump))
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()
        self.lab = lab.Lab(self._plant, DevicesConfig.model_validate(devices))
        self.closed = True
        self.module = InputModule({3: lambda: self.closed}, {})
        self.server = ModbusTcpServer(
            lambda unit, pdu: Answer(self.module.respond(pdu) or b""), "127.0.0.1", 0
        )
        self.devices = self.run(self._start())

    async def _start(self) -> DevicesConfig:
        await self.server.start()
        self._moving = asyncio.create_task(self._plant.keep_moving())
        return await self.lab.start()

    async def _stop(self) -> None:
        self._moving.cancel()
        await asyncio.gather(self._moving, return_exceptions=True)
        await self.lab.stop()
        await self.server.stop()

    def run(self, work: Coroutine[Any, Any, T]) -> T:
        """Run something on the laboratory's thread."""
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(30.0)

    def stop(self) -> None:
        self.run(self._stop())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(10.0)
        self._loop.close()

    @property
    def tables(self) -> dict[str, Any]:
        """The session's configuration."""
        devices = self.devices.model_dump(mode="json", exclude_none=True)
        devices["interlocks"] = [
            {
                "driver": "modbus_input",
                "name": "stop",
                "text": "turn the red button",
                "link": f"tcp://127.0.0.1:{self.server.port}",
                "address": 3,
            }
        ]
        return {"devices": devices, "shape": {"enabled": False}}


class HandsOnBench(RealBench):
    """The person's hands on the emulated instruments."""

    def __init__(self, laboratory: Laboratory) -> None:
        self._laboratory = laboratory

    def move_hand(self, motion: HandMotion) -> None:
        match motion.act:
            case HandAct.PULL_CABLE:
                self._laboratory.run(self._pull())
            case HandAct.PLUG_CABLE:
                self._laboratory.run(self._plug())
            case HandAct.OPEN_CIRCUIT | HandAct.LOSE_SIGNAL:
                self._laboratory.closed = False
            case HandAct.CLOSE_CIRCUIT:
                self._laboratory.closed = True

    async def _pull(self) -> None:
        self._laboratory.lab.wires[PUMP].unplug()

    async def _plug(self) -> None:
        self._laboratory.lab.wires[PUMP].plug()


@pytest.fixture
def laboratory() -> Iterator[Laboratory]:
    made = Laboratory(SINGLE | TIMES)
    yield made
    made.stop()


@pytest.mark.campaign
@pytest.mark.real_time
def test_single_instruments_pass_the_wiring(tmp_path: Path, laboratory: Laboratory) -> None:
    write_tables(tmp_path, laboratory.tables)
    person = Person(**{"cable_stopped": "n", "cable.after": "continue"})
    names = ("gauge_zero", "outputs", "watchdog", "interlocks", "cable")
    code = run_stages(tmp_path, HandsOnBench(laboratory), person, *names)
    failed = {
        check.name
        for record in state_of(tmp_path).records
        for check in record.checks
        if check.verdict == CheckVerdict.FAILED
    }
    # An instrument keeps its flow without its host: only a pump board has a watchdog of its own
    assert failed == {"pump stops when its cable is pulled"}, person.text
    assert code == Exit.REJECTED
    assert "stop open: open: stop" in person.text
