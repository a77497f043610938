"""A hold whose TLS port is under attack: no tick is missed, and operators from elsewhere are served.

A hold without an attack, in the same test, is what the lateness of the attacked one is compared with.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
import time
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil
import pytest
import tls_attackers
from campaign_bench import Run, make_plant, running

from membrane_ctrl.errors import DeviceError, Exit
from membrane_ctrl.port.client import PortClient
from membrane_ctrl.port.tls import client_context

sys.path.append(str(Path(__file__).parents[1] / "port"))
from port_certificates import Authority

pytestmark = [pytest.mark.real_time, pytest.mark.campaign, pytest.mark.timeout(300)]

ATTACKED_S = 20.0
CROWD = 1000  # who stand in the door; 98 others do worse


@dataclass
class Operator:
    """Asks again and again, each time by a new connection, and notes what came of it."""

    ask: Callable[[str], dict[str, Any]]
    served_s: list[float] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)

    async def until(self, over: asyncio.Event) -> None:
        while not over.is_set():
            began_s = time.monotonic()
            try:
                await asyncio.to_thread(self.ask, "status")
            except DeviceError as error:
                self.failed.append(str(error))
            else:
                self.served_s.append(time.monotonic() - began_s)
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(over.wait(), 0.5)

    def __str__(self) -> str:
        worst_s = max(self.served_s, default=float("nan"))
        return f"{len(self.served_s)} served (slowest {worst_s:.2f} s), {len(self.failed)} not {self.failed[:1]}"


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of the bench, of an operator, and of those whom nobody wants."""
    folder = tmp_path_factory.mktemp("tls")
    lab, stranger = Authority.new(folder / "lab"), Authority.new(folder / "stranger")
    lab.certificate("bench")
    lab.certificate("operator", "operate")
    lab.certificate("insider", "read")
    lab.certificate("expired", "tune", ("-startdate", "20200101000000Z", "-enddate", "20200102000000Z"))
    stranger.certificate("foreign", "tune")
    for name in ("foreign.pem", "foreign.key"):
        (folder / "stranger" / name).rename(folder / "lab" / name)
    return folder / "lab"


def configured(certificates: Path) -> str:
    names = {"certificate_file": "bench.pem", "key_file": "bench.key", "client_ca_file": "ca.pem"}
    return "[port.tls]\nport = 0\n" + "".join(f'{key} = "{certificates / name}"\n' for key, name in names.items())


@contextlib.asynccontextmanager
async def attackers(port: int, certificates: Path, how: str) -> AsyncIterator[None]:
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, tls_attackers.__file__, str(port), str(certificates), str(CROWD), how),
        stderr=asyncio.subprocess.DEVNULL,
    )
    try:
        yield
        assert process.returncode is None, "the attackers gave up"
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.wait()


def tls_port(run: Run) -> int:
    (event,) = (event for event in run.events if event["kind"] == "port")
    return int(event["tls"].rsplit(":", 1)[1])


def summary_of(folder: Path) -> dict[str, Any]:
    (summary,) = folder.glob("logs/*/summary.json")
    found: dict[str, Any] = json.loads(summary.read_text())
    return found


async def lived_through(folder: Path, certificates: Path, how: str) -> tuple[dict[str, Any], Operator, Operator]:
    """The summary of a hold under attack (`how` empty: of one left in peace), and its operators."""
    context = client_context(certificates / "operator.pem", certificates / "operator.key", certificates / "ca.pem")
    folder.mkdir()  # noqa: ASYNC240  once, before anything ticks
    async with running(folder, make_plant(), configured(certificates)) as run:
        await run.until(lambda: run.reached("hold"))
        port, socket_file = tls_port(run), folder / "logs" / "control.sock"

        def by_tls(what: str) -> dict[str, Any]:
            with PortClient.tls("127.0.0.1", port, context, lambda notice: None) as client:
                return client.ask(do=what)

        def by_socket(what: str) -> dict[str, Any]:
            with PortClient.unix(socket_file, lambda notice: None) as client:
                return client.ask(do=what)

        over, remote, local = asyncio.Event(), Operator(by_tls), Operator(by_socket)
        memory = psutil.Process(run.process.pid)
        before_mb, before_s, began_s = memory.memory_info().rss / 1e6, sum(memory.cpu_times()[:2]), time.monotonic()
        async with attackers(port, certificates, how) if how else contextlib.nullcontext():
            asking = [asyncio.create_task(operator.until(over)) for operator in (remote, local)]
            await asyncio.sleep(ATTACKED_S)
            over.set()
            await asyncio.gather(*asking)
            grown_mb = memory.memory_info().rss / 1e6 - before_mb
            files = memory.num_fds()
            busy = (sum(memory.cpu_times()[:2]) - before_s) / (time.monotonic() - began_s)
            assert (await asyncio.to_thread(by_tls, "stop"))["ok"]
        assert await run.ended() == Exit.INTERRUPTED
        assert run.faults() == []
        refused = [event for event in run.events if event["kind"] == "refused"]
    found = summary_of(folder)
    lateness = {name: round(value, 2) for name, value in found["lateness_ms"].items()}
    print(f"\n{how or 'in peace'}: late by {lateness} ms, {found['missed_ticks']} of {found['ticks']} ticks missed")
    print(
        f"  {100 * busy:.1f} % of a processor, {grown_mb:+.1f} MB, {files} files, {len(refused)} refusals recorded; "
        f"by TLS {remote}; by socket {local}"
    )
    found["busy"] = busy
    assert grown_mb < 60.0
    assert files < 200
    assert len(refused) <= 40
    return found, remote, local


@pytest.mark.parametrize("how", ["lone", "many"])
async def test_strangers_disturb_neither_ticks_nor_operators(tmp_path: Path, certificates: Path, how: str) -> None:
    calm, _, _ = await lived_through(tmp_path / "calm", certificates, "")
    attacked, remote, local = await lived_through(tmp_path / "attacked", certificates, how)
    ratio = attacked["lateness_ms"]["p99"] / calm["lateness_ms"]["p99"]
    print(f"{how}: p99 of the lateness {ratio:.2f} times that of a hold in peace")
    assert attacked["busy"] < calm["busy"] + 0.05  # what the machine does besides does not show in it
    assert attacked["missed_ticks"] <= max(3 * calm["missed_ticks"], attacked["ticks"] // 20)
    assert local.failed == []
    assert len(local.served_s) >= 10
    if how == "lone":  # a thousand addresses fill the queue in front of the door: then the socket file is the way
        assert remote.failed == []
        assert len(remote.served_s) >= 10
