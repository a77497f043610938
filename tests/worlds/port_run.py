"""A run for a port: ticks that answer at once, and clients with names from the test."""

from __future__ import annotations

import asyncio
import json
import socket
from collections.abc import AsyncIterator
from concurrent.futures import Future
from contextlib import ExitStack, asynccontextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from firmware_iface.roles import BenchCommand
from membrane_ctrl.config.port import PortConfig
from membrane_ctrl.config.schema import Config, LoopConfig, PumpConfig
from membrane_ctrl.control_port.sender import Peer
from membrane_ctrl.control_port.server import Port, RunHooks
from membrane_ctrl.control_port.sockets import Listeners, UnixListener
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.commands import explain_refusal
from membrane_ctrl.controller.tick import TickOutputs
from membrane_ctrl.model.events import Event, EventLine
from membrane_ctrl.model.telemetry import FIELDS, State, TelemetryRow

PATIENCE_S = 10.0
ROW = replace(
    TelemetryRow(*(0.0 for _ in FIELDS)), mono_s=12.0, tick=600.0, state=State.HOLD, error_um=0.25
)


class NamedListener(UnixListener):
    """The test names the next client."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, None, "operate")
        self.next_peer: Peer | None = None

    def peer(self, connection: socket.socket) -> Peer:
        return self.next_peer or super().peer(connection)


class PortRun:
    """A port whose commands a tick takes at the loop's next round, or never (`ticking`)."""

    def __init__(self, folder: Path, config: PortConfig | None = None) -> None:
        self.config = Config()
        self.state = State.HOLD
        self.ticking = True
        self.now_s = 100.0
        self.asked: list[Command] = []
        self.events: list[EventLine] = []
        self._asked = asyncio.Event()
        self.loop = LoopConfig()
        self.path = folder / "control.sock"
        self._stack = ExitStack()
        port_config = config or PortConfig()
        self.listener = NamedListener(self.path)
        self._stack.callback(self.listener.close)
        self.listeners = Listeners(self.listener, self.path)
        self.outcomes: dict[int, Future[str]] = {}  # of storing locks, by number of the command
        hooks = RunHooks(
            self._ask,
            self._record_event,
            lambda: self.now_s,
            lambda: self.loop,
            PumpConfig,
            self.outcomes.get,
        )
        self.port = Port(port_config, self.listeners, "the-run", hooks)

    async def somebody_asked(self) -> None:
        await asyncio.wait_for(self._asked.wait(), PATIENCE_S)

    def close(self) -> None:
        self._stack.close()

    def _record_event(self, event: Event) -> None:
        self.events.append(event.to_dict())

    def _ask(self, command: Command) -> None:
        self.asked.append(command)
        self._asked.set()
        if self.ticking:
            asyncio.get_running_loop().call_soon(self._tick, command)

    def _tick(self, command: Command) -> None:
        answer = (command.number, explain_refusal(command, self.state, self.config))
        self.tick(answers=(answer,))

    def tick(
        self, events: tuple[Event, ...] = (), answers: tuple[tuple[int, str], ...] = ()
    ) -> None:
        row = replace(ROW, state=self.state)
        self.port.handle_tick(TickOutputs(BenchCommand(0.0, 0.0), row, events, None, answers))

    def of_kind(self, kind: str) -> list[EventLine]:
        return [event for event in self.events if event["kind"] == kind]


@asynccontextmanager
async def port_run(folder: Path, config: PortConfig | None = None) -> AsyncIterator[PortRun]:
    run = PortRun(folder, config)
    try:
        async with run.port.open():
            run.tick()
            yield run
    finally:
        run.close()


class LineClient:
    """A client that can also misbehave."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer

    async def get(self) -> dict[str, Any] | None:
        line = await asyncio.wait_for(self.reader.readline(), PATIENCE_S)
        return json.loads(line) if line else None

    def put(self, data: bytes) -> None:
        self.writer.write(data)

    async def ask(self, **request: Any) -> dict[str, Any]:
        self.put(json.dumps(request).encode() + b"\n")
        return await self.answer()

    async def ask_bytes(self, data: bytes) -> dict[str, Any]:
        self.put(data)
        return await self.answer()

    async def answer(self) -> dict[str, Any]:
        """The next message that answers something."""
        while True:
            message = await self.get()
            assert message is not None, "hung up"
            if "number" in message:
                return message

    async def gone(self) -> bool:
        """Wait until the other side hangs up."""
        with suppress(ConnectionError):
            while await self.get() is not None:
                pass
        return True


@asynccontextmanager
async def client(run: PortRun, peer: Peer | None = None) -> AsyncIterator[LineClient]:
    run.listener.next_peer = peer
    reader, writer = await asyncio.open_unix_connection(str(run.path))
    line_client = LineClient(reader, writer)
    greeting = await line_client.get()
    assert greeting is not None
    assert greeting["you"] == (peer.who if peer else greeting["you"])
    try:
        yield line_client
    finally:
        writer.close()
        with suppress(ConnectionError):
            await writer.wait_closed()


async def keep_ticking(run: PortRun) -> None:
    """A row every fifth of a second, as a hold would send."""
    while True:
        run.tick()
        await asyncio.sleep(0.2)
