"""The time until EPICS clients have values again after the bridge was killed and restarted.

python -m benchmarks.interfaces.epics_return [--restarts 8] [--repeater]

The clients: p4p, which looks for the bridge by UDP or through a TCP name server; caproto; and
EPICS' own Channel Access library, if aioca is there (`pip install aioca`). `--repeater` runs the
repeater, which passes the beacons of the bridge on to Channel Access clients; on most EPICS
machines one runs. Each client reads three names, again and again; its time runs from the bridge's
line that it serves to the end of the first read of values younger than 2 s.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import importlib.util
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from tests.studies.bridge_clients import LineLog, lines
from tests.support.figures import Figure, at_most, show
from tests.worlds.free_port import free_port
from tests.worlds.port_run import keep_ticking, port_run

NAMES = [f"mirror:{name}" for name in ("error_um", "leak_um_per_s", "z4_um")]
FRESH_S, READ_S, AWAY_S, WATCH_S = 2.0, 0.5, 3.0, 15.0
Read = Callable[[], list[float]]


def _pva(**found: str) -> Read:
    os.environ.update(EPICS_PVA_AUTO_ADDR_LIST="NO", **found)
    from p4p.client.thread import Context

    context = Context("pva")
    return lambda: [value.timestamp for value in context.get(NAMES, timeout=READ_S)]


def _caproto(port: str) -> Read:
    os.environ.update(
        EPICS_CA_ADDR_LIST="127.0.0.1", EPICS_CA_AUTO_ADDR_LIST="NO", EPICS_CA_SERVER_PORT=port
    )
    from caproto.threading.client import Context

    pvs = Context(timeout=READ_S).get_pvs(*NAMES)
    return lambda: [pv.read(timeout=READ_S, data_type="time").metadata.timestamp for pv in pvs]


def _own(port: str) -> Read:
    os.environ.update(
        EPICS_CA_ADDR_LIST="127.0.0.1", EPICS_CA_AUTO_ADDR_LIST="NO", EPICS_CA_SERVER_PORT=port
    )
    import aioca

    loop = asyncio.new_event_loop()

    def read() -> list[float]:
        got = loop.run_until_complete(aioca.caget(NAMES, format=aioca.FORMAT_TIME, timeout=READ_S))
        return [value.timestamp for value in got]

    return read


CLIENTS: dict[str, Callable[[str, str], Read]] = {  # of the ports of Channel Access and PV Access
    "PV Access, UDP": lambda ca, pva: _pva(EPICS_PVA_ADDR_LIST="127.0.0.1"),
    "PV Access, TCP name server": lambda ca, pva: _pva(EPICS_PVA_NAME_SERVERS=f"127.0.0.1:{pva}"),
    "Channel Access, caproto": lambda ca, pva: _caproto(ca),
    "Channel Access, EPICS' own library": lambda ca, pva: _own(ca),
}


def be_client(name: str, out: Path, ca: str, pva: str) -> None:
    """Read until killed; say when values came that are fresh."""
    record, read = LineLog(out), CLIENTS[name](ca, pva)
    while True:
        with contextlib.suppress(Exception):  # whatever the library raises: the client continues
            if min(read()) > time.time() - FRESH_S:
                record(fresh=True)
        time.sleep(0.05)


@contextlib.contextmanager
def started(*words: object) -> Iterator[subprocess.Popen[bytes]]:
    """A program, killed at the end."""
    process = subprocess.Popen(
        list(map(str, words)), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def serving(folder: Path) -> Iterator[float]:
    """Start the bridge, yield when it served, and kill it; for ever."""
    bridge = (
        sys.executable,
        "-m",
        "membrane_ctrl",
        "bridges",
        "--config",
        folder / "lab.toml",
        "--logs",
        folder,
    )
    while True:
        with started(*bridge) as process:
            assert process.stderr is not None
            while not (line := process.stderr.readline()).startswith(b"epics:"):
                assert line, "the bridge ended"
            yield time.time()
        time.sleep(AWAY_S)


async def measure(restarts: int, repeater: bool, folder: Path) -> list[Figure]:
    """Figures of so many restarts."""
    ca, pva = str(free_port()), str(free_port())
    (folder / "lab.toml").write_text(f"[bridges.epics]\nca_port = {ca}\npva_port = {pva}\n")
    known = [name for name in CLIENTS if "own" not in name or importlib.util.find_spec("aioca")]
    files = {name: folder / f"client{number}.jsonl" for number, name in enumerate(known)}
    served_s = []
    with contextlib.ExitStack() as stack:
        if repeater:
            stack.enter_context(started(Path(sys.executable).parent / "caproto-repeater"))
        async with port_run(folder) as run:
            task = asyncio.create_task(keep_ticking(run))
            for name, file in files.items():
                words = (
                    "-m",
                    "benchmarks.interfaces.epics_return",
                    "--client",
                    name,
                    "--ports",
                    ca,
                    pva,
                    "--out",
                    file,
                )
                stack.enter_context(started(sys.executable, *words))
            bridge = serving(folder)
            for _ in range(1 + restarts):
                served_s.append(await asyncio.to_thread(next, bridge))
                await asyncio.sleep(WATCH_S)
            await asyncio.to_thread(bridge.close)
            task.cancel()
    found = []
    for name, file in files.items():
        fresh_s = [line["utc_s"] for line in lines(file)]
        after_s = [
            min((at - up for at in fresh_s if at > up), default=float("inf")) for up in served_s[1:]
        ]
        median_s, worst_s = sorted(after_s)[len(after_s) // 2], max(after_s)
        found += [
            at_most(f"{name}: median return of {restarts}", median_s, "s"),
            at_most(f"{name}: slowest", worst_s, "s", FRESH_S),
        ]
    return [*found, at_most("load", os.getloadavg()[0], "")]


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--restarts", type=int, default=8)
    parser.add_argument(
        "--repeater", action="store_true", help="run a repeater of Channel Access beacons"
    )
    parser.add_argument("--client", choices=CLIENTS, help=argparse.SUPPRESS)
    parser.add_argument("--ports", nargs=2, help=argparse.SUPPRESS)
    parser.add_argument("--out", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.client:
        be_client(options.client, options.out, *options.ports)
    with tempfile.TemporaryDirectory() as folder:
        figures = asyncio.run(measure(options.restarts, options.repeater, Path(folder)))
    show("returns of EPICS clients", figures)


if __name__ == "__main__":
    main()
