"""Bridges beside a real `hold --twin`: ticks, memory, and the age of the values while the other
parts restart.

python -m benchmarks.interfaces.bridges FOLDER [--minutes 30] [--apart-minutes 10] [--raised]

Phases: without bridges, with bridges, without bridges. With bridges, a client of each kind
(mosquitto with aiomqtt, asyncua, caproto for Channel Access, p4p for PV Access) reads all names
twice a second.
Broker and clients are killed and started again four times each, then the bridge three times. A bare
loop of the hold's rate, in a separate process, shows what the machine does to any such loop.
FOLDER gets the raw lines; `--figures` prints the figures from them again.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.studies.bridge_clients import FRESH_S, NAMES, SAMPLE_S, Line, LineLog, lines
from tests.support.figures import Figure, at_least, at_most, show

CLIENTS = ("mqtt", "opcua", "ca", "pva")
BETWEEN_S = 20.0  # at least, from a return to the next end
WARM_S = 60.0  # memory is compared from here on
RAISED = "-5"  # of the session, against everything else on the machine
CONFIG = """[twin]
port = 0
[bridges.mqtt]
port = {mqtt}
[bridges.opcua]
port = {opcua}
[bridges.epics]
ca_port = {ca}
pva_port = {pva}
"""


# The bench: starts and kills everything.


@dataclass(frozen=True)
class Restart:
    """Kills `who` at a time of the phase with bridges, and starts it again `away_s` later."""

    at_s: float
    who: str
    away_s: float


def restarts(span_s: float) -> list[Restart]:
    """Broker and clients in turn, away for a few seconds or for 20; then the bridge."""
    turns = [(number, who) for number in range(4) for who in ("broker", *CLIENTS[1:])]
    found = [
        Restart(span_s * (0.04 + 0.0375 * place), who, 20.0 if number % 2 else 3.0)
        for place, (number, who) in enumerate(turns)
    ]
    return [*found, *(Restart(span_s * share, "bridge", 3.0) for share in (0.70, 0.80, 0.90))]


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


class Bench:
    """The processes, by name, and the file that says what happened to them."""

    def __init__(self, folder: Path, raised: bool) -> None:
        self._folder, self._raised = folder, raised
        self.record = LineLog(folder / "bench.jsonl")
        self._ports = {name: _free_port() for name in CLIENTS}
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        (folder / "lab.toml").write_text(CONFIG.format(**self._ports), encoding="utf-8")

    def start(self, who: str, *more: str) -> None:
        """Start a part and wait until it serves, as far as it serves anybody."""
        part = [
            sys.executable,
            "-m",
            "tests.studies.bridge_clients",
            str(self._folder),
            who,
            json.dumps(self._ports),
        ]
        config = ["--config", str(self._folder / "lab.toml"), "--logs", str(self._folder / "logs")]
        broker = shutil.which("mosquitto") or "/usr/sbin/mosquitto"
        command = {
            "hold": [
                sys.executable,
                "-m",
                "membrane_ctrl",
                "hold",
                "--twin",
                *config,
                "--json",
                *more,
            ],
            "bridge": [sys.executable, "-m", "membrane_ctrl", "bridges", *config],
            "broker": [broker, "-p", str(self._ports["mqtt"])],
        }.get(who, part)
        out = self._folder / f"{who}.log"
        with out.open("ab") as log:
            begin = log.tell()
            process = subprocess.Popen(
                command, stdout=log, stderr=log, stdin=subprocess.DEVNULL, start_new_session=True
            )
        self._running[who] = process
        if self._raised and who in ("hold", "bare"):
            Path(f"/proc/{process.pid}/autogroup").write_text(RAISED, encoding="utf-8")
        while process.poll() is None and not self._serves(who, out, begin):
            time.sleep(0.05)
        self.record(started=who, pid=process.pid)

    def _serves(self, who: str, out: Path, begin: int) -> bool:
        if who == "broker":
            with socket.socket() as probe:
                return probe.connect_ex(("127.0.0.1", self._ports["mqtt"])) == 0
        if who == "hold":
            return (self._folder / "logs" / "control.sock").exists()
        printed = out.read_bytes()[begin:].decode()
        return who != "bridge" or all(f"{name}:" in printed for name in ("opcua", "epics"))

    def kill(self, who: str, number: int = signal.SIGKILL) -> None:
        """End a part at once, or with another signal, and its children with it."""
        self.record(killed=who)
        process = self._running.pop(who)
        process.send_signal(number)
        process.wait()

    def sample(self) -> None:
        """Note the memory of bridge and hold, and the machine's load."""
        rss_mb = {}
        for who in {"bridge", "hold"} & set(self._running):
            pages = (
                Path(f"/proc/{self._running[who].pid}/statm").read_text(encoding="utf-8").split()[1]
            )
            rss_mb[who] = round(int(pages) * os.sysconf("SC_PAGE_SIZE") / 1e6, 2)
        self.record(rss_mb=rss_mb, load=os.getloadavg()[0])

    def wait(self, until_s: float) -> None:
        """Sample until a monotonic time."""
        while (left_s := until_s - time.monotonic()) > 0:
            self.sample()
            time.sleep(min(SAMPLE_S, left_s))

    def close(self) -> None:
        """End everything; the hold as Ctrl-C does."""
        for who in sorted(self._running, key=lambda who: who == "hold"):
            self.kill(who, signal.SIGINT if who == "hold" else signal.SIGKILL)


def measure(folder: Path, minutes: float, apart_minutes: float, raised: bool) -> None:
    """Run all phases; everything that was seen is in the folder's files."""
    bench = Bench(folder, raised)
    try:
        bench.start("bare")
        bench.start("hold")
        bench.wait(time.monotonic() + 30.0)  # until it holds
        bench.record(phase="apart")
        bench.wait(time.monotonic() + 60.0 * apart_minutes)
        bench.start("broker")
        bench.start("bridge")
        for name in CLIENTS:
            bench.start(name)
        bench.record(phase="bridges")
        begin_s = time.monotonic()
        for restart in restarts(60.0 * minutes):
            bench.wait(max(begin_s + restart.at_s, time.monotonic() + BETWEEN_S))
            bench.kill(restart.who)
            bench.wait(time.monotonic() + restart.away_s)
            bench.start(restart.who)
        bench.wait(begin_s + 60.0 * minutes)
        for who in (*CLIENTS, "bridge", "broker"):
            bench.kill(who)
        bench.record(phase="apart again")
        bench.wait(time.monotonic() + 60.0 * apart_minutes)
        bench.record(phase="")
    finally:
        bench.close()


# The figures, from the files.


def _phases(records: list[Line]) -> list[tuple[str, float, float]]:
    marks = [(line["phase"], line["utc_s"]) for line in records if "phase" in line]
    return [(name, begin, end) for (name, begin), (_, end) in itertools.pairwise(marks)]


def tick_figures(folder: Path, records: list[Line]) -> list[Figure]:
    """Lateness and missed ticks of the hold in each phase, beside those of the bare loop."""
    from membrane_ctrl.run_files.run import open_run

    (run_folder,) = (
        path for path in (folder / "logs").iterdir() if (path / "config.toml").exists()
    )
    run = open_run(run_folder)
    ticks = run.ticks(["time_s", "lateness_ms", "missed_ticks"])
    utc_s = ticks.column("time_s").to_numpy() + run.origin_utc.timestamp()
    late_ms, missed = (ticks.column(name).to_numpy() for name in ("lateness_ms", "missed_ticks"))
    bare, loads = lines(folder / "bare.jsonl"), [line for line in records if "load" in line]
    found = []
    for name, begin, end in _phases(records):
        within = (utc_s >= begin) & (utc_s < end)
        beside = [line for line in bare if begin <= line["utc_s"] < end]
        beside_ms = np.concatenate([line["late_ms"] for line in beside])
        load = float(np.mean([line["load"] for line in loads if begin <= line["utc_s"] < end]))
        lost, bare_lost = (
            int(missed[within][-1] - missed[within][0]),
            sum(line["missed"] for line in beside),
        )
        p99_ms, bare_p99_ms = (
            float(np.percentile(late_ms[within], 99)),
            float(np.percentile(beside_ms, 99)),
        )
        found += [
            at_most(
                f"{name}: missed of {within.sum()} ticks", lost, "", None, "bare loop", bare_lost
            ),
            at_most(f"{name}: tick lateness p99", p99_ms, "ms", None, "bare loop", bare_p99_ms),
            at_most(f"{name}: load", load, ""),
        ]
    return found


def _affected(who: str) -> tuple[str, ...]:
    return {"broker": ("mqtt",), "bridge": CLIENTS}.get(who, (who,))


def _good(sweep: Line) -> bool:
    return sweep.get("names") == len(NAMES) and bool(sweep["oldest_s"] <= FRESH_S)


def age_figures(folder: Path, records: list[Line]) -> list[Figure]:
    """How soon each client has all names again after a restart, and how old they become between
    restarts.
    """
    ((_, begin_s, end_s),) = (each for each in _phases(records) if each[0] == "bridges")
    found = []
    for name in CLIENTS:
        sweeps = [
            line for line in lines(folder / f"{name}.jsonl") if begin_s <= line["utc_s"] < end_s
        ]
        back_s, between, first = [], [], True
        events = [line for line in records if begin_s < line["utc_s"] < end_s]
        returns = [line["utc_s"] for line in events if name in _affected(line.get("started", ""))]
        kills = [line["utc_s"] for line in events if name in _affected(line.get("killed", ""))]
        for at_s, until_s in zip([begin_s, *returns], [*kills, end_s], strict=False):
            part = [line for line in sweeps if at_s <= line["utc_s"] < until_s]
            started_s = next((line["utc_s"] for line in part if "ready" in line), at_s)
            fresh_s = next((line["utc_s"] for line in part if _good(line)), None)
            if fresh_s is None:
                back_s.append(float("inf"))
                continue
            if not first:
                back_s.append(fresh_s - started_s)
            first = False
            between += [line for line in part if line["utc_s"] >= fresh_s]
        old_s = max(line.get("oldest_s", float("inf")) for line in between)
        bad = sum(not _good(line) for line in between)
        found += [
            at_most(
                f"{name}: slowest of {len(back_s)} returns to all names", max(back_s), "s", FRESH_S
            ),
            at_most(
                f"{name}: oldest value between restarts, {len(between)} sweeps", old_s, "s", FRESH_S
            ),
            at_most(f"{name}: sweeps with a failure or an older value", bad, "", 0),
        ]
    return found


def memory_figures(records: list[Line]) -> list[Figure]:
    """Memory of the bridge in its longest life, and of the hold."""
    starts = [line["utc_s"] for line in records if line.get("started") == "bridge"]
    ends = [line["utc_s"] for line in records if line.get("killed") == "bridge"]
    begin_s, end_s = max(zip(starts, ends, strict=True), key=lambda life: life[1] - life[0])
    found = []
    for who in ("bridge", "hold"):
        at = [
            (line["utc_s"], line["rss_mb"][who])
            for line in records
            if who in line.get("rss_mb", {})
        ]
        part = [mb for utc_s, mb in at if begin_s + WARM_S <= utc_s < end_s]
        minutes = (end_s - begin_s - WARM_S) / 60
        name = f"{who}: memory at the end of {minutes:.0f} min with bridges"
        found.append(
            at_most(name, part[-1], "MB", round(1.05 * part[0], 1), "first minute", part[0])
        )
    return found


def figures(folder: Path) -> list[Figure]:
    """All figures of a measured folder."""
    records = lines(folder / "bench.jsonl")
    ((_, begin_s, end_s),) = (each for each in _phases(records) if each[0] == "bridges")
    span = at_least("minutes with bridges", (end_s - begin_s) / 60, "min", 0.0)
    return [
        span,
        *tick_figures(folder, records),
        *age_figures(folder, records),
        *memory_figures(records),
    ]


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--apart-minutes", type=float, default=10.0)
    parser.add_argument(
        "--raised",
        action="store_true",
        help="raise hold and bare loop above the machine's other work",
    )
    parser.add_argument(
        "--figures", action="store_true", help="only the figures of a folder that was measured"
    )
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # ends what was started, too
    if not options.figures:
        measure(options.folder.resolve(), options.minutes, options.apart_minutes, options.raised)
    show("bridges", figures(options.folder))
    return 0


if __name__ == "__main__":
    sys.exit(main())
