"""The notifications to systemd, on our own socket; and the unit file."""

from __future__ import annotations

import configparser
import math
import socket
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from firmware_iface.roles import BenchCommand
from membrane_ctrl.controller.tick import TickOutputs
from membrane_ctrl.hold.systemd_notify import SystemdNotify
from membrane_ctrl.model.event_lines import from_dict
from membrane_ctrl.model.telemetry import FIELDS, State, TelemetryRow
from tests.support.machine_needs import needs

ROW = TelemetryRow(**dict.fromkeys(FIELDS, 0.0))
EXAMPLES = Path(__file__).parents[2] / "membrane_ctrl" / "examples"
HOLD_UNIT, SERVICE_UNIT = EXAMPLES / "membrane-hold@.service", EXAMPLES / "membrane-service.service"


def outputs(
    mono_s: float, state: State, error_um: float = math.nan, fault: float = 0
) -> TickOutputs:
    row = replace(ROW, mono_s=mono_s, state=state, error_um=error_um, fault=fault)
    return TickOutputs(BenchCommand(0.0, 0.0), row, (), None)


@pytest.fixture
def systemd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as heard:
        heard.bind(str(tmp_path / "notify"))
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        yield heard


def read_messages(heard: socket.socket) -> list[list[str]]:
    found = []
    while True:
        try:
            found.append(heard.recv(4096).decode().splitlines())
        except BlockingIOError:
            return found


def test_ready_once_then_the_watchdog_twice_a_second_and_at_each_change(
    systemd: socket.socket,
) -> None:
    with SystemdNotify() as notify:
        for tick in range(101):
            notify.handle_tick(outputs(tick * 0.02, State.CHECK))
        notify.handle_tick(outputs(2.02, State.HOLD, -0.42))
        notify.handle_tick(outputs(2.04, State.FAULT, fault=20))
    messages = read_messages(systemd)
    assert messages[0] == ["READY=1", "WATCHDOG=1", "STATUS=check"]
    assert messages[1:5] == [["WATCHDOG=1", "STATUS=check"]] * 4
    assert messages[5:] == [
        ["WATCHDOG=1", "STATUS=hold, error -0.42 µm"],
        ["WATCHDOG=1", "STATUS=fault, fault 20"],
        ["STOPPING=1", "WATCHDOG_USEC=120000000"],
    ]


def test_trouble_with_the_recording_is_in_the_status_until_it_is_over(
    systemd: socket.socket,
) -> None:
    with SystemdNotify() as notify:
        notify.note_report(
            from_dict(
                {
                    "kind": "disk_low",
                    "what": "disk",
                    "message": "/srv/\udcff: less than 500 MB\nfree",
                }
            )
        )
        notify.handle_tick(outputs(0.0, State.HOLD, fault=20))
        notify.note_report(
            from_dict({"kind": "recorder_recovered", "what": "disk", "message": "disk works again"})
        )
        notify.handle_tick(outputs(1.0, State.HOLD))
    messages = read_messages(systemd)
    assert messages[0][1:] == [
        "WATCHDOG=1",
        "STATUS=hold, fault 20, recording: Disk almost full: /srv/?: less than 500 MB free",
    ]
    assert messages[1] == ["WATCHDOG=1", "STATUS=hold"]


def test_without_systemd_or_after_its_end_nothing_happens(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    with SystemdNotify() as notify:
        notify.handle_tick(outputs(0.0, State.HOLD))
    with SystemdNotify(str(tmp_path / "nobody")) as notify:
        notify.handle_tick(outputs(0.0, State.HOLD))


def test_a_full_socket_is_not_waited_for(systemd: socket.socket) -> None:
    with SystemdNotify() as notify:
        for tick in range(5000):
            notify.handle_tick(outputs(float(tick), State.HOLD))
    assert 0 < len(read_messages(systemd)) < 5000


def test_the_unit_stops_what_it_must_and_never_restarts_into_a_fault() -> None:
    unit = configparser.ConfigParser(strict=False, interpolation=None, delimiters=("=",))
    unit.optionxform = str  # type: ignore[assignment,method-assign]
    unit.read(HOLD_UNIT)
    service = unit["Service"]
    assert service["Type"] == "notify"
    # the children ignore what a terminal sends, and so outlive the control process to close the run
    # and tell people
    assert (service["KillMode"], service["KillSignal"], service["WatchdogSignal"]) == (
        "control-group",
        "SIGINT",
        "SIGQUIT",
    )
    assert " safe " in service["ExecStopPost"]
    assert {"2", "4", "5"} <= set(service["RestartPreventExitStatus"].split())
    assert float(service["WatchdogSec"]) >= 5.0


@needs("systemd-analyze")
@pytest.mark.parametrize("example", [HOLD_UNIT, SERVICE_UNIT], ids=["hold", "service"])
def test_systemd_accepts_a_unit_file_and_calls_it_protected(example: Path, tmp_path: Path) -> None:
    unit = tmp_path / example.name.replace("@", "@lab")
    unit.write_text(
        example.read_text().replace("/opt/membrane-ctrl/.venv/bin/membrane-ctrl", sys.executable)
    )
    for words in (
        ["verify", str(unit)],
        ["security", "--offline=true", "--threshold=40", str(unit)],
    ):
        done = subprocess.run(
            ["systemd-analyze", *words], capture_output=True, text=True, timeout=60, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
        assert str(unit) not in done.stderr  # a complaint names the file
        assert unit.name + ":" not in done.stderr
