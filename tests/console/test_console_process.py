"""The process on a terminal and off it."""

from __future__ import annotations

import multiprocessing
import os
import pty
import select
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, redirect_stderr
from dataclasses import replace
from pathlib import Path

import pytest
from console_feed import FAULT, event, packed, rows, shape

from membrane_ctrl.config.schema import Config
from membrane_ctrl.console.process import ConsoleSpec, console_main, restore_terminal
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.shape_estimate import pack_estimate
from membrane_ctrl.model.telemetry import ROW_BYTES
from membrane_ctrl.processes import child
from membrane_ctrl.processes.child import STOP
from membrane_ctrl.processes.ring import RingWriter, open_ring

pytestmark = pytest.mark.real_time

PATIENCE_S = 20.0


class Run:
    """Rings with a made-up run in them, and a console process that shows it."""

    def __init__(self, stack: ExitStack) -> None:
        telemetry = stack.enter_context(open_ring(256, ROW_BYTES))
        events = stack.enter_context(open_ring(16, 4096))
        shapes = stack.enter_context(open_ring(4, 1 << 16))
        self.spec = ConsoleSpec(
            RunClock.start(), telemetry, events, shapes, Path("logs/demo"), Config(), 60.0
        )
        self._telemetry = stack.enter_context(closing(RingWriter(telemetry)))
        self._events = stack.enter_context(closing(RingWriter(events)))
        self._shapes = stack.enter_context(closing(RingWriter(shapes)))

    def tick(self) -> None:
        for row in rows(0.1, self.spec.clock.now()):
            self._telemetry.put(row.pack())
        self._shapes.put(pack_estimate(shape()))

    def put_event(self, kind: str, **more: object) -> None:
        self._events.put(packed(event(self.spec.clock.now(), kind, **more)))

    def start(self, stderr: int) -> multiprocessing.process.BaseProcess:
        process = multiprocessing.get_context("spawn").Process(
            target=on_stderr, args=(self.spec, os.ttyname(stderr))
        )
        process.start()
        return process


def on_stderr(spec: ConsoleSpec, path: str) -> None:
    """Give the console process a stderr of its own."""
    os.environ["TERM"] = "xterm-256color"
    handle = os.open(path, os.O_RDWR | os.O_NOCTTY)
    os.dup2(handle, 2)
    sys.stderr = open(2, "w", closefd=False)  # noqa: SIM115
    console_main(spec)


@pytest.fixture
def run() -> Iterator[Run]:
    with ExitStack() as stack:
        yield Run(stack)


@pytest.fixture
def terminal() -> Iterator[tuple[int, int]]:
    ours, theirs = pty.openpty()
    yield ours, theirs
    os.close(ours)
    os.close(theirs)


def read_until(handle: int, words: bytes, seen: bytes = b"") -> bytes:
    while words not in seen:
        assert select.select([handle], [], [], PATIENCE_S)[0], (
            f"{words!r} never came: {seen[-300:]!r}"
        )
        seen += os.read(handle, 1 << 16)
    return seen


def finish(process: multiprocessing.process.BaseProcess, handle: int) -> bytes:
    seen = read_until(handle, b"\x1b[?1049l")  # the terminal's own page is back
    process.join(PATIENCE_S)
    assert process.exitcode == 0
    return seen


def test_terminal_shows_the_run_and_is_given_back_at_the_end(
    run: Run, terminal: tuple[int, int]
) -> None:
    ours, theirs = terminal
    run.tick()
    process = run.start(theirs)
    read_until(ours, b"faults")
    run.put_event("end", exit="done")
    assert b"\x1b[?25h" in finish(process, ours)  # the cursor too


@pytest.mark.parametrize("number", [STOP, signal.SIGINT])
def test_terminal_is_given_back_on_a_stop_and_sigint_is_not_for_us(
    run: Run, terminal: tuple[int, int], number: signal.Signals
) -> None:
    ours, theirs = terminal
    process = run.start(theirs)
    read_until(ours, b"waiting for the first tick")
    assert process.pid is not None
    os.kill(process.pid, number)
    if number == signal.SIGINT:
        run.tick()
        read_until(ours, b"faults")
        run.put_event("end", exit="done")
    finish(process, ours)


def test_without_a_terminal_lines_and_faults_are_printed(
    run: Run, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(signal, "signal", lambda number, handler: None)
    run.tick()
    run.put_event("fault", **FAULT)
    run.put_event("command", command="hold")
    run.put_event("end", exit="safety_trip")
    with redirect_stderr(sys.stdout):
        console_main(run.spec)
    lines = capsys.readouterr().out.splitlines()
    expected = ("Fault link_lost", "Command hold", "Run ended: safety_trip", "s  hold")
    for line, words in zip(lines, expected, strict=True):
        assert words in line


def test_dead_parent_ends_it(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(signal, "signal", lambda number, handler: None)
    lives = iter([True, False])
    monkeypatch.setattr(child, "parent_lives", lambda: next(lives))
    console_main(run.spec)
    assert list(lives) == []


def test_reader_that_went_away_is_no_error_and_none_for_who_watches_the_console(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Gone:
        def write(self, words: str) -> int:
            run.put_event("end", exit="done")
            raise BrokenPipeError

        def flush(self) -> None: ...

        def isatty(self) -> bool:
            return False

    monkeypatch.setattr(signal, "signal", lambda number, handler: None)
    monkeypatch.setattr(time, "sleep", lambda duration_s: None)
    run.tick()
    gone = Gone()
    monkeypatch.setattr(sys, "stderr", gone)
    ours, theirs = multiprocessing.Pipe()
    with ours, theirs:
        console_main(run.spec, theirs)
        assert sys.stderr is gone  # and no exception came out


def test_a_console_that_replaces_another_does_not_repeat_old_events(
    run: Run, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(signal, "signal", lambda number, handler: None)
    run.put_event("fault", **FAULT)
    time.sleep(0.002)
    spec = replace(run.spec, since_s=run.spec.clock.now())
    run.put_event("end", exit="done")
    ours, theirs = multiprocessing.Pipe()
    with ours, theirs, redirect_stderr(sys.stdout):
        console_main(spec, theirs)
        assert ours.recv()["kind"] == "alive"
    output = capsys.readouterr().out
    assert "Run ended: done" in output
    assert "Fault link_lost" not in output


def test_the_terminal_of_a_killed_console_is_given_back(
    terminal: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    ours, theirs = terminal
    with open(theirs, "w", closefd=False) as stderr:
        monkeypatch.setattr(sys, "stderr", stderr)
        restore_terminal()
    assert read_until(ours, b"\x1b[?25h").startswith(b"\x1b[?1049l")
