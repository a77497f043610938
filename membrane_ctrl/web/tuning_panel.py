"""The tab of the newest tuning session."""

import json
import math
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from nicegui import ui

from membrane_ctrl.control_port.outcome import Outcome
from membrane_ctrl.controller.command import Role
from membrane_ctrl.model import errors
from membrane_ctrl.service.event_lines import find_new_lines
from membrane_ctrl.service.web_user import WebUser
from membrane_ctrl.service.work_pools import ANSWERS
from membrane_ctrl.sessions import folder as folders
from membrane_ctrl.sessions.live_log import ANSWER, LiveReader, PageAnswer, Progressed, write_answer
from membrane_ctrl.web.confirmation import confirm
from membrane_ctrl.web.messages import show_message
from membrane_ctrl.web.session_chart import SessionChart
from membrane_ctrl.web.session_status import describe_session, find_silent_s

CHOOSES: Role = "tune"  # as for `ctl gains`
_LOOK_S = 1.0
_DRAW_S = 2.0
_FETCH_S = 30.0
_TAKES = 5  # looks until a session that asks has taken an answer


@dataclass(frozen=True, slots=True)
class SessionSeen:
    """The newest tuning session at one moment."""

    path: Path
    done: frozenset[str]  # its steps
    progress: Progressed
    candidates: tuple[
        tuple[str, ...], ...
    ] = ()  # their table, its head first, while the session waits for a choice
    silent_s: float = 0.0  # how long its log has not grown
    points: int = 0  # of its chart

    @property
    def head(self) -> str:
        """What it does, in a line."""
        doing = describe_session(self.progress, self.done, self.silent_s, self.path)
        return f"{self.path.name}: {doing}"


class SessionWatch:
    """Follows the newest tuning session in a folder of runs, for all viewers."""

    def __init__(self, logs: Path) -> None:
        self._logs = logs
        self._reader: LiveReader | None = None
        self._chart = SessionChart()

    def look(self) -> SessionSeen | None:
        """The session now; None if there is none."""
        try:
            newest = folders.find_newest_session(self._logs)
        except (errors.CommandError, OSError):
            return None
        if self._reader is None or self._reader.session != newest.path:
            self._reader = LiveReader(newest.path)
            self._chart = SessionChart()
        self._chart.add_points(self._reader.read_new())
        seen = SessionSeen(
            newest.path,
            frozenset(step for step in folders.STEPS if newest.is_done(step)),
            self._reader.progress,
            silent_s=find_silent_s(newest.path),
            points=self._chart.count,
        )
        with suppress(errors.InputError):
            if seen.progress.among:
                return replace(seen, candidates=_table(newest.read_candidates()))
        return seen

    def make_chart(self) -> dict[str, Any]:
        """Options of the chart of the session that was seen last."""
        begun = () if self._reader is None else self._reader.progress.begun_s
        return self._chart.make_options(begun)


def _table(markdown: str) -> tuple[tuple[str, ...], ...]:
    """The cells of a Markdown table, without its rule."""
    head, _, *rows = (
        tuple(map(str.strip, line.strip("| ").split("|"))) for line in markdown.splitlines()
    )
    return head, *(row for row in rows if len(row) == len(head))


def answered(session: Path, question: str, given: PageAnswer) -> Outcome:
    """Give a session an answer; returns what became of it.

    Waits until the session has removed the file of the answer, or takes it back: called on a pool.

    Parameters
    ----------
    session : Path
        Folder of the tuning session.
    question : str
        The question as the page has shown it: the session ignores an answer to another one.
    given : PageAnswer
        The candidate, empty for none of them, and who has chosen.
    """
    what = given.answer or "none of them"
    try:
        write_answer(session, question, given)
    except OSError as error:
        return Outcome.failed(what, f"not given: {errors.os_reason(error)}")
    for _ in range(_TAKES):
        if not (session / ANSWER).exists():
            return Outcome.succeeded(what)
        time.sleep(_LOOK_S)
    with suppress(OSError):
        (session / ANSWER).unlink()
    return Outcome.failed(what, "not taken: the session no longer asks; see its terminal")


class TuningPanel:
    """The tab of the tuning session: its steps, what it has found, and the choice it waits for.

    `look` returns the session now, `is_action_allowed` whether the viewer may choose.
    """

    def __init__(
        self,
        look: Callable[[], Awaitable[SessionSeen | None]],
        hold: str,
        user: WebUser,
        is_action_allowed: Callable[[], bool],
    ) -> None:
        self._look = look
        self._hold = hold
        self._user = user
        self._may = is_action_allowed
        self._head = (
            ui.label("No tuning session in this folder.")
            .classes("text-subtitle1")
            .props('role="status"')
            .style("overflow-wrap: anywhere")
        )
        self._steps = ui.row()
        self._choice = ui.column().classes("w-full")
        self._said = ui.log(max_lines=200).classes("w-full h-64").props('aria-label="results"')
        self._said.set_visibility(False)
        with ui.element("div").classes("w-full") as self._chart_place:
            self._chart_place.props('role="img" aria-label="centre and flow of the session"')
            self._chart = ui.echart({"series": []}).classes("w-full").style("height: 20rem")
        self._chart_place.set_visibility(False)
        self._drawn_points = 0
        self._drawn_s = -math.inf
        self._buttons: list[ui.button] = []
        self._seen: SessionSeen | None = None
        ui.timer(_LOOK_S, self._show)

    async def _show(self) -> None:
        """Show what has changed in the newest session since the last look."""
        seen, before = await self._look(), self._seen
        for button in self._buttons:
            if button.enabled != self._may():
                button.set_enabled(self._may())
        if seen is None:
            return
        await self._draw(seen)
        if seen == before:
            return
        self._seen = seen
        self._head.set_text(seen.head)
        self._said.set_visibility(bool(seen.progress.results))
        # Another session than before: its log is shown from the beginning
        if before is None or before.path != seen.path:
            self._said.clear()
            before = SessionSeen(seen.path, frozenset(), Progressed())
            self._show_steps(seen)
        for line in find_new_lines(before.progress.results, seen.progress.results):
            self._said.push(line)
        if (before.done, before.progress.step) != (seen.done, seen.progress.step):
            self._show_steps(seen)
        if (before.progress.asks, before.progress.among) != (
            seen.progress.asks,
            seen.progress.among,
        ):
            self._show_choice(seen)

    async def _draw(self, seen: SessionSeen) -> None:
        """Draw the chart if it has grown."""
        is_due = time.monotonic() - self._drawn_s > _DRAW_S
        if not seen.points or seen.points == self._drawn_points or not is_due:
            return
        self._drawn_points = seen.points
        self._drawn_s = time.monotonic()
        self._chart_place.set_visibility(True)
        ids = json.dumps({"session": self._chart.id})
        url = f"/session-chart?{urlencode({'hold': self._hold})}"
        with suppress(TimeoutError):
            await ui.run_javascript(f"await membraneDrawCharts({ids}, '{url}')", timeout=_FETCH_S)

    def _show_steps(self, seen: SessionSeen) -> None:
        self._steps.clear()
        with self._steps:
            for step in folders.STEPS:
                colour = "grey"
                if step in seen.done:
                    colour = "positive"
                elif step == seen.progress.step:
                    colour = "info"
                ui.badge(step, color=colour)

    def _show_choice(self, seen: SessionSeen) -> None:
        """Show the question that the session waits with, its candidates, and a button for each
        answer.
        """
        self._choice.clear()
        self._buttons.clear()
        if not seen.progress.among:
            return
        with self._choice:
            ui.label(f"The session waits, here and on its terminal: {seen.progress.asks}").classes(
                "text-bold"
            )
            if seen.candidates:
                head, *rows = seen.candidates
                columns = [
                    {"name": name, "label": name, "field": name, "align": "left"} for name in head
                ]
                cells = [dict(zip(head, row, strict=True)) for row in rows]
                ui.table(columns=columns, rows=cells, row_key=head[0]).classes("w-full").props(
                    "dense"
                )
            with ui.row():
                for name in (*seen.progress.among, ""):
                    button = ui.button(
                        name or "none", on_click=lambda _, choice=name: self._answer(seen, choice)
                    )
                    button.props("no-caps" if name else "no-caps flat").tooltip(
                        f"needs the role {CHOOSES}"
                    )
                    button.set_enabled(self._may())
                    self._buttons.append(button)

    async def _answer(self, seen: SessionSeen, choice: str) -> None:
        """Ask for a confirmation, answer, and show the outcome."""
        question = f"{seen.progress.asks} {choice or 'none'}"
        if not await confirm(question, enter_confirms=True) or not self._may():
            return
        given = PageAnswer(choice, self._user.name)
        outcome = await ANSWERS.run(answered, seen.path, seen.progress.asks, given)
        with self._steps:  # the button that was pressed is gone once the session has its answer
            show_message(outcome.text, outcome.done)
