"""The supervisor takes snapshots of the controller, and a replay can begin with one."""

from __future__ import annotations

import json
from contextlib import ExitStack

import pytest

from firmware_iface.roles import NO_LINK_STATE, BenchCommand, BenchIdentity, BenchReading, LinkState
from membrane_ctrl.config.schema import Config
from membrane_ctrl.controller.controller import Controller
from membrane_ctrl.controller.snapshot import continue_from
from membrane_ctrl.controller.tick_assembler import TickAssembler
from membrane_ctrl.controller.tick_codec import MESSAGE_BYTES, SNAPSHOT_MESSAGE_BYTES
from membrane_ctrl.hold.supervisor import Supervisor, Wiring, newest_of
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.errors import Exit
from membrane_ctrl.model.event_lines import from_dict
from membrane_ctrl.model.telemetry import ROW_BYTES
from membrane_ctrl.processes.ring import RingReader, RingWriter, open_ring
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.virtual_bench import VirtualBench

CONFIG = Config()


class PromptBench:
    """A bench whose board answers at once; its plant stands still."""

    def __init__(self) -> None:
        self._bench = VirtualBench(Plant(CONFIG.twin, CONFIG.pump))
        self._bench.open()

    async def open(self) -> BenchIdentity:
        raise AssertionError("the link was never lost")

    async def read(self) -> BenchReading:
        return self._bench.read()

    async def write(self, command: BenchCommand) -> None:
        self._bench.write(command)

    async def clear_faults(self, mask: int) -> None:
        raise AssertionError("nothing is latched")

    def dead_guards(self) -> tuple[str, ...]:
        return ()

    def link_state(self) -> LinkState:
        return NO_LINK_STATE

    async def close(self) -> None:
        self._bench.close()


async def test_the_snapshot_is_the_one_before_its_tick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("membrane_ctrl.hold.supervisor.SNAPSHOT_EVERY_S", 0.1)
    with ExitStack() as stack:
        sizes = {
            "telemetry": (2000, ROW_BYTES),
            "events": (2000, 4096),
            "inputs": (2000, MESSAGE_BYTES),
            "snapshots": (8, SNAPSHOT_MESSAGE_BYTES),
        }
        addresses = {name: stack.enter_context(open_ring(*size)) for name, size in sizes.items()}
        writers = {name: RingWriter(address) for name, address in addresses.items()}
        inputs, snapshots = RingReader(addresses["inputs"]), RingReader(addresses["snapshots"])
        for end in (*writers.values(), inputs, snapshots):
            stack.callback(end.close)
        controller = Controller(CONFIG, zernike_projection())
        supervisor = Supervisor(
            controller, Wiring(bench=PromptBench(), **writers), RunClock.start(), 50.0
        )
        assert await supervisor.run(0.4) == Exit.DONE
        assembler = TickAssembler()
        assembler.add_snapshots(snapshots.drain())
        batch = assembler.add_messages(inputs.drain())
    assert batch.snapshots
    for tick, snapshot in batch.snapshots.items():
        assert continue_from(snapshot, CONFIG, zernike_projection()).memory.ticks == tick - 1


def test_an_event_that_is_too_long_for_its_slot_is_cut() -> None:
    with ExitStack() as stack:
        address = stack.enter_context(open_ring(4, 4096))
        writer, reader = RingWriter(address), RingReader(address)
        for end in (writer, reader):
            stack.callback(end.close)
        wiring = Wiring(bench=PromptBench(), telemetry=writer, events=writer)
        supervisor = Supervisor(
            Controller(CONFIG, zernike_projection()), wiring, RunClock.start(), 50.0
        )
        texts = dict.fromkeys(
            ("cause", "seen", "limit", "remedy"), "\N{LOUDLY CRYING FACE}" * 10_000
        )
        supervisor.record_event(from_dict({"kind": "fault", "name": "tick_error", **texts}))
        (messages,) = reader.drain()
    assert json.loads(messages)["name"] == "tick_error"


async def test_an_unreadable_shape_is_reported_once_and_the_hold_continues() -> None:
    with ExitStack() as stack:
        addresses = {
            name: stack.enter_context(open_ring(64, 4096))
            for name in ("telemetry", "events", "shapes")
        }
        writers = {name: RingWriter(address) for name, address in addresses.items()}
        shapes, events = RingReader(addresses["shapes"]), RingReader(addresses["events"])
        for end in (*writers.values(), shapes, events):
            stack.callback(end.close)

        def truth() -> tuple[float, float]:
            writers["shapes"].put(b"{}\nno shape")
            return 0.0, 0.0

        wiring = Wiring(
            PromptBench(),
            writers["telemetry"],
            writers["events"],
            shapes=newest_of(shapes),
            truth=truth,
        )
        supervisor = Supervisor(
            Controller(CONFIG, zernike_projection()), wiring, RunClock.start(), 50.0
        )
        assert await supervisor.run(0.2) == Exit.DONE
        reported = [
            event
            for event in map(json.loads, events.drain())
            if event["kind"] == "shape_unreadable"
        ]
    assert supervisor.ticks > 3
    assert [event["message"] for event in reported] == [
        "shape estimate: missing or unknown fields in the first line"
    ]
