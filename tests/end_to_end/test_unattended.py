"""A service as systemd starts it: reports every start, stays down with a latched fault, waits in
standby.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from patience import slow_machine

from membrane_ctrl.model.errors import Exit
from membrane_ctrl.run_files.latched_fault import NAME

pytestmark = pytest.mark.real_time

CONFIG = (
    slow_machine()
    + "[twin]\nport = 0\n[shape]\nenabled = false\n[states]\nlatch_twin_faults = true\n"
)


def start(folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    (folder / "lab.toml").write_text(CONFIG)
    arguments = (
        "hold",
        "--twin",
        "--config",
        str(folder / "lab.toml"),
        "--logs",
        str(folder / "logs"),
    )
    return subprocess.run(
        [sys.executable, "-m", "membrane_ctrl", *arguments, *options],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        env={**os.environ, "NOTIFY_SOCKET": str(folder / "notify")},
    )


def told_until_it_stops(systemd: socket.socket) -> list[list[str]]:
    messages: list[list[str]] = []
    while messages[-1:] != [["STOPPING=1", "WATCHDOG_USEC=120000000"]]:
        messages.append(systemd.recv(4096).decode().splitlines())
    return messages


def test_standby_is_reported_to_systemd_and_a_corrupt_latched_file_prevents_the_hold(
    tmp_path: Path,
) -> None:
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / NAME).write_text("{")
    with (
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd,
        ThreadPoolExecutor(1) as beside,
    ):
        systemd.bind(str(tmp_path / "notify"))
        systemd.settimeout(120)
        refused = start(tmp_path)
        assert refused.returncode == Exit.DEVICE_FAILED
        line = refused.stderr.strip().splitlines()[-1]
        assert NAME in line
        assert "--clear-faults" in line
        future = beside.submit(told_until_it_stops, systemd)
        waited = start(tmp_path, "--standby", "--duration", "6s")
        assert waited.returncode == Exit.DONE, waited.stderr
        messages = future.result()
    assert messages[0] == ["READY=1", "WATCHDOG=1", "STATUS=standby"]
    assert sum("WATCHDOG=1" in message for message in messages) >= 4
    assert (tmp_path / "logs" / NAME).read_text() == "{"  # nobody has acknowledged it
