"""QEMU's gdbstub, spoken just far enough to damage an emulated board: stop it, write to it, let it
go on.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from pathlib import Path

_PATIENCE_S = 30.0


class StoppedBoard:
    """The emulated processor while it stands still."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader = reader
        self._writer = writer

    async def _packet(self) -> str:
        async with asyncio.timeout(_PATIENCE_S):
            await self._reader.readuntil(b"$")
            packet = (await self._reader.readuntil(b"#"))[:-1].decode()
            await self._reader.readexactly(2)
        self._writer.write(b"+")
        return packet

    def _say(self, packet: str) -> None:
        self._writer.write(f"${packet}#{sum(packet.encode()) % 256:02x}".encode())

    async def ask(self, packet: str) -> str:
        """The answer to a packet."""
        self._say(packet)
        while (answer := await self._packet()).startswith("T"):
            continue  # that it stopped, which nobody asked
        assert answer, f"QEMU does not know {packet}"
        assert not answer.startswith("E"), f"{packet}: {answer}"
        return answer

    async def step(self) -> None:
        """Execute one instruction, without interrupts."""
        self._say("s")
        while not (await self._packet()).startswith("T05"):
            continue

    async def run_to(self, address: int) -> None:
        """Let it run until it comes to an address."""
        await self.ask(f"Z0,{address:x},2")
        self._say("c")
        while not (await self._packet()).startswith("T05"):
            continue
        await self.ask(f"z0,{address:x},2")

    async def read(self, address: int, count: int) -> bytes:
        """Bytes of memory."""
        return bytes.fromhex(await self.ask(f"m{address:x},{count:x}"))

    async def write(self, address: int, data: bytes) -> None:
        """Overwrite memory, code as well."""
        await self.ask(f"M{address:x},{len(data):x}:{data.hex()}")

    async def register(self, number: int) -> int:
        """A register of the processor; 13 is the stack pointer in force."""
        return int.from_bytes(bytes.fromhex(await self.ask(f"p{number:x}")), "little")

    async def set_register(self, number: int, value: int) -> None:
        """Change it."""
        await self.ask(f"P{number:x}={value.to_bytes(4, 'little').hex()}")

    async def go_on(self) -> None:
        """Let it run again, without us."""
        await self.ask("D")


@contextlib.asynccontextmanager
async def stopped(socket: Path) -> AsyncIterator[StoppedBoard]:
    """Stop the processor; it runs again afterwards."""
    reader, writer = await asyncio.open_unix_connection(str(socket))
    board = StoppedBoard(reader, writer)
    await board.ask("qXfer:features:read:target.xml:0,40")  # before that it has no single registers
    try:
        yield board
        await board.go_on()
    finally:
        writer.close()
        with contextlib.suppress(ConnectionError):
            await writer.wait_closed()
