"""`live.jsonl` of a session: what it does, what it has found, and the centre as it moves, for the
page that shows it.

One JSON object per line, appended as things happen, so that nothing is lost if the session is
killed. A reader may follow the file while it grows; a torn or foreign line is skipped.
`answer.json` beside it is what a viewer of the page answers to the question that waits.
"""

import contextlib
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from membrane_ctrl.model import errors, files, plain_json, telemetry, terminal
from membrane_ctrl.sessions import folder

NAME, ANSWER = "live.jsonl", "answer.json"
_ANSWER_BYTES_MAX = 4000
EVERY_S = 0.2  # one point of the picture; a relay's half cycle takes seconds
_POINTS = 5  # of a line
_COLUMNS = ("displacement_um", "setpoint_um", "flow_um_per_s")
_BYTES_MAX = 8_000_000  # a session of an hour takes half a megabyte
_POINTS_MAX = 100_000
_LINES_MAX, _LINE_MAX, _ANSWERS_MAX = 200, 500, 20  # what a page can show


class LiveLog:
    """Appends to a session's log. A disk that is full ends the log, not the session.

    `report_failure` receives the reason if it can no longer be written.
    """

    def __init__(
        self, session: Path, rate_hz: float, report_failure: Callable[[str], None]
    ) -> None:
        self._path = files.resolve_user_path(session / NAME)
        self._report_failure = report_failure
        self._ticks_a_point = max(1, round(EVERY_S * rate_hz))
        self._every_s = self._ticks_a_point / rate_hz
        self._rows: list[telemetry.TelemetryRow] = []
        self._good = True
        self._end = "\n"  # of a line torn when an earlier part of the session was killed

    def add_tick(self, row: telemetry.TelemetryRow) -> None:
        """Take a tick; every second's means are written."""
        self._rows.append(row)
        if len(self._rows) == _POINTS * self._ticks_a_point:
            self.write_means()

    def write_means(self) -> None:
        """Write the means of the ticks so far."""
        rows, self._rows = self._rows, []
        groups = [
            rows[at : at + self._ticks_a_point] for at in range(0, len(rows), self._ticks_a_point)
        ]
        if groups:
            points = {
                name: [_mean_of_finite([getattr(row, name) for row in group]) for group in groups]
                for name in _COLUMNS
            }
            self._append_entry({"every_s": self._every_s, **points})

    def log_entry(self, what: str, line: str, **more: float | Sequence[str]) -> None:
        """Note what happens, after the means of the ticks before it: the page draws both in one
        order.

        Parameters
        ----------
        what : str
            `step`, `result`, `asks` or `ended`.
        line : str
            Name of the step, text of the result, the question, or why the session ended.
        **more : float or sequence of str
            With `step` its `planned_s` and `after_s`, the time planned for it and for the later
            steps; with `asks` the answers `among` which the page may choose.
        """
        self.write_means()
        self._append_entry({what: line, "utc": folder.now_utc(), **more})

    def pop_answer(self, question: str, among: Sequence[str]) -> "PageAnswer | None":
        """Take the answer to a question from the page.

        Parameters
        ----------
        question : str
            As it was asked: an answer to an earlier one does not count.
        among : sequence of str
            The answers that count.

        Returns
        -------
        PageAnswer or None
            None if there is none, or it is to another question.
        """
        # Read, then removed, whatever it holds: an answer that does not fit must not wait for the
        # next question
        path = self._path.with_name(ANSWER)
        try:
            text = files.read_text(path, _ANSWER_BYTES_MAX, "replace")
        except OSError:
            return None
        with contextlib.suppress(OSError):
            path.unlink()
        try:
            given = plain_json.loads(text)
            fits = given["to"] == question and given["answer"] in ("", *among)
            if not fits:
                return None
            return PageAnswer(given["answer"], terminal.one_line(_parse_line(given["by"])))
        except (ValueError, TypeError, KeyError):
            return None

    def _append_entry(self, entry: dict[str, Any]) -> None:
        if not self._good:
            return
        try:
            files.append_text(self._path, self._end + json.dumps(entry, allow_nan=False) + "\n")
            self._end = ""
        except OSError as error:
            self._good = False
            self._report_failure(
                f"{self._path}: {errors.os_reason(error)}; the page does not show the rest "
                "of this session"
            )


@dataclass(frozen=True, slots=True)
class PageAnswer:
    """What a viewer of the page answered; empty: none of those that were named."""

    answer: str
    by: str


def write_answer(session: Path, question: str, given: PageAnswer) -> None:
    """Leave the answer to a question where the session finds it.

    Called by the service, on a pool. The session looks for the file while it asks, and removes it.

    Parameters
    ----------
    session : Path
        Folder of the session.
    question : str
        As the session asks it: an answer to another question is not taken.
    given : PageAnswer
        The answer, and the viewer's name.

    Raises
    ------
    OSError
        The folder cannot be written.
    """
    text = json.dumps({"to": question, "answer": given.answer, "by": given.by})
    files.write_text_atomic(files.resolve_user_path(session / ANSWER), text + "\n")


def _mean_of_finite(values: list[float]) -> float | None:
    good = [value for value in values if math.isfinite(value)]
    if not good:
        return None
    return round(sum(good) / len(good), 4)


@dataclass(frozen=True, slots=True)
class Progressed:
    """The session's progress by its log so far."""

    step: str = ""  # the one that runs, or ran last
    planned_s: float = 0.0  # of the step
    after_s: float = 0.0  # planned for the later steps
    done_s: float = 0.0  # recorded in the step
    asks: str = ""  # a question that waits for its answer
    ended: str = ""  # why the session ended; empty while it runs, or if it was killed
    results: tuple[str, ...] = ()  # lines, oldest first
    begun_s: tuple[tuple[float, str], ...] = ()  # where on the picture each step began
    among: tuple[str, ...] = ()  # answers to the question that the page may give


@dataclass(slots=True)
class LiveReader:
    """Follows a log: `read_new` takes what is new.

    Attributes
    ----------
    progress : Progressed
        The state after the last `read_new`.
    time_s : float
        Seconds of hold that the picture shows.
    """

    session: Path
    progress: Progressed = field(default_factory=Progressed)
    time_s: float = 0.0
    _offset: int = 0

    def read_new(self) -> dict[str, list[float]]:
        """New points: `time_s` and the columns, NaN for missing values.
        Nothing if there is no log.
        """
        points: dict[str, list[float]] = {name: [] for name in ("time_s", *_COLUMNS)}
        try:
            data = files.read_bytes(files.resolve_user_path(self.session / NAME), _BYTES_MAX)
        except OSError:
            return points
        # Up to the last whole line: the session may be in the middle of the next one
        whole = data.rfind(b"\n") + 1
        for line in data[self._offset : whole].splitlines():
            try:
                self._apply_entry(plain_json.loads(line.decode("utf-8")), points)
            except (ValueError, TypeError, KeyError, AttributeError, OverflowError):
                continue
        self._offset = max(self._offset, whole)
        return points

    def _apply_entry(self, entry: dict[str, Any], points: dict[str, list[float]]) -> None:
        """Take an entry into the progress, or add its points. Raises for one that is not an
        entry.
        """
        if "every_s" in entry:
            self._add_points(entry, points)
            return
        # Steps, results, questions and the end are kinds of entries; the last lines of each are
        # kept.
        now = self.progress
        if "step" in entry:
            planned_s, after_s = float(entry["planned_s"]), float(entry["after_s"])
            begun = (*now.begun_s, (self.time_s, _parse_line(entry["step"])))[-_LINES_MAX:]
            self.progress = Progressed(
                begun[-1][1], planned_s, after_s, results=now.results, begun_s=begun
            )
        elif "result" in entry:
            results = (*now.results, _parse_line(entry["result"]))[-_LINES_MAX:]
            self.progress = replace(now, results=results, asks="", among=())
        elif "asks" in entry:
            among = tuple(_parse_line(name) for name in entry.get("among", ())[:_ANSWERS_MAX])
            self.progress = replace(now, asks=_parse_line(entry["asks"]), among=among)
        else:
            self.progress = replace(now, ended=_parse_line(entry["ended"]), asks="", among=())

    def _add_points(self, entry: dict[str, Any], points: dict[str, list[float]]) -> None:
        """Add the means of an entry, at times that follow those before."""
        every_s = float(entry["every_s"])
        columns = {
            name: [math.nan if v is None else float(v) for v in entry[name]] for name in _COLUMNS
        }
        count = len(columns[_COLUMNS[0]])
        if (
            not 0 < every_s <= 60
            or {len(column) for column in columns.values()} != {count}
            or count > _POINTS_MAX
        ):
            raise ValueError("not a row of points")
        for name, column in columns.items():
            points[name] += column
        points["time_s"] += [self.time_s + (place + 1) * every_s for place in range(count)]
        self.time_s += count * every_s
        self.progress = replace(self.progress, done_s=self.progress.done_s + count * every_s)


def _parse_line(text: object) -> str:
    return str(text)[:_LINE_MAX]
