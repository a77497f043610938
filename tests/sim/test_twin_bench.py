"""The bench process end to end: real processes, real sockets, real time (about a second each)."""

from __future__ import annotations

import math
import multiprocessing
import os
import signal
import socket
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess

import pytest

from firmware_iface.register_map import load_default_map
from membrane_ctrl.config.schema import PumpConfig, TwinConfig
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.processes.child import STOP
from membrane_ctrl.processes.ring import RingReader, RingWriter, open_ring
from membrane_ctrl.sim.bench import BenchReport, BenchSpec, LiveBench, serve_bench
from membrane_ctrl.sim.bench_events import AmbientChange
from membrane_ctrl.sim.truth import TRUTH_BYTES, Truth

pytestmark = pytest.mark.real_time

SPAWN = multiprocessing.get_context("spawn")
START_S = 60.0  # a loaded machine imports slowly


def spec(**changes: object) -> BenchSpec:
    defaults: dict[str, object] = {
        "twin": TwinConfig(scenario="calm"),
        "pump": PumpConfig(),
        "clock": RunClock.start(),
        "port": 0,
    }
    return BenchSpec(**(defaults | changes))  # type: ignore[arg-type]


@contextmanager
def bench(what: BenchSpec) -> Iterator[tuple[BaseProcess, BenchReport]]:
    here, there = SPAWN.Pipe()
    process = SPAWN.Process(target=serve_bench, args=(what, there))
    process.start()
    there.close()
    try:
        assert here.poll(START_S), "no report"
        yield process, here.recv()
    finally:
        process.kill()
        process.join()
        here.close()


class Client:
    """Just enough Modbus to read and write blocks."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=START_S)

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def _ask(self, pdu: bytes) -> bytes:
        self._socket.sendall(struct.pack(">HHHB", 1, 0, len(pdu) + 1, 1) + pdu)
        head = self._exactly(7)
        reply = self._exactly(struct.unpack(">HHHB", head)[2] - 1)
        assert reply[0] == pdu[0], reply
        return reply[1:]

    def _exactly(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            more = self._socket.recv(count - len(data))
            assert more, "connection closed"
            data += more
        return data

    def read(self, name: str) -> dict[str, float]:
        block = load_default_map().block(name)
        data = self._ask(struct.pack(">BHH", 3, block.address, block.count))
        return block.decode(struct.unpack(f">{block.count}H", data[1:]))

    def claim(self, period_s: float) -> None:
        claim = {"claim_id": 1.0, "claim_key": 2.0}
        self.write("settings", {"watchdog_period_s": period_s, "watchdog_arm": 1.0, **claim})

    def command(self, pump: float) -> None:
        values = {
            "pump_command_fraction": pump,
            "vent_command_fraction": 0.0,
            "heartbeat": 1.0,
            "command_key": 2.0,
        }
        self.write("command", values)

    def write(self, name: str, values: dict[str, float]) -> None:
        block = load_default_map().block(name)
        words = block.encode(values)
        head = struct.pack(">BHHB", 16, block.address, block.count, 2 * block.count)
        self._ask(head + struct.pack(f">{block.count}H", *words))


def test_serves_the_plant_in_real_time_and_publishes_the_truth() -> None:
    clock = RunClock.start()
    with (
        open_ring(4096, TRUTH_BYTES) as address,
        bench(spec(clock=clock, truth=address)) as (process, report),
        Client(report.port) as client,
    ):
        assert report.error == ""
        reader = RingReader(address)
        started_s, first = clock.now(), client.read("sensors")
        client.claim(10.0)
        client.command(1.0)
        time.sleep(1.0)
        last = client.read("sensors")
        truths = [Truth.unpack(message) for message in reader.drain()]
        ended_s = clock.now()  # the last truth is later than the last reading
        reader.close()
        assert process.pid is not None
        os.kill(process.pid, STOP)
        process.join(START_S)
        assert process.exitcode == 0
    device_s = device_time_s(last) - device_time_s(first)
    assert 0.5 < device_s < ended_s  # a virtual clock tests how exactly time is kept
    assert last["sample_counter"] - first["sample_counter"] == pytest.approx(
        device_s / 0.005, abs=1.01
    )
    assert last["pump_readback_fraction"] == 1.0
    assert max(truth.pump_um_per_s for truth in truths) == pytest.approx(5.3, rel=0.05)
    stamps = [truth.time_s for truth in truths]
    assert stamps == sorted(set(stamps))
    # what the last reading saw is among the published
    assert min(abs(truth.displacement_um - last["displacement_um"]) for truth in truths) < 6.0
    assert started_s < stamps[-1] <= ended_s


def device_time_s(sensors: dict[str, float]) -> float:
    return sensors["device_time_s"] + sensors["device_time_fraction_s"]


def test_a_powered_up_board_does_not_pump() -> None:
    with bench(spec()) as (_, report), Client(report.port) as client:
        assert client.read("sensors")["pump_readback_fraction"] == 0.0


def test_a_busy_port_is_one_line_and_an_end() -> None:
    with socket.create_server(("127.0.0.1", 0)) as busy:
        port = busy.getsockname()[1]
        with bench(spec(port=port)) as (process, report):
            assert f"twin.port = {port}" in report.error
            assert "\n" not in report.error
            process.join(START_S)
            assert process.exitcode == 0


def test_beside_another_twin_any_free_port_will_do() -> None:
    with bench(spec()) as (_, first), bench(spec(port=first.port, only_there=False)) as (_, second):
        assert second.error == ""
        assert second.port not in (0, first.port)
        with Client(first.port) as client:  # the first still answers there
            assert client.read("sensors")["pump_readback_fraction"] == 0.0


def test_an_impossible_plant_is_one_line_and_an_end() -> None:
    with bench(spec(pump=PumpConfig(dead_fraction=1.0))) as (process, report):
        assert "dead_fraction" in report.error
        assert report.port == 0
        process.join(START_S)
        assert process.exitcode == 0


def test_ctrl_c_is_for_the_controller() -> None:
    with bench(spec()) as (process, report):
        assert process.pid is not None
        os.kill(process.pid, signal.SIGINT)
        with Client(report.port) as client:
            assert client.read("sensors")["sample_counter"] > 0
        assert process.is_alive()


def _parent(what: BenchSpec, out: Connection) -> None:
    here, there = SPAWN.Pipe()
    process = SPAWN.Process(target=serve_bench, args=(what, there))
    process.start()
    assert here.poll(START_S)
    out.send((process.pid, here.recv()))
    time.sleep(3600)


def test_outlives_its_parent_for_a_while_with_the_watchdog_tripped() -> None:
    here, there = SPAWN.Pipe()
    parent = SPAWN.Process(target=_parent, args=(spec(linger_s=6.0), there))
    parent.start()
    assert here.poll(START_S)
    pid, report = here.recv()
    try:
        with Client(report.port) as client:
            client.claim(2.0)
            client.command(0.5)
            parent.kill()
            parent.join()
            while not (sensors := client.read("sensors"))["watchdog_tripped"]:
                time.sleep(0.05)
            assert sensors["pump_readback_fraction"] == 0.0
        assert gone_within(pid, START_S)
    finally:
        parent.kill()
        parent.join()
        if alive(pid):
            os.kill(pid, signal.SIGKILL)


def alive(pid: int) -> bool:
    """Not ended; an orphan that nobody has waited for is a zombie and counts as ended."""
    try:
        with open(f"/proc/{pid}/stat") as stat:  # noqa: PTH123 - a kernel table, not a file
            return stat.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def gone_within(pid: int, seconds: float) -> bool:
    for _ in range(int(seconds / 0.05)):
        if not alive(pid):
            return True
        time.sleep(0.05)
    return False


class SteppedClock:
    """Stands in for the run's clock."""

    def __init__(self) -> None:
        self.time_s = 100.0

    def now(self) -> float:
        return self.time_s


def live(truth: RingWriter | None = None, **changes: object) -> tuple[LiveBench, SteppedClock]:
    clock = SteppedClock()
    return LiveBench(spec(clock=clock, **changes), truth), clock


def test_plant_time_follows_the_clock_exactly() -> None:
    bench_, clock = live(speed=3.0)
    for _ in range(700):
        clock.time_s += 0.0041
        bench_.catch_up()
    assert bench_.sample().device_time_s == pytest.approx(3 * 700 * 0.0041, abs=0.0051)


def test_a_sample_lasts_until_the_next_is_due() -> None:
    bench_, clock = live()
    first = bench_.sample()
    clock.time_s += 0.004
    bench_.catch_up()
    assert bench_.sample() is first
    clock.time_s += 0.004
    bench_.catch_up()
    assert bench_.sample().sample_counter == first.sample_counter + 1
    assert bench_.sample().displacement_um != first.displacement_um


def test_a_stall_is_caught_up_in_pieces_and_the_counter_counts_all() -> None:
    bench_, clock = live()
    clock.time_s += 60.0
    bench_.catch_up()
    assert bench_.sample().device_time_s == pytest.approx(20.0)
    for _ in range(3):
        bench_.catch_up()
    assert bench_.sample().device_time_s == pytest.approx(60.0)
    assert bench_.sample().sample_counter == 12_001


def test_truth_is_stamped_on_the_runs_clock() -> None:
    with open_ring(8, TRUTH_BYTES) as address:
        writer, reader = RingWriter(address), RingReader(address)
        bench_, clock = live(writer, speed=10.0, events=(AmbientChange(0.0, 20.0),))
        clock.time_s += 2.0
        bench_.catch_up()
        message = reader.latest()
        writer.close()
        reader.close()
    assert message is not None
    truth = Truth.unpack(message)
    assert truth.time_s == pytest.approx(102.0, abs=1e-6)
    assert truth.ambient_pressure_pa == pytest.approx(101_345.0)
    assert math.isfinite(truth.displacement_um)
