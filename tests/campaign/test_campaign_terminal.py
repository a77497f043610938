"""A hold on a terminal: the console hangs or dies, or the terminal is closed, without effect on the
mirror.
"""

from __future__ import annotations

import asyncio
import os
import pty
import signal
import termios
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import psutil
import pytest
from campaign_bench import Run, make_plant, running

from membrane_ctrl.model.errors import Exit

pytestmark = [pytest.mark.campaign, pytest.mark.timeout(180)]


class Terminal:
    """What a person sees of a hold, and where they type."""

    def __init__(self) -> None:
        self._ours, self.theirs = pty.openpty()
        self.seen = bytearray()
        self._open = True
        asyncio.get_running_loop().add_reader(self._ours, self._read)

    def _read(self) -> None:
        try:
            self.seen += os.read(self._ours, 1 << 16)
        except OSError:  # the process on it has left
            asyncio.get_running_loop().remove_reader(self._ours)

    def press(self, key: bytes) -> None:
        """As if a person had pressed it."""
        os.write(self._ours, key)

    def close(self) -> None:
        """The window is gone."""
        if self._open:
            self._open = False
            asyncio.get_running_loop().remove_reader(self._ours)
            os.close(self.theirs)
            os.close(self._ours)

    @property
    def usable(self) -> bool:
        """Its first page is shown, with a cursor on it."""
        first_page = self.seen.rfind(b"\x1b[?1049l") > self.seen.rfind(b"\x1b[?1049h")
        return first_page and self.seen.rfind(b"\x1b[?25h") > self.seen.rfind(b"\x1b[?25l")


@asynccontextmanager
async def on_terminal(folder: Path) -> AsyncIterator[tuple[Run, Terminal]]:
    """A running hold on its own terminal."""
    terminal = Terminal()
    try:
        async with running(
            folder, make_plant(), environment={"TERM": "xterm-256color"}, terminal=terminal.theirs
        ) as run:
            await run.until(lambda: b"faults" in terminal.seen)
            yield run, terminal
    finally:
        terminal.close()


def screen(run: Run) -> psutil.Process:
    """The last child that was started: a hold without camera and alarms has a recorder and a
    screen.
    """
    return max(psutil.Process(run.process.pid).children(), key=lambda child: child.pid)


@pytest.mark.parametrize("number", [signal.SIGSTOP, signal.SIGKILL])
async def test_a_screen_that_hangs_or_dies_is_replaced_and_no_tick_is_missed(
    tmp_path: Path, number: signal.Signals
) -> None:
    async with on_terminal(tmp_path) as (run, terminal):
        screen(run).send_signal(number)
        await run.until(lambda: run.happened("child_restarted", child="screen"))
        assert run.happened("child_silent", child="screen") == (number == signal.SIGSTOP)
        terminal.seen.clear()
        await run.until(lambda: b"faults" in terminal.seen)
        terminal.press(b"\x03")
        assert await run.ended() == Exit.INTERRUPTED
        await asyncio.sleep(0.2)
        assert terminal.usable
        assert run.happened("end", missed_ticks=0)


async def test_the_terminal_of_a_screen_that_hangs_at_the_end_is_usable(tmp_path: Path) -> None:
    async with on_terminal(tmp_path) as (run, terminal):
        screen(run).send_signal(signal.SIGSTOP)
        terminal.press(b"\x03")
        assert await run.ended() == Exit.INTERRUPTED
        await asyncio.sleep(0.2)
        assert terminal.usable


async def test_keys_are_commands_that_are_recorded(tmp_path: Path) -> None:
    async with on_terminal(tmp_path) as (run, terminal):
        before = termios.tcgetattr(terminal.theirs)
        assert not before[3] & termios.ECHO
        terminal.press(b"m")
        await run.until(lambda: b"Enter sends" in terminal.seen)
        terminal.press(b"door\r")
        await run.until(lambda: run.happened("command", command="mark", text="door", why="key"))
        await run.until(lambda: b"mark: done" in terminal.seen)
        terminal.press(b"\x1a")  # Ctrl-Z
        await run.until(lambda: b"Ctrl-Z does nothing" in terminal.seen)
        terminal.press(b"s")
        await run.until(lambda: b"stop the run?" in terminal.seen)
        terminal.press(b"y")
        assert await run.ended() == Exit.INTERRUPTED
        await asyncio.sleep(0.2)
        assert terminal.usable
        assert termios.tcgetattr(terminal.theirs)[3] & termios.ECHO


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGABRT])
async def test_the_terminal_of_a_hold_that_was_killed_is_usable(
    tmp_path: Path, number: signal.Signals
) -> None:
    async with on_terminal(tmp_path) as (run, terminal):
        run.signal(number)
        await run.ended()
        until_s = time.monotonic() + 10.0
        while not (terminal.usable and termios.tcgetattr(terminal.theirs)[3] & termios.ECHO):
            assert time.monotonic() < until_s
            await asyncio.sleep(0.1)


@pytest.mark.usefixtures("signals_are_heeded")
async def test_a_closed_terminal_is_a_clean_stop(tmp_path: Path) -> None:
    async with on_terminal(tmp_path) as (run, terminal):
        terminal.close()
        assert await run.ended() == Exit.INTERRUPTED
        assert run.happened("command", command="stop", who="SIGHUP")
        assert run.happened("end", exit="interrupted")
        assert not run.plant.pumping
