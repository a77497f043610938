"""Follows one hold for all viewers: status from the control port, ticks and figures from the rings;
their history.

One connection and one reader serve any number of viewers. The hold never waits for this process:
the port drops a client that does not read, and a ring overwrites what has not been read.
"""

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path

import numpy as np

from membrane_ctrl.control_port.client import ANSWER_S, PortClient
from membrane_ctrl.control_port.ctl import Where, connected, socket_path
from membrane_ctrl.control_port.outcome import Outcome
from membrane_ctrl.model import errors, shape_estimate, telemetry
from membrane_ctrl.model.arrays import Column
from membrane_ctrl.model.columns import PUBLISHED
from membrane_ctrl.model.events import EventLine
from membrane_ctrl.model.run_events import Mark
from membrane_ctrl.processes import published_rings, ring
from membrane_ctrl.review import catalogue
from membrane_ctrl.run_files.event_log import parse_logged_line, read_newest_lines
from membrane_ctrl.run_files.run import open_run
from membrane_ctrl.service.ended_run import EndedRun, EndKind, find_newest_run, read_ended_run
from membrane_ctrl.service.event_lines import SHOWN_MOST, format_event
from membrane_ctrl.service.hold_command import NO_LIMITS, ask_hold
from membrane_ctrl.service.hold_seen import HoldSeen, Message
from membrane_ctrl.service.published_signals import Value, signal_values
from membrane_ctrl.service.run_events_reader import RunEventsReader
from membrane_ctrl.service.send_limits import SendLimits

PERIOD_S = 0.5  # as fast as people read changing figures
SIGNALS = tuple(each.name for each in PUBLISHED)
_KEPT_S = 3600  # of seconds for the chart; the run's tables have the rest
_MARKS_KEPT = 200
_AGAIN_S = 2.0
_NO_HOLD = "no hold runs"
_RECORDING_S = 30.0  # a recorder that lives has written within this time
SPANS_S = {
    ("1 min"): 60.0,
    ("10 min"): 600.0,
    ("1 h"): 3600.0,
    ("8 h"): 28_800.0,
    ("1 day"): 86_400.0,
    ("1 week"): 604_800.0,
    "1 month": 2_678_400.0,
}
_LIVE_S = 3600.0  # the feed remembers this much; a longer span is read from the tables
_POINTS_MAX = 1200  # as many as a wide screen shows
_LISTED_S = 10.0  # the runs of a folder are listed again so often
_GAP = 3.0  # windows without data interrupt the line


@dataclass(frozen=True, slots=True)
class Second:
    """Least, mean and largest value of each signal in one second."""

    utc_s: float
    values: dict[str, tuple[float, float, float]]


class Seconds:
    """Collects ticks into seconds for the chart."""

    def __init__(self, kept_s: int = _KEPT_S) -> None:
        self._done: deque[Second] = deque(maxlen=kept_s)
        self._open: dict[str, list[float]] = {}
        self._at = -1

    def add(self, utc_s: float, values: dict[str, float]) -> None:
        """Add one tick to the means of its second.

        Parameters
        ----------
        utc_s : float
            Time of the tick; must not fall.
        values : dict of float
            By name of the signal; those that are not finite are left out.
        """
        if math.floor(utc_s) != self._at:
            self._close()
            self._at = math.floor(utc_s)
        for name, value in values.items():
            if math.isfinite(value):
                self._open.setdefault(name, []).append(value)

    def _close(self) -> None:
        if self._open:
            found = {
                name: (min(v), math.fsum(v) / len(v), max(v)) for name, v in self._open.items()
            }
            self._done.append(Second(float(self._at), found))
        self._open = {}

    def since(self, utc_s: float) -> list[Second]:
        """The finished seconds from a time on."""
        return [second for second in list(self._done) if second.utc_s >= utc_s]


class HoldFeed:
    """Follows the hold that `where` names, on a thread of its own, until closed; connects again by
    itself.
    """

    def __init__(self, where: Where) -> None:
        self._where = where
        self.seen = HoldSeen("")
        self.seconds = Seconds()
        self.marks: deque[tuple[float, str]] = deque(
            maxlen=_MARKS_KEPT
        )  # UTC seconds and text, since `met_s`
        self.met_s = math.inf  # UTC of the present contact's begin
        self._events: deque[str] = deque(maxlen=SHOWN_MOST)
        self._log: RunEventsReader | None = None  # of the run's files; None: they are elsewhere
        self._files_read: tuple[Path, int, bool] | None = None  # of the ended run
        self._ending = threading.Event()
        self._client: PortClient | None = None
        self._thread = threading.Thread(target=self._follow, name="hold feed", daemon=True)

    @property
    def logs(self) -> Path | None:
        """Folder of the runs, if it is on this machine."""
        return None if self._where.service else self._where.logs

    @property
    def folder(self) -> Path | None:
        """Folder of the run, if it is on this machine."""
        if self._where.service or not self.seen.name:
            return None
        return self._where.run or self._where.logs / self.seen.name

    @property
    def until_s(self) -> float:
        """UTC seconds of the end of the history: now, or the end of the newest run without a
        hold.
        """
        seen = self.seen
        if seen.problem and seen.ended is not None:
            return seen.ended.ended_utc.timestamp()
        return time.time()

    def open(self) -> None:
        """Start to follow."""
        self._thread.start()

    def close(self) -> None:
        """Stop following; returns once the thread has ended, or after a few seconds."""
        self._ending.set()
        if self._client is not None:
            self._client.close()
        self._thread.join(5.0)

    def signal_values(self) -> dict[str, Value]:
        """The values of the published signals."""
        return signal_values(self.seen)

    def ask(self, request: Message, limits: SendLimits = NO_LIMITS) -> Outcome:
        """Send a request on a connection of its own; returns what became of it.

        Waits for the hold's answer: called on a pool, never in the event loop of the page.

        Parameters
        ----------
        request : Message
            A request of the control port: `do`, and what the command needs.
        limits : SendLimits
            Until when it may be sent, and what else refuses it; by default nothing does.
        """
        what = str(request["do"]).replace("_", " ")
        try:
            answer = self.ask_hold(request, limits)
        except errors.CommandError as error:
            return Outcome.failed(what, "; ".join(error.lines))
        return Outcome.from_answer(what, answer)

    def ask_hold(self, request: Message, limits: SendLimits = NO_LIMITS) -> Message:
        """Send a request on a connection of its own; returns the hold's answer.

        Parameters
        ----------
        request, limits
            As for `ask`.

        Raises
        ------
        DeviceError
            There is no answer, or another run listens than the one that was followed.
        """
        return ask_hold(self._where, self.seen.name, request, limits)

    def _follow(self) -> None:
        while not self._ending.is_set():
            self._try_to_follow(self._follow_connection)
            self.update_ended_run()
            self._ending.wait(_AGAIN_S)

    def _follow_connection(self) -> None:
        """Follow the hold on one connection, until it ends. Raises DeviceError without a hold."""
        if not self._has_socket():
            raise errors.DeviceError(_NO_HOLD)
        with connected(self._where, self._events.append, ANSWER_S) as client:
            self._client = client
            self._watch(client)
        ended = "the run has ended" if self.seen.status else "the connection was closed"
        raise errors.DeviceError(ended)

    def _try_to_follow(self, follow: Callable[[], None]) -> None:
        """Follow, and keep the reason if that is impossible or has ended."""
        try:
            follow()
        except errors.CommandError as error:
            problem = "; ".join(error.lines)
        # whatever this hold causes, its feed tries again and the others continue
        except Exception as error:
            problem = f"{type(error).__name__}: {error}"
        else:
            return
        self.seen = replace(self.seen, problem=problem, role="read")

    def _has_socket(self) -> bool:
        """Whether a hold is or was there: one that ends removes its socket file."""
        return socket_path(self._where).exists()

    def update_ended_run(self) -> None:
        """Without a hold, read how the newest run ended, whenever its files have changed."""
        logs = self.logs
        folder = None if logs is None else find_newest_run(logs)
        if folder is None:
            return
        with suppress(OSError, ValueError, errors.CommandError):
            # A run takes seconds to read: again only if a file has grown or the summary has come
            size = (folder / "events.jsonl").stat().st_size
            read = folder, size, (folder / "summary.json").exists()
            is_final = self.seen.ended is not None and self.seen.ended.folder == folder
            if read == self._files_read and is_final:
                return
            ended = read_ended_run(folder)
            # Just after the control process has gone, its recorder may still write the end
            if ended.kind is EndKind.NO_RECORD and not _is_over(ended):
                return
            self._files_read = read
            if ended.name != self.seen.name:
                self.seen = HoldSeen(ended.name, problem=self.seen.problem)
            self.seen = replace(self.seen, ended=ended, events=ended.events)

    def _watch(self, client: PortClient) -> None:
        """Follow the status stream of a connection until the hold or the feed ends. Raises
        DeviceError.
        """
        # 1. Another run than the last one begins with an empty page
        greeting = client.greeting
        if greeting["run"] != self.seen.name or self.seen.ended is not None:
            self.seen = HoldSeen(str(greeting["run"]))
            self._events.clear()
        self.marks.clear()  # those made without contact are in the runs' logs only
        self.met_s = time.time()
        # 2. The rings before the file of the events: an event that comes meanwhile is in both, and
        #    `RunEventsReader` drops the second
        rings = self._rings()
        self._log = self._open_log(rings.get("events"))
        # 3. The port sends a status every period; ten without one mean that the hold hangs
        client.patience(10 * PERIOD_S)
        answer = client.ask(do="watch", period_s=PERIOD_S)
        if not answer.get("ok"):
            raise errors.DeviceError(f"watch refused: {answer.get('refused')}")
        try:
            self._take_message(answer, greeting, rings)
            for message in client.messages():
                self._take_message(message, greeting, rings)
                if self._ending.is_set():
                    return
        finally:
            for reader in rings.values():
                reader.close()

    def _rings(self) -> dict[str, ring.RingReader]:
        """The rings of a hold on this machine; none if they belong to another user or machine."""
        folder = self.folder
        if folder is None:
            return {}
        with suppress(OSError, ValueError):
            return published_rings.attach_rings(folder, whole=("events",))
        return {}

    def _open_log(self, reader: ring.RingReader | None) -> RunEventsReader | None:
        """The run's events from its beginning, or from as long ago as the viewers see; None without
        a ring: then the port sends those from now on.
        """
        if reader is None or self.folder is None:
            return None
        self._events.clear()
        return RunEventsReader(read_newest_lines(self.folder), reader)

    def _take_message(
        self, streamed: Message, greeting: Message, rings: dict[str, ring.RingReader]
    ) -> None:
        """Take one message of the stream: an event, a status, or the answer that begins it."""
        # Events from the run's files and ring if they are here: complete, and with their times
        if self._log is not None:
            for line in self._log.read_new():
                self._note_event(line)
        elif "event" in streamed:
            self._note_event(streamed["event"])
        # Each status is also the moment to read the rings: viewers see all three of one time
        if "status" in streamed:
            self.seen = replace(
                self.seen,
                role=str(greeting["role"]),
                status=streamed["status"],
                seen_s=time.monotonic(),
                problem="",
            )
            self._take_ticks(streamed["status"].get("row") or {}, rings.get("telemetry"))
            self._take_figures(rings.get("shapes"))
        self.seen = replace(self.seen, events=tuple(self._events))

    def _note_event(self, line: EventLine) -> None:
        """Keep an event for the viewers; one that comes from the port is of this moment."""
        event = parse_logged_line(line).event
        try:
            utc = datetime.fromisoformat(str(line.get("time_utc"))).astimezone(UTC)
        except (ValueError, OverflowError):
            utc = datetime.now(UTC)
        self._events.append(format_event(utc, event))
        # those before are in the run's files
        if isinstance(event, Mark) and utc.timestamp() >= self.met_s:
            self.marks.append((utc.timestamp(), event.text))

    def _take_ticks(self, newest: Message, reader: ring.RingReader | None) -> None:
        """Add the ticks since the last status; without a ring, the status's own."""
        utc_s = time.time()
        if reader is None:
            self.seconds.add(utc_s, {name: _to_number(newest.get(name)) for name in SIGNALS})
            return
        rows = telemetry.unpack_rows(reader.drain())
        if len(rows):
            # Ticks have the hold's own clock: the newest is of now, the others are as much older
            ticks = telemetry.get_columns(rows)
            at_s = utc_s + ticks["mono_s"] - ticks["mono_s"][-1]
            for place, tick_s in enumerate(at_s):
                self.seconds.add(
                    float(tick_s), {name: float(ticks[name][place]) for name in SIGNALS}
                )

    def _take_figures(self, reader: ring.RingReader | None) -> None:
        for message in reader.drain() if reader else ():
            figure = shape_estimate.unpack_estimate(message)
            first = self.seen.reference is None and figure.verdict != "rejected"
            self.seen = replace(
                self.seen, figure=figure, reference=figure if first else self.seen.reference
            )


def _is_over(run: EndedRun) -> bool:
    """Whether a run without a recorded end has recorded nothing for so long that it has ended."""
    last_utc = run.read_utc or run.ended_utc
    return (datetime.now(UTC) - last_utc).total_seconds() > _RECORDING_S


def _to_number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else math.nan


@dataclass(frozen=True, slots=True)
class Series:
    """A signal over time: (n,) UTC seconds, and least, mean and largest value; NaN rows interrupt
    the line.
    """

    utc_s: Column
    low: Column
    mean: Column
    high: Column


def history(
    feed: HoldFeed, logs: Path | None, signal: str, span_s: float, now_s: float | None = None
) -> Series:
    """Return the last seconds of a signal, in at most `_POINTS_MAX` windows.

    Without a hold, the seconds end with the newest run.

    Parameters
    ----------
    feed : HoldFeed
        Has the last hour, or as much of it as the service has followed.
    logs : Path or None
        Folder of the runs; None if it is on another machine: then only the last hour is known.
    signal : str
        One of `SIGNALS`.
    span_s : float
        How many seconds; more than an hour is read from the levels of the runs.
    now_s : float, optional
        UTC at which they end.

    Raises
    ------
    ValueError
        The signal is unknown.
    """
    if signal not in SIGNALS:
        raise ValueError(f"{signal}: none of {', '.join(SIGNALS)}")
    begin_s = (feed.until_s if now_s is None else now_s) - span_s
    # The last hour is in memory; what was before is in the runs' files
    live = _of_feed(feed, signal, begin_s)
    if span_s <= _LIVE_S and live.utc_s.size and live.utc_s[0] <= begin_s + 2.0:
        return thinned(live, span_s)
    before_s = live.utc_s[0] if live.utc_s.size else math.inf
    parts = (
        []
        if logs is None or not logs.is_dir()
        else _of_runs(logs, signal, begin_s, float(before_s), span_s)
    )
    return thinned(_join_series([*parts, live]), span_s)


@lru_cache(maxsize=32)  # each list opens every run of its folder
def _list_entries(logs: Path, _turn: float) -> list[catalogue.RunEntry]:
    return catalogue.list_entries(logs)


def marks(
    feed: HoldFeed, logs: Path | None, span_s: float, now_s: float | None = None
) -> list[tuple[float, str]]:
    """The marks of the last seconds, oldest first.

    Parameters
    ----------
    feed : HoldFeed
        The hold.
    logs : Path or None
        As for `history`.
    span_s : float
        How many seconds.
    now_s : float, optional
        UTC at which they end; else the newest moment that is known.

    Returns
    -------
    list of (float, str)
        UTC in s and text of each.
    """
    begin_s = (feed.until_s if now_s is None else now_s) - span_s
    found = list(feed.marks)
    if logs is not None and logs.is_dir() and begin_s < feed.met_s:
        for entry in _list_entries(logs, time.monotonic() // _LISTED_S):
            start_s = entry.started_utc.timestamp()
            if not entry.marks or start_s > feed.met_s:
                continue
            with suppress(OSError, ValueError, errors.CommandError):  # as in `_of_runs`
                found += [
                    (start_s + each.mono_s, each.event.text)
                    for each in open_run(entry.folder).log
                    if isinstance(each.event, Mark) and start_s + each.mono_s < feed.met_s
                ]
    return sorted(each for each in found if each[0] >= begin_s)


def _of_feed(feed: HoldFeed, signal: str, begin_s: float) -> Series:
    seconds = [each for each in feed.seconds.since(begin_s) if signal in each.values]
    values = np.array([each.values[signal] for each in seconds]).reshape(-1, 3)
    return Series(np.array([each.utc_s for each in seconds], dtype=np.float64), *values.T)


def _of_runs(logs: Path, signal: str, begin_s: float, end_s: float, span_s: float) -> list[Series]:
    """The signal in each run of the folder that reaches into the span, oldest first."""
    # The finest stored level whose rows are not many more than the points that will be shown
    window_s = next((w for w in (1.0, 10.0) if span_s / w <= 4 * _POINTS_MAX), 60.0)
    names = [f"{kind}_{signal}" for kind in ("min", "mean", "max")]
    found = []
    for entry in _list_entries(logs, time.monotonic() // _LISTED_S):
        start_s = entry.started_utc.timestamp()
        duration_s = entry.duration_s if math.isfinite(entry.duration_s) else 0.0
        if start_s > end_s or start_s + duration_s < begin_s:
            continue
        try:
            level = open_run(entry.folder).level(
                window_s, begin_s - start_s, end_s - start_s, names
            )
        except (OSError, ValueError):  # one damaged run must not empty the chart
            continue
        if level["time_s"].size:
            found.append(Series(level["time_s"] + start_s, *(level[name] for name in names)))
    return found


def _join_series(parts: Sequence[Series]) -> Series:
    parts = [part for part in parts if part.utc_s.size]
    if not parts:
        return Series(*(np.empty(0) for _ in range(4)))
    return Series(
        *(
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("utc_s", "low", "mean", "high")
        )
    )


def thinned(series: Series, span_s: float) -> Series:
    """Return a series in windows of equal length; a NaN row stands for each gap.

    Parameters
    ----------
    series : Series
        Minimum, mean and maximum of seconds.
    span_s : float
        Length of the whole chart; it has at most `_POINTS_MAX` windows.
    """
    if not series.utc_s.size:
        return series
    # The first row of each window.
    window_s = max(1.0, math.ceil(span_s / _POINTS_MAX))
    number = np.floor(series.utc_s / window_s)
    starts = np.flatnonzero(np.diff(number, prepend=number[0] - 1))
    # Extremes and mean of the known values of each window.
    low = np.fmin.reduceat(series.low, starts)
    high = np.fmax.reduceat(series.high, starts)
    known = np.isfinite(series.mean)
    total = np.add.reduceat(np.where(known, series.mean, 0.0), starts)
    with np.errstate(invalid="ignore"):
        mean = total / np.add.reduceat(known.astype(float), starts)
    # A gap is longer than several of the usual steps.
    utc_s = number[starts] * window_s
    step_s = max(window_s, float(np.median(np.diff(utc_s)))) if utc_s.size > 1 else window_s
    gaps = np.flatnonzero(np.diff(utc_s) > _GAP * step_s) + 1
    at_gap = np.insert(utc_s, gaps, utc_s[gaps - 1] + step_s)
    return Series(at_gap, *(np.insert(column, gaps, np.nan) for column in (low, mean, high)))
