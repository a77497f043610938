"""The process that draws the console, so that no tick waits for a terminal."""

from __future__ import annotations

import json
import math
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

from rich.console import Console
from rich.live import Live

from membrane_ctrl.config.port import SOCKET_NAME
from membrane_ctrl.config.schema import Config
from membrane_ctrl.console import key_reader, keys, model, requests, why
from membrane_ctrl.console.page_link import PageLink
from membrane_ctrl.console.view import ConsolePage
from membrane_ctrl.model import (
    child_events,
    clock,
    event_lines,
    job_control,
    shape_estimate,
    telemetry,
    terminal,
)
from membrane_ctrl.model.events import EventLine
from membrane_ctrl.processes import child, event_pipe, ring

_SOCKET = Path("logs", SOCKET_NAME)  # where `ctl` looks
_LOOK_S = 0.2  # as fast as people read changing figures
_PLAIN_S = 1.0
# A round takes some ms; a stopped terminal (Ctrl-S, a dead ssh) buffers writes for a while
_HANGS_S = 15.0


def format_line(view: model.ConsoleView) -> str:
    """Format the view as one line."""
    row = view.row
    if view.silent_s or row is None:
        silent = f"no tick for {view.silent_s:.1f} s" if row else view.why
        return f"{view.elapsed_s:9.1f} s  {silent}"
    leak = row.format_labelled("leak_um_per_s")
    if view.too_tight:
        leak += " TOO TIGHT"
    parts = [
        f"{view.elapsed_s:9.1f} s  {view.state.name.lower():7}",
        row.format_labelled("error_um", sign=True, width=7),
        f"pump {why.format_percent(row.pump_fraction):>5}",
        leak,
    ]
    if math.isfinite(row.estimate_sigma_um):
        parts.append(f"held by {why.list_used_sensors(row)}")
    parts += [
        f"shape {_shape_words(view)} {row.format_labelled('trim_um', sign=True)}",
        row.format_labelled("lateness_ms"),
        view.why,
    ]
    parts += [f"LOCKED {lock}" for lock in view.locks]
    if view.next_step:
        parts.append(view.next_step)
    parts += view.notices
    if math.isfinite(view.left_s):
        parts.append(f"{why.format_duration(view.left_s)} left")
    return "  ".join(parts)


def _shape_words(view: model.ConsoleView) -> str:
    shape = view.shape
    if shape.estimate is None:
        return shape.note or shape.state.name.lower()
    return f"{shape.state.name.lower()} {shape.estimate.verdict} {why.format_duration(shape.age_s)}"


@dataclass(frozen=True, slots=True)
class ConsoleSpec:
    """What the console needs to know about the run."""

    clock: clock.RunClock
    telemetry: ring.RingAddress
    events: ring.RingAddress
    shapes: ring.RingAddress | None  # None for a run without a camera
    run_dir: Path  # run folder, shown to the operator
    config: Config
    duration_s: float | None = None
    socket: Path | None = None  # of the control port; None if it is off
    # None unless stdin is the terminal that the console draws on
    keyboard: key_reader.Keyboard | None = None
    since_s: float = -math.inf  # an earlier console has shown the events before


def console_main(spec: ConsoleSpec, status: Connection | None = None) -> None:
    """Show the run on stderr until its `end` event, `processes.STOP`, or the death of the parent.

    Target of a `spawn`ed process. Always restores the terminal.

    Parameters
    ----------
    spec : ConsoleSpec
        What the console needs of the run; plain data, because it is pickled by `multiprocessing`.
    status : Connection, optional
        Reports `Alive` to the control process, which replaces a console that is silent for longer;
        None in tests.
    """
    child.leave_at_stop()
    # it may restore a terminal that has passed to the shell
    signal.signal(signal.SIGTTOU, signal.SIG_IGN)
    report = event_pipe.make_event_sender(status)
    with closing(_Feed(spec)) as feed:

        def rounds(show: Callable[[], object]) -> None:
            while not feed.model.has_ended and child.parent_lives():
                show()
                report(child_events.Alive(_HANGS_S))
                time.sleep(_LOOK_S)

        try:
            _draw_console(spec, feed, rounds)
        except (
            OSError
        ):  # no reader: `2>&1 | head`, a closed terminal; another console would not help
            rounds(feed.update)


def _draw_console(
    spec: ConsoleSpec, feed: _Feed, rounds: Callable[[Callable[[], object]], None]
) -> None:
    """Draw on a terminal, or print lines. Raises OSError when stderr is closed."""
    console = Console(stderr=True)
    drawable = console.is_terminal and not console.is_dumb_terminal
    with _draw_on_terminal(console, spec, feed) if drawable else _print_lines(spec, feed) as show:
        rounds(show)


def restore_terminal(keyboard: key_reader.Keyboard | None = None) -> None:
    """Restore the terminal's main page, cursor and modes after a killed console."""
    if keyboard is not None:
        keyboard.restore_modes()
    with suppress(OSError):
        # these control bytes are intended
        terminal = getattr(sys.stderr, "rich_proxied_file", sys.stderr)
        if terminal.isatty():
            terminal.write("\x1b[?1049l\x1b[?25h")
            terminal.flush()


class _Feed:
    """Feeds the rings into the model."""

    def __init__(self, spec: ConsoleSpec) -> None:
        ctl = "membrane-ctrl ctl" + (
            "" if spec.socket in (None, _SOCKET) else f" --socket {spec.socket}"
        )
        self.model = model.ConsoleModel(
            spec.config, spec.duration_s, ctl, spec.keyboard is not None
        )
        self._telemetry = ring.RingReader(spec.telemetry)
        self._events = ring.RingReader(spec.events)
        self._shapes = ring.RingReader(spec.shapes) if spec.shapes else None

    def update(self) -> list[EventLine]:
        """Take all new messages; returns the events."""
        messages = list(self._telemetry.drain())
        for message in messages:
            self.model.add_row(telemetry.TelemetryRow.unpack(message))
        self.model.add_rows(telemetry.unpack_rows(messages))
        if self._shapes:
            for message in self._shapes.drain():
                self.model.add_shape(shape_estimate.unpack_estimate(message))
        lines: list[EventLine] = [json.loads(message) for message in self._events.drain()]
        for line in lines:
            self.model.add_event(line)
        return lines

    def close(self) -> None:
        for reader in (self._telemetry, self._events, self._shapes):
            if reader is not None:
                reader.close()


@contextmanager
def _draw_on_terminal(
    console: Console, spec: ConsoleSpec, feed: _Feed
) -> Iterator[Callable[[], None]]:
    """Show the console on the terminal's alternate page while in the foreground; restore the main
    page afterwards.
    """
    run, handle = str(spec.run_dir), 2
    page_link = PageLink(spec.run_dir.parent)
    live = Live(
        console=console,
        screen=True,
        auto_refresh=False,
        redirect_stdout=False,
        redirect_stderr=False,
    )
    with _open_keyboard(spec) as (reader, desk):

        def show() -> None:
            feed.update()
            if not job_control.in_foreground(handle):
                live.stop()
                return
            now_s = spec.clock.now()
            view = feed.model.make_view(now_s)
            link = page_link.find(now_s)
            if reader is None:
                page = ConsolePage(view, spec.config, run, link=link)
            else:
                desk.process_keys(reader.read(), view.paused)
                page = ConsolePage(
                    view, spec.config, run, desk.bottom_line, desk.is_asking, desk.help, link
                )
            live.start()
            live.update(terminal.Plain(page), refresh=True)

        try:
            yield show
        finally:
            live.stop()
    # a last line that remains
    print(format_line(feed.model.make_view(spec.clock.now())), file=sys.stderr)


@contextmanager
def _open_keyboard(spec: ConsoleSpec) -> Iterator[tuple[key_reader.KeyReader | None, keys.Desk]]:
    """The keyboard, if there is one and the control port takes what it asks for."""
    desk = keys.Desk(requests.request_sender(spec.socket or _SOCKET, spec.run_dir.name))
    reader = None
    if spec.keyboard is not None and spec.socket is not None:
        with suppress(OSError):  # the terminal belongs to another user: `su`
            reader = key_reader.KeyReader(spec.keyboard)
    try:
        yield reader, desk
    finally:
        if reader is not None:
            reader.close()


@contextmanager
def _print_lines(spec: ConsoleSpec, feed: _Feed) -> Iterator[Callable[[], None]]:
    """Print a line per second, and important events at once."""
    due_s = spec.clock.now()

    def show() -> None:
        nonlocal due_s
        lines = [
            model.event_line(event)
            for event in feed.update()
            if event_lines.from_dict(event).notable
            and event.get("mono_s", math.inf) >= spec.since_s
        ]
        now_s = spec.clock.now()
        if now_s >= due_s:
            lines.append(format_line(feed.model.make_view(now_s)))
            due_s = now_s - (now_s - due_s) % _PLAIN_S + _PLAIN_S
        for each in lines:
            print(each, file=sys.stderr, flush=True)

    yield show
