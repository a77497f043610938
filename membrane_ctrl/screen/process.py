"""The process that draws, so that the tick never waits for a terminal."""

from __future__ import annotations

import json
import multiprocessing
import os
import pickle
import signal
import struct
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from rich.console import Console
from rich.live import Live

from membrane_ctrl.clock import RunClock
from membrane_ctrl.config import Config
from membrane_ctrl.ipc.ring import RingAddress, RingReader
from membrane_ctrl.screen.model import Event, ScreenModel
from membrane_ctrl.screen.plain import at_once, event_line, line
from membrane_ctrl.screen.view import screen
from membrane_ctrl.telemetry import FIELDS, TelemetryRow

_LOOK_S = 0.2  # as fast as a person reads changing figures
_PLAIN_S = 1.0
_ROW = struct.Struct(f"<{len(FIELDS)}d")


@dataclass(frozen=True, slots=True)
class ScreenSpec:
    """What the screen needs to know of the run.

    Attributes
    ----------
    clock : RunClock
        The run's clock.
    telemetry, events, shapes : RingAddress
        What to show; `shapes` is None for a run without a camera.
    run_dir : Path
        Where the recording goes, for the person to find.
    config : Config
        The run's configuration.
    duration_s : float or None
        How long the run shall take.
    """

    clock: RunClock
    telemetry: RingAddress
    events: RingAddress
    shapes: RingAddress | None
    run_dir: Path
    config: Config
    duration_s: float | None = None


def screen_main(spec: ScreenSpec) -> None:
    """Show the run on stderr until its "end" event, SIGTERM, or the death of the parent.

    Target of a `spawn`ed process. SIGINT is left to the control process; the terminal is given back in any case.
    """
    parent = multiprocessing.parent_process()  # who started it, even if that is gone by now
    parent_pid = os.getppid() if parent is None or parent.pid is None else parent.pid
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _leave)
    console = Console(stderr=True)
    with ExitStack() as stack:
        stack.enter_context(suppress(BrokenPipeError))  # nobody reads any more: `2>&1 | head`
        feed = stack.enter_context(closing(_Feed(spec)))
        drawable = console.is_terminal and not console.is_dumb_terminal
        show = stack.enter_context(_live(console, spec, feed) if drawable else _plain(spec, feed))
        while not feed.model.ended and os.getppid() == parent_pid:
            show()
            time.sleep(_LOOK_S)


class _Feed:
    """The rings, poured into the model."""

    def __init__(self, spec: ScreenSpec) -> None:
        self.model = ScreenModel(spec.config, spec.duration_s)
        self._telemetry = RingReader(spec.telemetry)
        self._events = RingReader(spec.events)
        self._shapes = RingReader(spec.shapes) if spec.shapes else None

    def update(self) -> list[Event]:
        """Take what has come; returns the events among it."""
        for message in self._telemetry.drain():
            self.model.take_row(TelemetryRow(*_ROW.unpack(message)))
        for message in self._shapes.drain() if self._shapes else ():
            self.model.take_shape(pickle.loads(message))
        events: list[Event] = [json.loads(message) for message in self._events.drain()]
        for event in events:
            self.model.take_event(event)
        return events

    def close(self) -> None:
        for reader in (self._telemetry, self._events, self._shapes):
            if reader is not None:
                reader.close()


@contextmanager
def _live(console: Console, spec: ScreenSpec, feed: _Feed) -> Iterator[Callable[[], None]]:
    """The screen on a terminal's other page; what was on the terminal is there again afterwards."""
    run = str(spec.run_dir)

    def show() -> None:
        feed.update()
        live.update(screen(feed.model.view(spec.clock.now()), spec.config, run), refresh=True)

    with Live(console=console, screen=True, auto_refresh=False, redirect_stdout=False, redirect_stderr=False) as live:
        yield show
    print(line(feed.model.view(spec.clock.now())), file=sys.stderr)  # the other page is gone: leave the last word


@contextmanager
def _plain(spec: ScreenSpec, feed: _Feed) -> Iterator[Callable[[], None]]:
    """A line a second; important events at once."""
    due_s = spec.clock.now()

    def show() -> None:
        nonlocal due_s
        lines = [event_line(event) for event in feed.update() if at_once(event)]
        now_s = spec.clock.now()
        if now_s >= due_s:
            lines.append(line(feed.model.view(now_s)))
            due_s = now_s - (now_s - due_s) % _PLAIN_S + _PLAIN_S
        for each in lines:
            print(each, file=sys.stderr, flush=True)

    yield show


def _leave(number: int, frame: FrameType | None) -> None:
    raise SystemExit(0)
