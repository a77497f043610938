"""Strangers at the TLS port, and misbehaving insiders: each reconnects when thrown out, until it is
killed.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import ssl
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path

Streams = tuple[asyncio.StreamReader, asyncio.StreamWriter]
Deed = Callable[[asyncio.StreamReader, asyncio.StreamWriter, random.Random], Awaitable[None]]

_AGAIN_S = 0.05


def hello() -> bytes:
    """The first message of a real client."""
    incoming, outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
    client = ssl.create_default_context().wrap_bio(incoming, outgoing, server_hostname="localhost")
    with contextlib.suppress(ssl.SSLWantReadError):
        client.do_handshake()
    return outgoing.read()


async def stand(
    reader: asyncio.StreamReader, writer: asyncio.StreamWriter, chance: random.Random
) -> None:
    """Half a handshake, then nothing for ever."""
    await reader.read()


async def dribble(
    reader: asyncio.StreamReader, writer: asyncio.StreamWriter, chance: random.Random
) -> None:
    """A handshake a byte at a time."""
    for byte in hello():
        writer.write(bytes([byte]))
        await writer.drain()
        await asyncio.sleep(0.05)


async def junk(
    reader: asyncio.StreamReader, writer: asyncio.StreamWriter, chance: random.Random
) -> None:
    """Noise, another protocol, early data and records of the wrong kind after a good hello."""
    record = bytes([chance.choice((20, 21, 22, 23, 24)), 3, 3, 1, 0]) + chance.randbytes(256)
    words = (
        chance.randbytes(5000),
        b"GET / HTTP/1.1\r\n\r\n",
        record,
        hello() + record,
        hello() + hello(),
        b"\x16" * 9000,
    )
    writer.write(chance.choice(words))
    await writer.drain()
    await reader.read()


async def come_and_go(
    reader: asyncio.StreamReader, writer: asyncio.StreamWriter, chance: random.Random
) -> None:
    """Nothing but a connection."""


async def deaf(
    reader: asyncio.StreamReader, writer: asyncio.StreamWriter, chance: random.Random
) -> None:
    """An insider that asks for everything and reads nothing."""
    reader._transport.pause_reading()  # type: ignore[attr-defined]
    writer.write(
        b'{"do": "watch", "period_s": 0.1, "number": 1}\n'
        + b'{"do": "status", "number": 2}\n' * 2000
    )
    while not writer.is_closing():
        writer.write(b'{"do": "status", "number": 3}\n' * 100)
        await writer.drain()


async def huge(
    reader: asyncio.StreamReader, writer: asyncio.StreamWriter, chance: random.Random
) -> None:
    """An insider whose line never ends."""
    while not writer.is_closing():
        writer.write(b"x" * 100_000)
        await writer.drain()


async def attack(
    port: int, deed: Deed, context: ssl.SSLContext | None, chance: random.Random, lone: bool
) -> None:
    """Do it for ever, from one address or from a new one each time."""
    while True:
        address = (
            "127.0.0.2" if lone else f"127.{chance.randint(1, 250)}.{chance.randint(0, 250)}.1"
        )
        with contextlib.suppress(OSError, TimeoutError):
            async with asyncio.timeout(20):
                reader, writer = await asyncio.open_connection(
                    "127.0.0.1",
                    port,
                    ssl=context,
                    local_addr=(address, 0),
                    server_hostname="" if context else None,
                )
                try:
                    await deed(reader, writer, chance)
                finally:
                    writer.transport.abort()
        await asyncio.sleep(_AGAIN_S)


def contexts(folder: Path) -> dict[str, ssl.SSLContext]:
    """One for each name of a certificate that lies there; "nobody" has none."""
    made = {}
    for name in ("expired", "foreign", "insider", "nobody"):
        made[name] = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        made[name].check_hostname, made[name].verify_mode = False, ssl.CERT_NONE
        if name != "nobody":
            made[name].load_cert_chain(folder / f"{name}.pem", folder / f"{name}.key")
    return made


async def everything(port: int, folder: Path, crowd: int, lone: bool) -> None:
    """A crowd that never shakes hands, and some of each of the others."""
    known = contexts(folder)
    plans: list[tuple[Deed, ssl.SSLContext | None]] = [(stand, None)] * crowd
    plans += [(deed, None) for deed in (dribble, junk, come_and_go) for _ in range(20)]
    plans += [(stand, known[name]) for name in ("expired", "foreign", "nobody") for _ in range(10)]
    plans += [(deed, known["insider"]) for deed in (deaf, huge) for _ in range(4)]
    await asyncio.gather(
        *(
            attack(port, deed, context, random.Random(seed), lone)
            for seed, (deed, context) in enumerate(plans)
        )
    )


if (
    __name__ == "__main__"
):  # a separate process with a lower priority than the bench: the port is under test
    os.nice(10)
    asyncio.run(
        everything(int(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), sys.argv[4] == "lone")
    )
