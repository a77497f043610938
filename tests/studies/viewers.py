"""The ticks of a hold whose page has fifty viewers, one of which has stopped reading.

Phases without and with viewers alternate in one hold; the page runs in all of them. A viewer speaks
socket.io as a browser does and fetches the charts and maps that it is told to. `python -m
tests.studies.viewers LINK COUNT` is such viewers, until its standard input ends.
"""

from __future__ import annotations

import asyncio
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import psutil
import socketio
from aiohttp import ClientConnectionError, ClientSession, CookieJar

from membrane_ctrl.control_port.service_link import find_service
from membrane_ctrl.hold.page_service import LOG_NAME
from membrane_ctrl.run_files.run import open_run
from tests.support.figures import Figure, at_most

Beside = Callable[[str], AbstractContextManager[object]]
VIEWERS, CYCLES, PHASE_S = 50, 4, 30.0
_HOLDS_S = 25.0  # until the mirror is held
_DROPPED_S = 60.0  # a stalled viewer is noticed within 24 s, its page forgotten 20 s later


class Viewer:
    """A browser's part of a page: its web socket, and what it fetches."""

    def __init__(self, http: ClientSession, sockets: ClientSession, base: str) -> None:
        self._http, self._base = http, base
        self.socket = socketio.AsyncClient(reconnection=False, http_session=sockets)
        self.socket.on("update", self._update)
        self.socket.on("run_javascript", self._run)
        self._fetching: set[asyncio.Task[None]] = set()
        self.told_s: list[float] = []  # when updates came
        self.failed = ""

    async def open(self) -> None:
        """Open the page. Raises AssertionError if it is none."""
        async with self._http.get(f"{self._base}/") as answer:
            found = re.search(r"['\"]client_id['\"]: ['\"]([^'\"]+)", await answer.text())
        assert found is not None
        self._client = found[1]
        names = ("client_id", "document_id", "tab_id")
        query = "&".join(
            [
                *(f"{name}={self._client}" for name in names),
                "implicit_handshake=true&next_message_id=0",
            ]
        )
        where = {"transports": ["websocket"], "socketio_path": "/_nicegui_ws/socket.io"}
        await self.socket.connect(f"{self._base}?{query}", wait_timeout=60, **where)

    async def _update(self, data: dict[str, Any]) -> None:
        self.told_s.append(time.monotonic())
        self._fetch(json.dumps(data), "")

    async def _run(self, data: dict[str, Any]) -> None:
        self._fetch(data["code"], data.get("request_id", ""))

    def _fetch(self, text: str, answer_to: str) -> None:
        task = asyncio.create_task(
            self._fetched(re.findall(r"/(?:chart|map)\?[^'\"]*", text), answer_to)
        )
        self._fetching.add(task)
        task.add_done_callback(self._fetching.discard)

    async def _fetched(self, paths: list[str], answer_to: str) -> None:
        for path in paths:
            try:
                status = await self._got(path)
            except (
                ClientConnectionError
            ):  # the server closed an idle connection meanwhile: a browser asks again
                status = await self._got(path)
            if status != 200:
                self.failed = f"{path}: {status}"
        if answer_to and self.socket.connected:
            await self.socket.emit(
                "javascript_response", {"client_id": self._client, "request_id": answer_to}
            )

    async def _got(self, path: str) -> int:
        """Status of the answer; 204 for one that is empty."""
        async with self._http.get(f"{self._base}{path}") as answer:
            return answer.status if await answer.read() else 204

    def judged(self) -> tuple[float, str]:
        """The longest time without an update, s, and what went wrong."""
        gap_s = max(b - a for a, b in pairwise([*self.told_s, time.monotonic()]))
        return gap_s, self.failed or ("" if self.socket.connected else "was hung up on")


async def view(link: str, count: int) -> None:
    """Be viewers; print a line when all are there, and one at the end: the longest gap of each, and
    what failed.
    """
    jar = CookieJar(unsafe=True)
    async with ClientSession(cookie_jar=jar) as http, ClientSession(cookie_jar=jar) as sockets:
        async with http.get(link):  # gives the cookie
            pass
        viewers = [Viewer(http, sockets, link.partition("/?")[0]) for _ in range(count)]
        for viewer in viewers:
            await viewer.open()
        print("open", flush=True)
        await asyncio.to_thread(sys.stdin.readline)  # measure from here
        for viewer in viewers:
            viewer.told_s = [time.monotonic()]
        await asyncio.to_thread(sys.stdin.read)
        print(json.dumps([viewer.judged() for viewer in viewers]), flush=True)
        for viewer in viewers:
            await viewer.socket.disconnect()


@dataclass
class Phase:
    """A part of the hold, and what it took."""

    viewed: bool
    from_s: float = field(default_factory=time.time)
    page_cpu_s: float = 0.0
    late_p99_ms: float = 0.0
    missed: int = 0
    gaps: list[tuple[float, str]] = field(default_factory=list)


@contextmanager
def viewers(link: str, count: int) -> Iterator[subprocess.Popen[str]]:
    """Viewers in a session of their own, as on other machines."""
    command = [sys.executable, "-m", "tests.studies.viewers", link, str(count)]
    pipe = subprocess.PIPE
    with subprocess.Popen(
        command, stdin=pipe, stdout=pipe, text=True, start_new_session=True
    ) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "open\n"
            yield process
        finally:
            process.kill()


@contextmanager
def hold_with_page(
    folder: Path, tables: str = ""
) -> Iterator[tuple[psutil.Process, psutil.Process, str, Path]]:
    """A `hold --twin`, its page, the page's link and the folder of the run; the hold is stopped
    afterwards. `tables` are more of its configuration.
    """
    (folder / "lab.toml").write_text(f"[twin]\nport = 0\n{tables}")
    command = [
        sys.executable,
        "-m",
        "membrane_ctrl",
        "hold",
        "--twin",
        "--config",
        str(folder / "lab.toml"),
    ]
    none = subprocess.DEVNULL
    logs = folder / "logs"
    # in CI the service is a child, which ends with the hold
    env = os.environ | {"CI": "true", "MEMBRANE_CTRL_SERVICE": "true"}
    hold = psutil.Popen(
        [*command, "--logs", str(logs)], stdin=none, stdout=none, stderr=none, env=env
    )
    try:
        give_up_s = time.monotonic() + 120.0
        while not (link := find_service(logs)):
            assert time.monotonic() < give_up_s, "the page does not start"
            time.sleep(0.5)
        time.sleep(_HOLDS_S)
        (page,) = (child for child in hold.children() if "--with-hold" in child.cmdline())
        (run,) = (events.parent for events in logs.glob("*/events.jsonl"))
        yield hold, page, link, run
    finally:
        hold.send_signal(signal.SIGINT)
        hold.wait(120.0)


def _phase(page: psutil.Process, viewed: subprocess.Popen[str] | None) -> Phase:
    phase, before = Phase(viewed is not None), page.cpu_times()
    if viewed is not None:
        assert viewed.stdin is not None
        viewed.stdin.write("now\n")
        viewed.stdin.flush()
    time.sleep(PHASE_S)
    after = page.cpu_times()
    phase.page_cpu_s = after.user + after.system - before.user - before.system
    if viewed is not None:
        phase.gaps = json.loads(viewed.communicate()[0])
    return phase


def phases_of(
    link: str, page: psutil.Process, count: int, cycles: int, beside: Beside
) -> Iterator[Phase]:
    """Phases without viewers and with, in turn."""
    for _ in range(cycles):
        yield _phase(page, None)
        with viewers(link, count) as many, viewers(link, 1) as stalled, beside(link):
            time.sleep(3.0)  # until something has been sent
            stalled.send_signal(signal.SIGSTOP)
            yield _phase(page, many)
            time.sleep(_DROPPED_S)


def judge(phases: list[Phase], run: Path) -> None:
    """Fill in how late the ticks of each phase were."""
    start = json.loads((run / "events.jsonl").read_text().splitlines()[0])
    zero_s = datetime.fromisoformat(start["time_utc"]).timestamp() - start["mono_s"]
    names = ["time_s", "lateness_ms", "missed_ticks"]
    time_s, late_ms, missed = (open_run(run).ticks(names).column(name).to_numpy() for name in names)
    for phase in phases:
        within = (time_s >= phase.from_s - zero_s) & (time_s < phase.from_s - zero_s + PHASE_S)
        phase.late_p99_ms = float(np.percentile(late_ms[within], 99))
        phase.missed = int(missed[within][-1] - missed[within][0])


def measure_viewers(
    count: int = VIEWERS, cycles: int = CYCLES, beside: Beside = nullcontext
) -> list[Figure]:
    """Figures of one hold; `beside` opens one more viewer of the link for each of the cycles."""
    with tempfile.TemporaryDirectory() as folder:
        with hold_with_page(Path(folder)) as (_, page, link, run_folder):
            begin_mb = page.memory_info().rss / 1e6
            phases = list(phases_of(link, page, count, cycles, beside))
            grown_mb = page.memory_info().rss / 1e6 - begin_mb
            hung_up = (run_folder.parent / LOG_NAME).read_text().count("does not read: hung up")
        judge(phases, run_folder)
    without, viewed = ([phase for phase in phases if phase.viewed is on] for on in (False, True))
    late_ms = [median(phase.late_p99_ms for phase in part) for part in (without, viewed)]
    missed = [sum(phase.missed for phase in part) for part in (without, viewed)]
    gaps = [gap for phase in viewed for gap in phase.gaps]
    share = max(phase.page_cpu_s for phase in viewed) / PHASE_S
    return [
        at_most(
            f"tick lateness p99, {count} viewers", late_ms[1], "ms", 5.0, "no viewers", late_ms[0]
        ),
        at_most(f"ticks missed, {count} viewers", missed[1], "", 0, "no viewers", missed[0]),
        at_most(
            "longest time without an update, median viewer",
            median(gap for gap, _ in gaps),
            "s",
            2.0,
        ),
        at_most(
            "longest time without an update, worst viewer", max(gap for gap, _ in gaps), "s", 5.0
        ),
        at_most(
            "viewers lost", sum(bool(failed) for _, failed in gaps), "", 0, "viewers", len(gaps)
        ),
        # One viewer of each cycle is stalled; all others that lost their connection were reading
        at_most(
            "stalled viewers not hung up on", max(0, cycles - hung_up), "", 0, "stalled", cycles
        ),
        at_most("reading viewers hung up on", max(0, hung_up - cycles), "", 0, "viewers", count),
        at_most("processor of the page", 100 * share, "%", 50.0),
        at_most("memory of the page, growth", grown_mb, "MB", 200.0),
    ]


if __name__ == "__main__":
    asyncio.run(view(sys.argv[1], int(sys.argv[2])))
