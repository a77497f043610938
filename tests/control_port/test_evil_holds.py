"""Clients of a hold survive any peer: one line, exit code 4, bounded memory and time; other holds
go on.
"""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from membrane_ctrl.cli import run
from membrane_ctrl.control_port import answers, ctl, message_syntax
from membrane_ctrl.control_port.client import PortClient
from membrane_ctrl.control_port.ctl import Where
from membrane_ctrl.model.errors import DeviceError
from membrane_ctrl.service.feed import HoldFeed
from membrane_ctrl.web.fleet_panel import fleet_rows
from tests.control_port import evil_holds as evil
from tests.worlds.port_run import port_run

BIDI = "\u202e"


@pytest.mark.parametrize("line", evil.GREETINGS.values(), ids=evil.GREETINGS)
def test_a_greeting_that_no_hold_sends_is_one_line(
    line: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with evil.peer(tmp_path / "control.sock", evil.greeting_with(line)) as path:
        assert run(["ctl", "status", "--socket", str(path)]) == 4
    printed = capsys.readouterr()
    assert len(printed.err.splitlines()) == 1
    assert str(path) in printed.err
    assert printed.out == ""


@pytest.mark.parametrize("action", ["status", "watch"])
@pytest.mark.parametrize("line", evil.ANSWERS.values(), ids=evil.ANSWERS)
def test_an_answer_that_no_hold_sends_is_one_line(
    action: str,
    line: bytes,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("membrane_ctrl.control_port.client.ANSWER_S", 2.0)
    monkeypatch.setattr(PortClient, "patience", lambda self, seconds: None)
    with evil.peer(tmp_path / "control.sock", evil.answering(line)) as path:
        assert run(["ctl", action, "--socket", str(path)]) == 4
    printed = capsys.readouterr()
    (error_lines,) = printed.err.splitlines()
    assert len(error_lines) < 500
    assert printed.out == ""
    assert all(letter.isprintable() for letter in error_lines)


def test_the_cause_names_the_field(tmp_path: Path) -> None:
    causes = {
        "error_text": "status.row.error_um",
        "error_inf": "status.row.error_um: not a finite number",
        "fault_part": "status.fault.name: missing",
        "notices_list": "status.notices",
        "status_missing": "status: missing",
        "long": "a line of more than 65536 bytes",
    }
    for name, cause in causes.items():
        with (
            evil.peer(tmp_path / f"{name}.sock", evil.answering(evil.ANSWERS[name])) as path,
            PortClient.unix(path, print) as hold,
            pytest.raises(DeviceError, match=cause),
        ):
            hold.ask(do="status")


NOTICE = {"topic": "maintenance", "subject": "leak", "severity": "warning"}


def test_texts_of_a_peer_cannot_drive_a_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = f"\x1b]0;owned\x07\x1b[2J\r\n{BIDI}<img src=x>"
    fault = {"code": 1, "name": text, "cause": text, "remedy": text}
    line = evil.status_line(
        why=text, fault=fault, notices=[{**NOTICE, "text": text}], commander=text
    )
    with evil.peer(tmp_path / "control.sock", evil.answering(line)) as path:
        assert run(["ctl", "status", "--socket", str(path)]) == 0
        with PortClient.unix(path, print) as hold:
            status = hold.ask(do="status")["status"]
    printed = capsys.readouterr().out
    assert "<img src=x>" in printed
    assert not {"\x1b", "\x07", "\r", BIDI} & set(printed)
    assert status["fault"]["cause"].isprintable()


def test_fields_of_a_later_version_pass(tmp_path: Path) -> None:
    line = evil.status_line(locks=[{"text": "hands inside", "author": "ann"}], later=1.5)
    with (
        evil.peer(tmp_path / "control.sock", evil.answering(line)) as path,
        PortClient.unix(path, print) as hold,
    ):
        status = hold.ask(do="status")["status"]
    assert status["locks"] == [{"text": "hands inside", "author": "ann"}]
    assert status["later"] == 1.5


@pytest.mark.real_time
@pytest.mark.parametrize("greets", [False, True])
def test_an_endless_line_takes_neither_memory_nor_time(greets: bool, tmp_path: Path) -> None:
    with evil.peer(tmp_path / "control.sock", evil.endless(greets)) as path:
        began_s = time.monotonic()
        done = subprocess.run(
            [sys.executable, "-c", _STATUS_AND_MEMORY, str(path)],
            capture_output=True,
            text=True,
            check=False,
        )
        took_s = time.monotonic() - began_s
    assert done.returncode == 4, done.stderr
    assert float(done.stdout) < 20
    assert took_s < 30.0
    assert "65536 bytes" in done.stderr


_STATUS_AND_MEMORY = """
import sys
from membrane_ctrl.cli import run
from membrane_ctrl.control_port import ctl
from tests.support.peak_memory import peak_mb, reset_peak
before_mb = reset_peak()
code = run(["ctl", "status", "--socket", sys.argv[1]])
print(peak_mb() - before_mb)
sys.exit(code)
"""


@pytest.mark.real_time
def test_a_line_that_dribbles_is_given_up_in_time(tmp_path: Path) -> None:
    with evil.peer(tmp_path / "control.sock", evil.dribbling) as path:
        began_s = time.monotonic()
        with pytest.raises(DeviceError, match="does not answer"):
            PortClient.unix(path, print, answer_s=0.3)
        assert time.monotonic() - began_s < 9.0  # the default limit is 10 s


def test_a_flood_of_valid_messages_is_given_up(tmp_path: Path) -> None:
    count = [0]

    def note(_: str) -> None:
        count[0] += 1

    with (
        evil.peer(tmp_path / "control.sock", evil.flooding) as path,
        PortClient.unix(path, note) as hold,
        pytest.raises(DeviceError, match="lines a second"),
    ):
        hold.ask(do="status")
    assert count[0] < 5000


def test_bursts_of_events_of_a_real_hold_pass(tmp_path: Path) -> None:
    burst = [
        json.dumps({"event": {"kind": "mark", "text": str(number)}}).encode()
        for number in range(300)
    ]
    with (
        evil.peer(tmp_path / "control.sock", evil.streaming(*burst, pause_s=5.0)) as path,
        PortClient.unix(path, print) as hold,
    ):
        hold.ask(do="watch")
        messages = hold.messages()
        found = [next(messages)["event"]["text"] for _ in burst]
    assert found == [str(number) for number in range(300)]


EVENTS = [
    b'{"event": "x"}',
    b'{"event": {}}',
    b'{"event": {"kind": 1}}',
    b'{"event": {"kind": "mark"}}',
    b'{"event": {"kind": "mark", "text": [1]}}',
    b'{"event": {"kind": "mark", "text": "x", "mono_s": "soon"}}',
    b'{"event": {"kind": "mark", "text": "x", "mono_s": 1e999}}',
    b'{"event": {"kind": "state", "state": [1], "from": {}, "why": 3}}',
    b'{"event": {"kind": "fault", "code": "x"}}',
    b'{"event": {"kind": "command", "command": "mark", "text": {"a": 1}}}',
    b'{"event": {"kind": "experiment_ended", "finished": "x"}}',
    b'{"status": [1]}',
    b'{"status": {"state": "hold", "why": "", "row": "x"}}',
]


async def hear_from(feed: HoldFeed) -> None:
    """Wait until a feed has contact."""
    async with asyncio.timeout(60.0):
        while feed.seen.silent:  # noqa: ASYNC110  a thread feeds it
            await asyncio.sleep(0.05)


@pytest.mark.real_time
def test_feeds_outlive_every_peer_and_leave_others_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("membrane_ctrl.service.feed._AGAIN_S", 0.05)
    peers = {f"greets_{name}": evil.greeting_with(line) for name, line in evil.GREETINGS.items()}
    peers |= {f"answers_{name}": evil.answering(line) for name, line in evil.ANSWERS.items()}
    peers |= {f"event_{number}": evil.streaming(line) for number, line in enumerate(EVENTS)}
    peers |= {
        "endless": evil.endless(True),
        "endless_greeting": evil.endless(False),
        "flooding": evil.flooding,
    }

    async def follow() -> None:
        with ExitStack() as stack:
            feeds = {
                name: HoldFeed(
                    Where(
                        stack.enter_context(evil.peer(tmp_path / f"{name}.sock", serve)),
                        logs=tmp_path,
                    )
                )
                for name, serve in peers.items()
            }
            async with port_run(tmp_path) as honest:
                feeds["honest"] = HoldFeed(Where(honest.path, logs=tmp_path))
                for feed in feeds.values():
                    feed.open()
                await hear_from(feeds["honest"])
                # A peer whose messages mean nothing is given up after five seconds.
                await asyncio.sleep(6.0)
                await hear_from(feeds["honest"])  # again, if the machine paused meanwhile
                rows = {str(row["hold"]): row for row in fleet_rows(feeds)}
                assert rows["honest"]["state"] == "hold"
                assert all(feed._thread.is_alive() for feed in feeds.values())
                for name in (
                    *(f"greets_{each}" for each in evil.GREETINGS),
                    *(f"answers_{a}" for a in evil.ANSWERS),
                ):
                    assert rows[name]["state"] == "no contact", name
                    assert ".sock: " in str(rows[name]["description"]), rows[name]
                for row in rows.values():
                    assert str(row["description"]).isprintable()
                for feed in feeds.values():
                    await asyncio.to_thread(feed.close)
                    assert not feed._thread.is_alive()

    asyncio.run(follow())


@pytest.mark.real_time
def test_a_fleet_lists_the_real_hold_beside_any_peers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ctl, "_FLEET_S", 4.0)
    peers = {
        f"a-{name.replace('_', '-')}": evil.answering(line) for name, line in evil.ANSWERS.items()
    }
    peers |= {"endless": evil.endless(True), "dribbling": evil.dribbling, "flooding": evil.flooding}
    names = [*peers, "honest"]
    fleet = tmp_path / "fleet.toml"
    fleet.write_text("".join(f'[[holds]]\nname = "{n}"\nsocket = "{n}.sock"\n' for n in names))

    async def ask() -> int:
        async with port_run(tmp_path) as honest:
            (tmp_path / "honest.sock").symlink_to(honest.path)
            return await asyncio.to_thread(run, ["ctl", "fleet", str(fleet)])

    with ExitStack() as stack:
        for name, serve in peers.items():
            stack.enter_context(evil.peer(tmp_path / f"{name}.sock", serve))
        began_s = time.monotonic()
        assert asyncio.run(ask()) == 4
        assert time.monotonic() - began_s < 30.0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(names)
    assert lines[-1].split()[:3] == ["honest", "hold", "0.25"]
    assert all("no contact" in line for line in lines[:-1])


def test_a_valid_message_passes_unchanged() -> None:
    status = evil.STATUS | {"gains": {"kp_per_s": 1, "ti_s": 2.5, "td_s": 0.0}, "commander": None}
    message = {"number": 3, "ok": True, "status": status, "loop": {"rate_hz": 50.0}, "pump": {}}
    assert answers.check_message(message_syntax.decode(json.dumps(message).encode())) == message
