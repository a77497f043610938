"""The tutorial: its commands run, and print what the page shows.

A command is a line of an `sh` block; the `text` block after it shows what it prints. A line `...`
stands for lines that the page leaves out. Dates, folders and times that commands took differ in
each run, and so do all numbers of a hold in real time; the simulated bench and the measurement
give the numbers of the page, but for rounding.
"""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from membrane_ctrl.model.errors import Exit

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "tutorials" / "first-run.md"
PROGRAM = ".venv/bin/membrane-ctrl "
# The first command of each block
REAL_TIME = ("hold --twin --duration 2m --name demo", "ctl status", "ctl setpoint 5")
PLAYED = ("twin play", "twin play laser_knocked", "report last")
MEASURED = ("simulate set1", "simulate set2 --shrink 4 --fault stale:x_sin_2")
NOT_RUN = ("make hold", "review last")  # the first makes an environment, the second opens a window
# A rejected measurement and a fault that ends a hold are what the page describes
SUCCESSES = frozenset({Exit.DONE, Exit.REJECTED, Exit.SAFETY_TRIP})
_START_S = 300.0
# The figures of a hold count from 5 s after the setpoint was reached.
_SETTLED_S = 15.0
_NUMBER = re.compile(r"[-+]?\d+(?:[.:]\d+)*")
_DIFFERS = (
    (re.compile(r"\d{8}T\d{6}Z"), "<time>"),
    (re.compile(r"(?<=\()[\d.]+ s\)|(?<=in )[\d.]+ s$"), "<duration>"),
    (re.compile(r"/[^ ]*/(?=logs/)"), ""),
)


@dataclass(frozen=True)
class Step:
    """Commands of one block, and the lines that the page shows after them."""

    commands: tuple[str, ...]
    shown: tuple[str, ...]


def steps_of(page: str) -> list[Step]:
    """The blocks of commands, each with the block of text before the next one."""
    steps: list[Step] = []
    for language, text in re.findall(r"```(sh|text)\n(.*?)```", page, re.DOTALL):
        if language == "sh":
            steps.append(Step(tuple(text.splitlines()), ()))
        else:
            steps[-1] = Step(steps[-1].commands, (*steps[-1].shown, *text.splitlines()))
    return steps


def step_with(command: str) -> Step:
    """The step of the page that begins with this command."""
    steps = {step.commands[0].removeprefix(PROGRAM): step for step in steps_of(PAGE.read_text())}
    return steps[command]


def agrees(shown: str, printed: str, numbers: bool) -> bool:
    """Whether a printed line is that of the page.

    Numbers may differ by two units of the last digit that the page shows: other processors and
    libraries round otherwise.
    """

    def words_of_line(line: str) -> str:
        for pattern, name in _DIFFERS:
            line = pattern.sub(name, line)
        return " ".join(line.split())

    shown, printed = words_of_line(shown), words_of_line(printed)
    if _NUMBER.sub("#", shown) != _NUMBER.sub("#", printed):
        return False
    pairs = zip(_NUMBER.findall(shown), _NUMBER.findall(printed), strict=True)
    return not numbers or all(_are_close(*pair) for pair in pairs)


def _are_close(shown: str, printed: str) -> bool:
    try:
        difference = abs(float(printed) - float(shown))
    except ValueError:  # a time of day, a version
        return shown == printed
    decimals = len(shown.partition(".")[2])
    return difference <= 2.001 * 10.0**-decimals


def missing_lines(shown: tuple[str, ...], printed: str, numbers: bool = True) -> list[str]:
    """The lines of the page that the printed ones do not have, in this order."""
    rest = printed.splitlines()
    missing = []
    for line in shown:
        if line.strip() in ("", "..."):
            continue
        place = next((k for k, each in enumerate(rest) if agrees(line, each, numbers)), None)
        if place is None:
            missing.append(line)
        else:
            del rest[: place + 1]
    return missing


def words_of(command: str) -> list[str]:
    return [sys.executable, "-m", "membrane_ctrl", *shlex.split(command.removeprefix(PROGRAM))]


def run_program(command: str, folder: Path, codes: frozenset[int] | None = SUCCESSES) -> str:
    """What a command of the page prints; `codes` are the exit codes of a success or a finding."""
    done = subprocess.run(
        words_of(command),
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},  # the order of a terminal
        check=False,
    )
    assert codes is None or done.returncode in codes, done.stdout
    return done.stdout


def run_step(step: Step, folder: Path, numbers: bool = True) -> None:
    """Run the commands of a step and compare what they print with the page."""
    printed = "".join(run_program(command, folder) for command in step.commands)
    assert missing_lines(step.shown, printed, numbers) == [], printed


def test_every_command_of_the_page_is_run_here() -> None:
    first = [step.commands[0].removeprefix(PROGRAM) for step in steps_of(PAGE.read_text())]
    assert set(first) == {*REAL_TIME, *PLAYED, *MEASURED, *NOT_RUN}
    assert "hold --twin --duration 2m --name demo" in (ROOT / "Makefile").read_text()


def test_a_changed_line_is_noticed() -> None:
    assert missing_lines(("sag 1.0 mm", "..."), "verdict ok\nsag   1.0 mm\n") == []
    assert missing_lines(("sag 1.2 mm",), "sag 1.0 mm\n") == []
    assert missing_lines(("sag 1.3 mm",), "sag 1.0 mm\n") == ["sag 1.3 mm"]
    assert missing_lines(("sag 1.3 mm",), "sag 1.0 mm\n", numbers=False) == []
    assert missing_lines(("sag 1.0 mm",), "sag 1.0 um\n") == ["sag 1.0 mm"]
    assert missing_lines(("b", "a"), "a\nb\n") == ["a"]
    assert missing_lines(("x (22.6 s)",), "x (1.0 s)\n") == []


@pytest.mark.fast_cases("simulate set2 --shrink 4 --fault stale:x_sin_2")
@pytest.mark.parametrize("command", MEASURED)
def test_images_are_measured(command: str, tmp_path: Path) -> None:
    run_step(step_with(command), tmp_path)


def test_a_fault_is_played_and_reported(tmp_path: Path) -> None:
    for command in PLAYED:
        run_step(step_with(command), tmp_path)


@pytest.mark.real_time
def test_a_hold_is_commanded_from_a_second_terminal(tmp_path: Path) -> None:
    hold, status, setpoint = map(step_with, REAL_TIME)
    end = next(place for place, line in enumerate(setpoint.shown) if line.startswith("true centre"))
    command = hold.commands[0].replace("2m", "20m")  # Ctrl-C ends it earlier
    with start_program(command, tmp_path) as process:
        repeat_until_shown(status, tmp_path)
        run_step(replace(setpoint, shown=setpoint.shown[:end]), tmp_path)
        time.sleep(_SETTLED_S)
        process.send_signal(signal.SIGINT)
        printed, _ = process.communicate(timeout=_START_S)
    shown = (*hold.shown, *setpoint.shown[end:])
    assert missing_lines(shown, printed, numbers=False) == [], printed


def repeat_until_shown(step: Step, folder: Path) -> None:
    """Repeat a command until it prints what the page shows."""
    deadline_s = time.monotonic() + _START_S
    while time.monotonic() < deadline_s:
        printed = run_program(step.commands[0], folder, codes=None)
        if missing_lines(step.shown, printed, numbers=False) == []:
            return
        time.sleep(0.5)
    raise AssertionError(printed)


@contextmanager
def start_program(command: str, folder: Path) -> Iterator[subprocess.Popen[str]]:
    """A command of the page as a process, which does not outlive the test."""
    process = subprocess.Popen(
        words_of(command), cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    try:
        yield process
    finally:
        if process.poll() is None:
            process.terminate()
            process.wait()
