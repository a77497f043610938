"""The firmware on an emulated Cortex-M3 (QEMU's mps2-an385): its line is a pseudo terminal, its
film a socket.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import subprocess
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.board.build_board import built

_START_S = 30.0  # of a busy machine


def built_image(folder: Path) -> Path:
    """The image for QEMU; skips the test where compiler or emulator are missing."""
    return built("mps2.elf", folder, "arm-none-eabi-gcc", "qemu-system-arm")


def addresses(image: Path) -> dict[str, int]:
    """Addresses of functions and variables in the image."""
    listing = subprocess.run(
        ["arm-none-eabi-nm", str(image)], check=True, capture_output=True, text=True
    ).stdout
    return {
        row.split()[2]: int(row.split()[0], 16)
        for row in listing.splitlines()
        if len(row.split()) == 3
    }


@dataclass
class QemuBoard:
    """A running emulated board."""

    rtu: str  # the pseudo terminal
    reader: asyncio.StreamReader
    writer: asyncio.StreamWriter
    resets: list[dict[str, Any]] = field(default_factory=list)

    @property
    def url(self) -> str:
        """For a Modbus client."""
        return f"rtu://{self.rtu}?baud=115200&parity=N"

    async def monitor(self, command: str, **arguments: Any) -> Any:
        """Carry out a command of QEMU's machine protocol (QMP)."""
        self.writer.write(json.dumps({"execute": command, "arguments": arguments}).encode() + b"\n")
        while True:
            found = json.loads(await asyncio.wait_for(self.reader.readline(), _START_S))
            if "return" in found or "error" in found:
                return found["return"]
            self.resets += [found] if found.get("event") == "RESET" else []


@contextlib.asynccontextmanager
async def qemu_board(
    image: Path, folder: Path, film_port: int, *options: str
) -> AsyncIterator[QemuBoard]:
    """Start the image and wait until its line is there; ends it afterwards."""
    socket = folder / "qmp"
    process = await asyncio.create_subprocess_exec(
        "qemu-system-arm",
        "-M",
        "mps2-an385",
        "-display",
        "none",
        "-kernel",
        str(image),
        "-serial",
        "pty",
        "-serial",
        f"tcp:127.0.0.1:{film_port}",
        "-qmp",
        f"unix:{socket},server=on,wait=off",
        *options,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
    )
    try:
        assert process.stdout is not None
        line = (await asyncio.wait_for(process.stdout.readline(), _START_S)).decode()
        rtu = next((word for word in line.split() if word.startswith("/dev/")), "")
        assert rtu, line
        kept = os.open(
            rtu, os.O_RDWR | os.O_NOCTTY
        )  # QEMU takes a second to notice a new client, and loses answers
        reader, writer = await asyncio.open_unix_connection(str(socket))
        board = QemuBoard(rtu, reader, writer)
        await reader.readline()  # the greeting
        await board.monitor("qmp_capabilities")
        yield board
        writer.close()
        os.close(kept)
    finally:
        process.terminate()
        await asyncio.wait_for(process.communicate(), _START_S)
