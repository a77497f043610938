"""The C firmware passes the conformance test: in memory, and as a program on a pseudo terminal and
on TCP.
"""

from __future__ import annotations

import asyncio
import math
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from firmware_iface.board_settings import make_record
from firmware_iface.conformance import Conformance, examine
from firmware_iface.drivers.pump_board import PumpBoard
from firmware_iface.roles import BenchCommand
from tests.board.build_board import built
from tests.board.film_wire import FilmWire
from tests.board.still_film import StillFilm
from tests.board.virtual_board import AT_REST, NO_VALUE, SETTINGS, VirtualBoard, VirtualLink
from tests.support.machine_needs import needs

_FINDINGS = 22


async def test_the_firmware_conforms(virtual_board: VirtualBoard) -> None:
    virtual_board.set_inputs(AT_REST)
    link = VirtualLink(virtual_board)
    findings = await Conformance(link, link.sleep).run()
    assert [(found.check, found.problem) for found in findings if found.problem] == []
    assert len(findings) == _FINDINGS


async def test_the_firmware_s_guard_of_its_gauge_conforms(firmware_library: Path) -> None:
    board = VirtualBoard(firmware_library, {**SETTINGS, "gauge_timeout_s": 2.5})
    board.set_inputs([AT_REST[0], NO_VALUE, *AT_REST[2:]])
    link = VirtualLink(board)
    findings = await Conformance(link, link.sleep).run()
    assert {found.check: found.problem[:40] for found in findings if found.problem} == {
        "all other requirements": "not run: the fitted gauge has no value; "
    }
    assert [found.section for found in findings] == [
        "Registers",
        "Registers",
        "Gauge",
        "Gauge",
        "The conformance test",
    ]


async def test_the_firmware_s_interlocks_conform(firmware_library: Path) -> None:
    board = VirtualBoard(firmware_library, {**SETTINGS, "interlocks_fitted": [0, 3]})
    board.set_inputs(AT_REST)
    board.set_interlocks(0b0111)
    link = VirtualLink(board)
    findings = await Conformance(link, link.sleep).run()
    assert {found.check: found.problem[:40] for found in findings if found.problem} == {
        "all other requirements": "not run: interlock inputs 0x8 are open; "
    }
    assert [found.section for found in findings][1:-1] == ["Registers", "Interlocks", "Interlocks"]


@pytest.fixture(scope="session")
def host_program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built("board", tmp_path_factory.mktemp("host"), "cc")


@pytest.fixture
def host_board(host_program: Path, tmp_path: Path) -> Iterator[dict[str, str]]:
    """The firmware as a program: where its line, its TCP port and its film are."""
    settings = tmp_path / "settings.bin"
    settings.write_bytes(make_record({**SETTINGS, "silence_us": 50_000}))
    with subprocess.Popen(
        [str(host_program), str(settings)], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        words = process.stdout.readline().split()
        yield dict(zip(words[::2], words[1::2], strict=True))
        process.terminate()
        assert process.wait(5) == 0


@pytest.mark.real_time
async def test_the_host_program_conforms_on_both_lines(host_board: dict[str, str]) -> None:
    for url in (
        f"tcp://127.0.0.1:{host_board['tcp']}",
        f"rtu://{host_board['rtu']}?baud=115200&parity=N",
    ):
        findings = await examine(url, timeout_s=4.0)  # a busy machine pauses
        assert [(found.check, found.problem) for found in findings if found.problem] == []
        assert len(findings) == _FINDINGS


def test_the_host_program_names_what_is_wrong(host_program: Path, tmp_path: Path) -> None:
    missing = tmp_path / "none.bin"
    found = subprocess.run(
        [str(host_program), str(missing)], capture_output=True, text=True, check=False
    )
    assert (found.returncode, found.stdout) == (4, "")
    assert "none.bin: No such file" in found.stderr


def _tcp(host_board: dict[str, str]) -> socket.socket:
    client = socket.create_connection(("127.0.0.1", int(host_board["tcp"])), timeout=10)
    client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return client


@pytest.mark.real_time
def test_tcp_clients_of_every_kind(host_board: dict[str, str]) -> None:
    ask = bytes.fromhex("000700000006010300000001")
    answer = bytes.fromhex("0007000000050103024d42")
    clients = [_tcp(host_board) for _ in range(5)]  # one more than the board serves
    for client in clients[1:]:
        client.sendall(ask + ask[:5])
        assert client.recv(64) == answer
        client.sendall(ask[5:])
        assert client.recv(64) == answer
    assert clients[0].recv(64) == b""  # the longest idle made place
    clients[1].sendall(bytes.fromhex("000800000006090300000001"))
    assert clients[1].recv(64) == bytes.fromhex("00080000000309830b")
    for client, junk in zip(
        clients[2:], ("47455420", "00010000ffff01", "000100000001010000"), strict=True
    ):
        client.sendall(bytes.fromhex(junk).ljust(7, b"\r"))
        assert client.recv(64) == b""
    for client in clients:
        client.close()


@pytest.mark.real_time
@needs("mbpoll")
@pytest.mark.parametrize("line", ["rtu", "tcp"])
def test_a_client_that_is_not_ours_reads_and_stops(host_board: dict[str, str], line: str) -> None:
    """mbpoll, over libmodbus."""
    mode = (
        ["-m", "rtu", "-b", "115200", "-P", "none"]
        if line == "rtu"
        else ["-m", "tcp", "-p", host_board["tcp"]]
    )
    target = host_board["rtu"] if line == "rtu" else "127.0.0.1"
    base = ["mbpoll", *mode, "-a", "1", "-0", "-o", "5"]

    def polled(address: int, *written: str) -> str:
        words = [*base, "-r", str(address), "-t", "4:hex", "-1", target, *written]
        return subprocess.run(words, check=True, capture_output=True, text=True).stdout

    assert "0x4D42" in polled(0)
    assert "0x0000" in polled(37)
    assert "Written 1 references" in polled(72, "0x0001")
    assert "0x0004" in polled(37)


@pytest.mark.real_time
async def test_the_host_program_has_a_film(host_program: Path, tmp_path: Path) -> None:
    film = StillFilm()
    wire = FilmWire(film)
    await wire.start()
    settings = tmp_path / "settings.bin"
    settings.write_bytes(make_record(SETTINGS))
    process = await asyncio.create_subprocess_exec(
        str(host_program), str(settings), str(wire.port), stdout=asyncio.subprocess.PIPE
    )
    assert process.stdout is not None
    words = (await process.stdout.readline()).decode().split()
    driver = PumpBoard(f"tcp://127.0.0.1:{words[3]}", timeout_s=2.0, watchdog_s=10.0)
    await driver.open()
    while math.isnan((reading := await driver.read()).gauge_pressure_pa):
        continue
    assert (reading.displacement_um, reading.gauge_pressure_pa, reading.gas_temperature_c) == (
        12.5,
        100.0,
        22.0,
    )
    await driver.write(BenchCommand(0.5, 0.25))
    await film.until(lambda: (film.pump, film.vent) == (0.5, 0.25))
    film.gauge_pressure_pa = 801.0
    await film.until(lambda: (film.pump, film.vent) == (0.0, 1.0))
    await driver.close()
    process.terminate()
    await process.wait()
    await wire.stop()
