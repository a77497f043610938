"""Hostile clients of the control port, each until it is cancelled:
they reconnect when thrown out.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import random
import sys
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

Attack = Callable[
    [asyncio.StreamReader, asyncio.StreamWriter, random.Random], Coroutine[Any, Any, None]
]


async def nonsense(
    reader: asyncio.StreamReader, writer: asyncio.StreamWriter, chance: random.Random
) -> None:
    """Random bytes, as fast as they are accepted."""
    writer.write(
        chance.randbytes(300)
        + b"\n"
        + b'{"do": "no such thing", "number": 1}\n'
        + b"[[[[[[" * 100
        + b"\n"
    )
    await writer.drain()


async def huge(
    reader: asyncio.StreamReader, writer: asyncio.StreamWriter, chance: random.Random
) -> None:
    """A line that never ends."""
    writer.write(b"x" * 100_000)
    await writer.drain()


async def slow(
    reader: asyncio.StreamReader, writer: asyncio.StreamWriter, chance: random.Random
) -> None:
    """A byte now and then."""
    writer.write(b"{")
    await asyncio.sleep(0.5)


async def deaf(
    reader: asyncio.StreamReader, writer: asyncio.StreamWriter, chance: random.Random
) -> None:
    """Asks for everything, reads nothing."""
    writer.write(json.dumps({"do": "watch", "period_s": 0.1, "number": 1}).encode() + b"\n")
    writer.write(b'{"do": "status", "number": 2}\n' * 100)
    await asyncio.sleep(0.5)


async def flood(
    reader: asyncio.StreamReader, writer: asyncio.StreamWriter, chance: random.Random
) -> None:
    """Connects and disconnects."""
    raise ConnectionError


ATTACKS = (nonsense, huge, slow, deaf, flood)


async def attack(socket: Path, seed: int, how: Attack) -> None:
    """Do it for ever."""
    chance = random.Random(seed)
    while True:
        with contextlib.suppress(OSError):
            reader, writer = await asyncio.open_unix_connection(socket)
            try:
                while not (reader.at_eof() or writer.is_closing()):
                    await how(reader, writer, chance)
                    await asyncio.sleep(0.005)
            finally:
                writer.transport.abort()
        await asyncio.sleep(0.005)


async def attack_together(socket: Path, each: int) -> None:
    """So many of each kind at once."""
    await asyncio.gather(*(attack(socket, seed, how) for seed in range(each) for how in ATTACKS))


if __name__ == "__main__":  # a separate process: the bench in the test's process must not notice it
    asyncio.run(attack_together(Path(sys.argv[1]), int(sys.argv[2])))
