"""Holds are started as programs that outlive the service, or as units of systemd."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from membrane_ctrl.config.port import SOCKET_NAME, PortConfig
from membrane_ctrl.control_port.sockets import UnixListener
from membrane_ctrl.model.errors import InputError
from membrane_ctrl.service import hold_starter
from membrane_ctrl.service.hold_starter import (
    LOG_NAME,
    HoldStarter,
    StartOptions,
    find_name_of_run,
    options_file,
)

# in place of the interpreter: writes its words, session and niceness, and ends
PROGRAM = """#!{python}
import os, sys
print(*sys.argv[1:], os.getsid(0) == os.getpid(), os.getpriority(os.PRIO_PROCESS, 0))
sys.exit({code})
"""
DEVICES = '[devices]\nboard = "tcp://127.0.0.1:1502"\n'


def write_program(path: Path, code: int = 0) -> Path:
    path.write_text(PROGRAM.format(python=sys.executable, code=code))
    path.chmod(0o755)
    return path


@contextmanager
def starter_of(folder: Path, units: bool = False) -> Iterator[HoldStarter]:
    (folder / "configurations").mkdir(exist_ok=True)
    starter = HoldStarter(folder / "logs", folder / "configurations", units)
    try:
        yield starter
    finally:
        starter.close()


def wait_for_end(starter: HoldStarter) -> None:
    give_up_s = time.monotonic() + 60.0
    while starter.is_running():
        assert time.monotonic() < give_up_s
        time.sleep(0.02)


def test_configurations_are_listed_with_what_is_wrong(tmp_path: Path) -> None:
    with starter_of(tmp_path) as starter:
        folder = tmp_path / "configurations"
        (folder / "lab.toml").write_text(DEVICES)
        (folder / "quiet.toml").write_text("[twin]\nport = 0\n")
        (folder / "bad.toml").write_text("[loop]\nkp = 1\n")
        (folder / "a b.toml").write_text("")
        (folder / "notes.txt").write_text("")
        listed = {each.name: each for each in starter.list_configurations()}
        assert list(listed) == ["twin", "bad", "lab", "quiet"]
        assert [each.has_devices for each in listed.values()] == [False, False, True, False]
        assert "kp" in listed["bad"].problem
        with pytest.raises(InputError, match="kp"):
            starter.start_hold("bad", "anna", StartOptions())
        with pytest.raises(InputError, match="no such configuration; known: twin, bad, lab, quiet"):
            starter.start_hold("../lab", "anna", StartOptions())
    with starter_of(tmp_path, units=True) as starter:
        assert [each.name for each in starter.list_configurations()] == ["bad", "lab"]


def test_a_program_has_its_own_session_and_not_the_services_priority(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "executable", str(write_program(tmp_path / "python")))
    own = os.getpriority(os.PRIO_PROCESS, 0)
    with starter_of(tmp_path) as starter:
        (tmp_path / "configurations" / "lab.toml").write_text(DEVICES)
        file = tmp_path / "configurations" / "lab.toml"
        options = StartOptions(standby=True, clear_faults=True)
        starter.start_hold("lab", "anna", options).result()
        wait_for_end(starter)
        log_text = (tmp_path / "logs" / LOG_NAME).read_text()
        words = f"hold --logs {tmp_path / 'logs'} --name lab --standby --clear-faults"
        assert log_text == f"-m membrane_ctrl {words} --config {file} True {own}\n"
        assert starter.failure == ""


@pytest.mark.parametrize(
    ("end", "failure"),
    [
        ("os.kill(os.getpid(), 9)", "the hold was ended by SIGKILL; its output is in hold.log"),
        ("sys.exit(5)", ""),  # a fault: the record of the run states it
    ],
)
def test_the_end_of_a_run_is_no_failed_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, end: str, failure: str
) -> None:
    program = tmp_path / "python"
    program.write_text(f"#!{sys.executable}\nimport os, sys\n{end}\n")
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    with starter_of(tmp_path) as starter:
        starter.start_hold("twin", "anna", StartOptions()).result()
        wait_for_end(starter)
        assert starter.failure == failure


def test_a_hold_that_does_not_start_prints_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "executable", str(write_program(tmp_path / "python", code=4)))
    with starter_of(tmp_path) as starter:
        starter.start_hold("twin", "anna", StartOptions()).result()
        wait_for_end(starter)
        assert starter.failure.startswith("the hold ended with code 4: -m membrane_ctrl hold")
        assert "--twin" in starter.failure
        monkeypatch.setattr(sys, "executable", str(tmp_path / "absent"))
        starter.start_hold("twin", "anna", StartOptions()).result()
        assert starter.failure == "the hold was not started: no such file or directory"


def test_a_second_hold_is_not_started(tmp_path: Path) -> None:
    listener = UnixListener(tmp_path / "logs" / SOCKET_NAME, None, PortConfig().group_role)
    try:
        with starter_of(tmp_path) as starter, pytest.raises(InputError, match="runs already"):
            starter.start_hold("twin", "anna", StartOptions())
    finally:
        listener.close()


def test_the_log_of_a_hold_stays_short(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hold_starter, "_LOG_BYTES_MAX", 10)
    (tmp_path / "logs").mkdir()
    log = tmp_path / "logs" / LOG_NAME
    with starter_of(tmp_path) as starter:
        starter.limit_log()
        log.write_text("short")
        starter.limit_log()
        assert log.read_text() == "short"
        log.write_text("x" * 11)
        starter.limit_log()
        assert log.read_text() == ""


SYSTEMCTL = """#!/bin/sh
echo "$@" >> {folder}/called
cat {options} >> {folder}/called
if [ -e {folder}/denied ]; then echo 'Access denied' >&2; exit 4; fi
"""


def test_a_unit_gets_its_options_for_one_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "logs").mkdir()
    options = options_file(tmp_path / "logs", "lab")
    (tmp_path / "bin").mkdir()
    systemctl = tmp_path / "bin" / "systemctl"
    systemctl.write_text(SYSTEMCTL.format(folder=tmp_path, options=options))
    systemctl.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}")
    with starter_of(tmp_path, units=True) as starter:
        (tmp_path / "configurations" / "lab.toml").write_text(DEVICES)
        starter.start_hold("lab", "anna", StartOptions(standby=True)).result()
        assert (tmp_path / "called").read_text() == (
            "--no-ask-password start membrane-hold@lab.service\nHOLD_OPTIONS=--standby\n"
        )
        assert not options.exists(), "a restart by systemd must not clear a fault again"
        assert starter.failure == ""
        (tmp_path / "denied").touch()
        starter.start_hold("lab", "anna", StartOptions()).result()
        assert starter.failure == ("Access denied See `journalctl -u membrane-hold@lab.service`")


@pytest.mark.parametrize(
    ("run", "found"),
    [
        ("20261121T012345Z-lab", "lab"),
        ("20261121T012345Z-new-lab", "new-lab"),
        ("20261121T012345Z-lab-2", "lab"),  # the second run of this second
        ("20261121T012345Z-other-lab", None),
        ("20261121T012345Z-hold", None),
        ("", None),
    ],
)
def test_the_configuration_of_a_run_is_found_by_its_whole_name(run: str, found: str | None) -> None:
    assert find_name_of_run(run, ["lab", "new-lab"]) == found
