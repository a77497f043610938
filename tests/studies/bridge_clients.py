"""Clients of the bridges, each a process that writes the age of the oldest value to a file of JSON
lines; and a bare loop of the hold's rate.

`python -m tests.studies.bridge_clients FOLDER KIND PORTS` is one of them.
"""

from __future__ import annotations

import asyncio
import json
import os
import sys
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from membrane_ctrl.bridges.bridge import TABLE

NAMES = [each.name for each in TABLE]
SWEEP_S, FRESH_S, RATE_HZ, SAMPLE_S = 0.5, 2.0, 50.0, 5.0

Line = dict[str, Any]
Read = Callable[[], Iterable[float]]  # UTC seconds at which each name's value was made


def lines(path: Path) -> list[Line]:
    """The complete lines of a file of JSON lines; none if it is not there."""
    if not path.exists():
        return []
    return [
        json.loads(line)
        for line in path.read_text(encoding="utf-8").splitlines(keepends=True)
        if line[-1] == "\n"
    ]


class LineLog:
    """Appends JSON lines with their time to a file."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("a", encoding="utf-8", buffering=1)

    def __call__(self, **line: Any) -> None:
        self._file.write(json.dumps({"utc_s": round(time.time(), 3)} | line) + "\n")


# The clients: each a process that says in every sweep how old the oldest of all names is, or what
# failed.


def _sweeps(record: LineLog, read: Read) -> None:
    record(ready=True)  # its libraries are loaded
    while True:
        try:
            made_s = list(read())
        except Exception as error:  # whatever the library raises: the client continues
            record(failed=f"{type(error).__name__}: {error}"[:200])
        else:
            record(names=len(made_s), oldest_s=round(time.time() - min(made_s), 3))
        time.sleep(SWEEP_S)


def _mqtt(record: LineLog, ports: dict[str, int]) -> None:
    from datetime import datetime

    import aiomqtt

    newest: Line = {}

    async def follow() -> None:
        while True:
            try:
                async with aiomqtt.Client("127.0.0.1", ports["mqtt"]) as client:
                    await client.subscribe("membrane/mirror/values")
                    async for message in client.messages:
                        newest.update(json.loads(message.payload))
            except aiomqtt.MqttError as error:
                newest["problem"] = str(error)
            await asyncio.sleep(0.2)

    def read() -> list[float]:
        made_s = datetime.fromisoformat(newest["time_utc"]).timestamp()
        return [made_s for name in NAMES if name in newest]

    threading.Thread(target=lambda: asyncio.run(follow()), daemon=True).start()
    _sweeps(record, read)


def _opcua(record: LineLog, ports: dict[str, int]) -> None:
    from asyncua import ua
    from asyncua.sync import Client

    open_one: list[Client] = []

    def opened() -> Client:
        if not open_one:
            client = Client(f"opc.tcp://127.0.0.1:{ports['opcua']}/membrane_ctrl", timeout=2)
            client.connect()
            open_one.append(client)
        return open_one[0]

    def read() -> list[float]:
        from datetime import UTC

        try:
            client = opened()
            space = client.get_namespace_index("urn:membrane-ctrl:mirror")
            ids = [ua.NodeId(f"mirror.{name}", space) for name in NAMES]
            wait = client.tloop.post(
                client.aio_obj.uaclient.read_attributes(ids, ua.AttributeIds.Value)
            )
            return [value.SourceTimestamp.replace(tzinfo=UTC).timestamp() for value in wait]
        except Exception:
            if open_one:
                open_one.pop().tloop.stop()
            raise

    _sweeps(record, read)


def _ca(record: LineLog, ports: dict[str, int]) -> None:
    """Channel Access, in pure Python."""
    os.environ.update(EPICS_CA_ADDR_LIST="127.0.0.1", EPICS_CA_AUTO_ADDR_LIST="NO")
    os.environ["EPICS_CA_SERVER_PORT"] = str(ports["ca"])
    from caproto.threading.client import Context

    context = Context(timeout=2.0)
    pvs = context.get_pvs(*(f"mirror:{name}" for name in NAMES))
    _sweeps(
        record, lambda: [pv.read(timeout=2.0, data_type="time").metadata.timestamp for pv in pvs]
    )


def _pva(record: LineLog, _: dict[str, int]) -> None:
    # as in a lab; through a TCP name server it would look again every 10 s only
    # (benchmarks/interfaces/epics_return.py)
    os.environ.setdefault("EPICS_PVA_ADDR_LIST", "127.0.0.1")
    os.environ["EPICS_PVA_AUTO_ADDR_LIST"] = "NO"
    from p4p.client.thread import Context

    context, names = Context("pva"), [f"mirror:{name}" for name in NAMES]
    _sweeps(record, lambda: [value.timestamp for value in context.get(names, timeout=2.0)])


def _bare(record: LineLog, _: dict[str, int]) -> None:
    """A loop of the hold's rate that does nothing: how late it is, and what it misses, every ten
    seconds.
    """
    deadline_s, late_ms, missed = time.monotonic(), [], 0
    while True:
        deadline_s += 1 / RATE_HZ
        time.sleep(max(0.0, deadline_s - time.monotonic()))
        late_s = time.monotonic() - deadline_s
        late_ms.append(round(1e3 * late_s, 2))
        skipped = int(late_s * RATE_HZ)
        missed, deadline_s = missed + skipped, deadline_s + skipped / RATE_HZ
        if len(late_ms) == round(10 * RATE_HZ):
            record(late_ms=late_ms, missed=missed)
            late_ms, missed = [], 0


PARTS = {"mqtt": _mqtt, "opcua": _opcua, "ca": _ca, "pva": _pva, "bare": _bare}


if __name__ == "__main__":
    FOLDER, KIND, PORTS = sys.argv[1:]
    PARTS[KIND](LineLog(Path(FOLDER, f"{KIND}.jsonl")), json.loads(PORTS))
