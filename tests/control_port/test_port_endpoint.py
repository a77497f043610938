"""A crowd at the socket file is bounded, and who comes later still gets in."""

from __future__ import annotations

import asyncio
import socket
from pathlib import Path

from membrane_ctrl.control_port.endpoint import Endpoint
from membrane_ctrl.control_port.sockets import UnixListener
from tests.worlds.port_run import client, port_run


async def test_silent_clients_leave_room_for_others(tmp_path: Path) -> None:
    async with port_run(tmp_path) as run:
        for _ in range(40):
            async with client(run) as one:
                assert (await one.ask(do="status"))["ok"]


async def test_more_clients_than_there_is_room_for_are_turned_away(tmp_path: Path) -> None:
    refused: list[tuple[str, str]] = []
    leave = asyncio.Event()
    heard: list[socket.socket] = []

    async def welcome(connection: socket.socket) -> None:
        heard.append(connection)
        await leave.wait()

    listener = UnixListener(tmp_path / "s", None, "operate")
    endpoint = Endpoint(
        "unix",
        listener.socket,
        welcome,
        lambda event: None,
        lambda who, why: refused.append((who, why)),
    )
    endpoint.open()
    clients = []
    try:
        for _ in range(40):
            _, writer = await asyncio.open_unix_connection(str(tmp_path / "s"))
            clients.append(writer)
        async with asyncio.timeout(30.0):
            while len(heard) + len(refused) < 40:  # noqa: ASYNC110
                await asyncio.sleep(0.05)
        assert refused == [("unix", "too many connections")] * 8
        leave.set()
        _, writer = await asyncio.open_unix_connection(str(tmp_path / "s"))
        clients.append(writer)
        async with asyncio.timeout(30.0):
            while len(heard) < 33:  # noqa: ASYNC110
                await asyncio.sleep(0.05)
    finally:
        for writer in clients:
            writer.close()
        await endpoint.close()
        listener.close()
