"""Who is kept out: half a handshake, a crowd, a flood. Another address still gets in."""

from __future__ import annotations

import asyncio
import contextlib
import random
import socket
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from port_certificates import Authority
from test_port_tls import address_of, greet

from membrane_ctrl.config.port import PortConfig, TlsConfig
from membrane_ctrl.control_port.client import PortClient
from membrane_ctrl.control_port.endpoint import Endpoint, LetIn, Turns
from membrane_ctrl.control_port.sockets import client_context, listen_tcp
from tests.worlds.port_run import PortRun, client, port_run


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    return Authority.new(tmp_path_factory.mktemp("endpoint") / "lab")


@pytest.fixture(scope="module")
def config(lab: Authority) -> PortConfig:
    certificate, key = lab.certificate("bench")
    files = {
        "certificate_file": str(certificate),
        "key_file": str(key),
        "client_ca_file": str(lab.own),
    }
    return PortConfig(tls=TlsConfig(port=0, **files))  # type: ignore[arg-type]


Crowd = list[tuple[asyncio.StreamReader, asyncio.StreamWriter]]


@contextlib.asynccontextmanager
async def strangers(run: PortRun, addresses: list[str]) -> AsyncIterator[Crowd]:
    """Silent connections, one from each address."""
    crowd: Crowd = []
    try:
        for address in addresses:
            with contextlib.suppress(ConnectionError):  # refused before it was connected
                crowd.append(
                    await asyncio.open_connection(*address_of(run), local_addr=(address, 0))
                )
            await asyncio.sleep(0)
        yield crowd
    finally:
        for _, writer in crowd:
            writer.close()
            with contextlib.suppress(ConnectionError):
                await writer.wait_closed()


async def dropped(crowd: Crowd, at_least: int) -> None:
    """Wait until so many are dropped."""
    reads = [asyncio.create_task(reader.read()) for reader, _ in crowd]
    try:
        async with asyncio.timeout(10):
            while sum(task.done() for task in reads) < at_least:
                await asyncio.wait(
                    [task for task in reads if not task.done()], return_when=asyncio.FIRST_COMPLETED
                )
    finally:
        for task in reads:
            task.cancel()
        await asyncio.gather(*reads, return_exceptions=True)


@pytest.mark.parametrize(
    "addresses",
    [["127.0.0.2"] * 40, [f"127.0.{n}.2" for n in range(40)]],
    ids=["one address", "forty addresses"],
)
async def test_who_does_not_shake_hands_keeps_nobody_out(
    addresses: list[str],
    tmp_path: Path,
    lab: Authority,
    config: PortConfig,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        "membrane_ctrl.control_port.protocol._HANDSHAKE_S", 60.0
    )  # none of them times out
    pair = lab.certificate(f"ann{len(set(addresses))}", "operate")
    async with port_run(tmp_path, config) as run, strangers(run, addresses) as crowd:
        greeting = await asyncio.to_thread(greet, run, pair, lab.own)
        assert greeting["role"] == "operate"
        await dropped(crowd, len(crowd) - 16)


async def test_newcomers_of_the_strangers_own_address_get_in_too(
    tmp_path: Path, lab: Authority, config: PortConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("membrane_ctrl.control_port.protocol._HANDSHAKE_S", 60.0)
    pair = lab.certificate("bob", "operate")
    async with port_run(tmp_path, config) as run, strangers(run, ["127.0.0.1"] * 8):
        assert (await asyncio.to_thread(greet, run, pair, lab.own))["role"] == "operate"
        assert any(
            event["reason"].startswith("did not identify itself")
            for event in run.of_kind("refused")
        )


async def test_who_has_shaken_hands_is_no_stranger_any_more(
    tmp_path: Path, lab: Authority, config: PortConfig
) -> None:
    """Sessions of one address beyond the limit for strangers stay."""
    pairs = [lab.certificate(f"member{n}", "read") for n in range(6)]
    async with port_run(tmp_path, config) as run:

        def all_in() -> int:
            with contextlib.ExitStack() as stack:
                host, port = address_of(run)
                clients = [
                    stack.enter_context(
                        PortClient.tls(host, port, client_context(*pair, lab.own), print)
                    )
                    for pair in pairs
                ]
                return sum(bool(c.ask(do="status")["ok"]) for c in clients)

        assert await asyncio.to_thread(all_in) == 6
        assert run.of_kind("refused") == []


async def test_a_flood_of_one_address_is_turned_away_unheard() -> None:
    heard: list[str] = []
    refused: list[tuple[str, str]] = []
    all_seen = asyncio.Event()

    async def welcome(connection: socket.socket, let_in: LetIn) -> None:
        let_in()
        heard.append(connection.getpeername()[0])
        if heard[-1] == "127.0.0.4":
            all_seen.set()

    listener = listen_tcp("127.0.0.1", 0, "test")
    endpoint = Endpoint(
        "tls", listener, welcome, lambda event: None, lambda who, why: refused.append((who, why))
    )
    endpoint.open()
    for address in ["127.0.0.3"] * 40 + ["127.0.0.4"]:
        with contextlib.suppress(ConnectionError):
            _, writer = await asyncio.open_connection(
                *listener.getsockname(), local_addr=(address, 0)
            )
            writer.close()
            await writer.wait_closed()
    await asyncio.wait_for(all_seen.wait(), 10)
    await endpoint.close()
    assert heard.count("127.0.0.4") == 1
    assert 10 <= heard.count("127.0.0.3") <= 35
    assert refused == [("tls:127.0.0.3", "connects too often")] * (40 - heard.count("127.0.0.3"))


async def test_the_socket_file_has_no_part_in_it(tmp_path: Path, config: PortConfig) -> None:
    async with port_run(tmp_path, config) as run, strangers(run, ["127.0.0.1"] * 20):
        for _ in range(40):
            async with client(run) as one:
                assert (await one.ask(do="status"))["ok"]


def test_turns_come_back_with_time_and_memory_is_bounded() -> None:
    now_s = 0.0
    turns = Turns(lambda: now_s)
    assert [turns.take("a") for _ in range(12)] == [True] * 10 + [False] * 2
    assert turns.take("b")
    now_s = 0.5
    assert [turns.take("a"), turns.take("a")] == [True, False]
    now_s = 1000.0
    assert [turns.take("a") for _ in range(12)] == [True] * 10 + [False] * 2
    chance = random.Random(1)
    for _ in range(5000):
        turns.take(str(chance.random()))
    assert len(turns._left) == 1024
    assert turns.take("a")
