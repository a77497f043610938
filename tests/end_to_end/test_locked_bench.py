"""Hands inside: whatever others try on this machine, a locked bench does not move until the lock is
removed.
"""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import pytest
from patience import slow_machine
from pymodbus.client import ModbusTcpClient

from membrane_ctrl.cli import run
from membrane_ctrl.control_port.client import PortClient
from membrane_ctrl.instruments.lock_store import VARIABLE
from membrane_ctrl.model.errors import DeviceError

pytestmark = pytest.mark.real_time

PATIENCE_S = 60.0
PUMP_REGISTER = 32
BOB = {"via": "page", "account": "bob", "name": "bob", "session": "page 1f", "role": "operate"}
LINK = {"via": "page", "account": "", "name": "link", "session": "page 2a", "role": "tune"}
BRIDGE = {"via": "bridge", "name": "mqtt", "role": "operate"}


def wait_for(what: Callable[[], bool]) -> None:
    give_up_s = time.monotonic() + PATIENCE_S
    while not what():
        assert time.monotonic() < give_up_s, "waited in vain"
        time.sleep(0.05)


class Lab:
    """A twin's board as the only device, and holds of it as their users start them."""

    def __init__(self, folder: Path, port: int) -> None:
        self.folder, self.board = folder, f"tcp://127.0.0.1:{port}"
        self._programs: list[subprocess.Popen[str]] = []
        (folder / "twin.toml").write_text(f"[twin]\nport = {port}\n")
        (folder / "lab.toml").write_text(slow_machine(self.board) + "[shape]\nenabled = false\n")
        self.start("twin", "--config", str(folder / "twin.toml"))
        self.client = ModbusTcpClient("127.0.0.1", port=port, timeout=20)
        wait_for(lambda: bool(self.client.connect()))

    def start(self, *words: str) -> subprocess.Popen[str]:
        """Start one of our commands as a process."""
        program = subprocess.Popen(
            [sys.executable, "-m", "membrane_ctrl", *words],
            stderr=subprocess.PIPE,
            text=True,
            cwd=self.folder,
        )
        self._programs.append(program)
        return program

    def hold(self, *words: str) -> subprocess.Popen[str]:
        """Start a hold, and wait until it listens."""
        program = self.start(
            "hold", "--config", "lab.toml", "--logs", str(self.folder / "logs"), *words
        )
        wait_for(lambda: program.poll() is not None or self.answers())
        return program

    def answers(self) -> bool:
        try:
            return "row" in self.ask(do="status")["status"]
        except DeviceError:
            return False

    def ask(self, **request: Any) -> dict[str, Any]:
        """One request at the hold's socket, as the hold's own user."""
        with PortClient.unix(
            self.folder / "logs" / "control.sock", notice=lambda _: None
        ) as client:
            return client.ask(**request)

    def pump(self) -> int:
        reply = self.client.read_holding_registers(PUMP_REGISTER, count=1, device_id=1)
        assert not reply.isError()
        return reply.registers[0]

    def events(self, kind: str) -> list[dict[str, Any]]:
        lines = [
            line
            for path in sorted(self.folder.glob("logs/*/events.jsonl"))
            for line in path.read_text().splitlines()
        ]
        return [event for event in map(json.loads, lines) if event["kind"] == kind]

    def close(self) -> None:
        self.client.close()
        for program in reversed(self._programs):
            program.kill()
            program.communicate()


@pytest.fixture
def lab(tmp_path: Path, unused_tcp_port: int) -> Iterator[Lab]:
    made = Lab(tmp_path, unused_tcp_port)
    yield made
    made.close()


def refused(*words: str) -> str:
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        code = run(list(words))
    assert code == 4, (words, out.getvalue(), err.getvalue())
    return err.getvalue().strip().splitlines()[-1]


def test_nothing_moves_a_locked_mirror_until_its_lock_is_removed(lab: Lab) -> None:
    hold = lab.hold()
    wait_for(lambda: lab.pump() > 0)
    lab.ask(do="latch", text="hands inside", on_behalf=LINK | {"account": "ann"})
    wait_for(lambda: lab.pump() == 0)
    assert hold.wait(PATIENCE_S) == 5  # a fault, as `states.stay_after_trip` is false
    logs, other = str(lab.folder / "logs"), str(lab.folder / "other")
    config = str(lab.folder / "lab.toml")
    for words in (
        ("hold", "--config", config, "--logs", logs),
        ("hold", "--config", config, "--logs", logs, "--clear-faults"),
        ("hold", "--config", config, "--logs", other),
        ("hold", "--config", config, "--logs", other, "--clear-faults", "--autotune"),
        ("conformance", lab.board),
        ("conformance", lab.board.replace("127.0.0.1", "localhost")),
    ):
        line = refused(*words)
        for part in ("locked", "hands inside", "page:ann", "locks remove"):
            assert part in line
        assert lab.pump() == 0
    standby = lab.hold("--standby")
    (lock,) = lab.ask(do="status")["status"]["locks"]
    assert (lock["text"], lock["author"]) == ("hands inside", "page:ann")
    socket = str(lab.folder / "logs/control.sock")
    for words in (("tune", "run", "--short", "--yes"), ("calibrate", "--live")):
        assert "locked" in refused(*words, "--socket", socket)
    for request in (
        {"do": "ack", "on_behalf": BOB},
        {"do": "hold", "on_behalf": BOB},
        {"do": "ack", "on_behalf": BRIDGE},
        {"do": "unlock", "text": lock["word"], "on_behalf": BRIDGE},
        {"do": "unlock", "on_behalf": BOB},
        {"do": "unlock", "text": "wrong", "on_behalf": BOB},
        {"do": "unlock", "on_behalf": LINK},
        {"do": "hold"},
        {"do": "unlock"},
    ):
        answer = lab.ask(**request)
        assert answer["ok"] == (request["do"] == "ack"), answer
        assert lab.ask(do="status")["status"]["state"] == "standby"
        assert lab.pump() == 0
    answer = lab.ask(do="unlock", text=lock["word"], on_behalf=BOB)
    assert (answer["ok"], answer["stored"]) == (True, True)
    wait_for(lambda: bool(lab.events("unlock")))
    (removed,) = lab.events("unlock")
    assert (removed["author"], removed["remover"], removed["how"]) == (
        "page:ann",
        "page:bob",
        "word",
    )
    wrong = [
        event
        for event in lab.events("command")
        if event["command"] == "unlock" and event.get("refused")
    ]
    assert "wrong" in [event.get("text") for event in wrong]
    assert lab.ask(do="hold")["ok"]
    wait_for(lambda: lab.pump() > 0)
    standby.send_signal(signal.SIGINT)
    assert standby.wait(PATIENCE_S) == 130


def test_a_lock_that_cannot_be_stored_holds_for_the_run_and_is_reported(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (lab.folder / "file").write_text("")
    monkeypatch.setenv(VARIABLE, str(lab.folder / "missing"))
    lab.hold("--standby")
    (lab.folder / "missing").write_text("no folder")
    socket = str(lab.folder / "logs/control.sock")
    assert run(["ctl", "lock", "hands inside", "--socket", socket]) == 4
    assert "NOT STORED" in capsys.readouterr().err
    assert run(["ctl", "hold", "--socket", socket]) == 2
    assert "hands inside" in capsys.readouterr().err
    assert run(["ctl", "status", "--socket", socket]) == 0
    assert "NOT STORED" in capsys.readouterr().out
    (lab.folder / "missing").unlink()
    assert run(["ctl", "lock", "lens off", "--socket", socket]) == 0
    assert run(["ctl", "unlock", "--socket", socket]) == 2  # two of the same login
    assert "several" in capsys.readouterr().err


def test_safe_stops_a_hold_that_it_does_not_find(lab: Lab) -> None:
    """The hold's folder of runs is not the configured one: `safe` stores a lock, and the hold sees
    it.
    """
    lab.hold()
    wait_for(lambda: lab.pump() > 0)
    assert run(["safe", str(lab.folder / "lab.toml"), "--logs", str(lab.folder / "elsewhere")]) == 0
    wait_for(lambda: bool(lab.events("lock")))
    (lock,) = lab.events("lock")
    assert lock["text"] == "made safe by hand"
    wait_for(lambda: lab.pump() == 0)


def test_locks_are_listed_and_removed_without_a_hold(
    lab: Lab, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    config = str(lab.folder / "lab.toml")
    assert run(["safe", config]) == 0
    capsys.readouterr()
    assert run(["locks"]) == 0
    assert "made safe by hand" in capsys.readouterr().out
    assert run(["locks", "remove", "wrong"]) == 2
    assert "no lock has the word" in capsys.readouterr().err
    assert run(["locks", "remove"]) == 0  # our own
    assert run(["locks", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["locks"] == []
    (log,) = Path(os.environ[VARIABLE]).glob("removed.log")
    assert json.loads(log.read_text())["how"] == "author"


def test_a_lock_of_a_running_hold_is_removed_there(
    lab: Lab, capsys: pytest.CaptureFixture[str]
) -> None:
    lab.hold("--standby")
    lab.ask(do="latch", text="hands inside")
    assert "ctl unlock" in refused("locks", "remove")
    assert lab.ask(do="unlock")["stored"]
    assert run(["locks"]) == 0
    assert capsys.readouterr().out == ""
