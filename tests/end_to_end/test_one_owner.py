"""Two programs and one bench on one machine, as their users start them: the second changes nothing
of a hold.
"""

from __future__ import annotations

import io
import json
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import pytest
from patience import slow_machine
from pymodbus.client import ModbusTcpClient

from membrane_ctrl.cli import run

pytestmark = pytest.mark.real_time

PATIENCE_S = 60.0
SENSORS, PUMP, PERIOD, CLAIM, FAULTS = 16, 32 - 16, 38 - 16, 39 - 16, 37 - 16


def wait_for(what: Callable[[], bool]) -> None:
    give_up_s = time.monotonic() + PATIENCE_S
    while not what():
        assert time.monotonic() < give_up_s, "waited in vain"
        time.sleep(0.05)


class Bench:
    """A hold of the twin in a process, and a plain client that looks at its board."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "twin.toml").write_text(
            slow_machine() + "[twin]\nport = 0\n[shape]\nenabled = false\n"
        )
        words = [
            "hold",
            "--twin",
            "--config",
            str(folder / "twin.toml"),
            "--logs",
            str(folder / "logs"),
        ]
        self.process = subprocess.Popen(
            [sys.executable, "-m", "membrane_ctrl", *words], stderr=subprocess.PIPE
        )
        wait_for(lambda: bool(list(folder.glob("logs/*/config.toml"))))
        run_dir = next(folder.glob("logs/*/config.toml"))
        self.board = str(tomllib.loads(run_dir.read_text())["devices"]["board"])
        self.client = ModbusTcpClient(
            "127.0.0.1", port=int(self.board.rpartition(":")[2]), timeout=20
        )
        assert self.client.connect()
        wait_for(lambda: self.sensors()[PUMP] > 0)
        (folder / "slow.toml").write_text(
            f'[devices]\nboard = "{self.board}"\nwatchdog_s = 1.5\n[recording]\nlogs_dir = '
            f'"{folder}/other"\n'
        )

    def sensors(self) -> list[int]:
        reply = self.client.read_holding_registers(SENSORS, count=25, device_id=1)
        assert not reply.isError()
        return reply.registers

    def claim(self) -> list[int]:
        return self.sensors()[PERIOD : CLAIM + 2]

    def events(self) -> list[dict[str, object]]:
        (path,) = self.folder.glob("logs/*/events.jsonl")
        return [json.loads(line) for line in path.read_text().splitlines()]

    def close(self) -> None:
        self.client.close()
        self.process.kill()
        self.process.communicate()


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    made = Bench(tmp_path)
    yield made
    made.close()


def refused(*words: str) -> str:
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        code = run(list(words))
    assert code == 4, err.getvalue()
    return err.getvalue().strip().splitlines()[-1]


def test_beside_a_hold_nothing_else_opens_its_board_and_safe_stops_it_for_good(
    bench: Bench,
) -> None:
    slow, logs = str(bench.folder / "slow.toml"), str(bench.folder / "logs")
    before = bench.claim()
    assert before[0] == 2000
    for words in (
        ("check", slow),
        ("hold", "--config", slow, "--logs", str(bench.folder / "other")),
        ("conformance", bench.board),
        ("safe", slow, "--no-latch"),
    ):
        assert f"in use by process {bench.process.pid}" in refused(*words)
        assert bench.claim() == before
    assert bench.process.poll() is None
    assert bench.sensors()[FAULTS] == 0
    assert bench.sensors()[PUMP] > 0
    assert run(["safe", slow, "--logs", logs]) == 0
    assert bench.sensors()[PUMP] == 0
    assert bench.process.wait(PATIENCE_S) == 5
    wait_for(lambda: any(event["kind"] == "end" for event in bench.events()))
    (fault,) = [event for event in bench.events() if event["kind"] == "fault"]
    assert fault["name"] in ("board_fault", "locked")
    assert not [event for event in bench.events() if event["kind"] == "resumed"]
    (lock,) = [event for event in bench.events() if event["kind"] == "lock"]
    assert lock["text"]
