"""The tab of the guided session: its stages, what the present one has found, and its question.

It shows what the service has, so a reload or another viewer shows the same question. An answer
names the number of its question: only the first one counts. Only the role `tune` sees it.
"""

from __future__ import annotations

from collections.abc import Callable
from urllib.parse import quote

from nicegui import ui

from membrane_ctrl.commissioning.guide.dialogue import (
    BACK,
    Question,
    QuestionKind,
    StageProgress,
    StageResult,
)
from membrane_ctrl.commissioning.guide.session_messages import (
    CheckMessage,
    LineMessage,
    StageMessage,
)
from membrane_ctrl.commissioning.guide.session_state import (
    HTML,
    PDF,
    CheckRecord,
    CheckVerdict,
)
from membrane_ctrl.control_port.sender import role_includes
from membrane_ctrl.controller.command import Role
from membrane_ctrl.model import errors
from membrane_ctrl.service.guided_session import (
    GuidedSession,
    SeenSession,
    SessionEntry,
    ShownMessage,
)
from membrane_ctrl.service.web_user import WebUser
from membrane_ctrl.service.work_pool import PoolFullError
from membrane_ctrl.service.work_pools import RUN_LISTS
from membrane_ctrl.web.confirmation import confirm
from membrane_ctrl.web.messages import show_message

COMMISSIONS: Role = "tune"  # it writes a configuration and moves gas
_LOOK_S = 0.5
_FIRST_NAME = "lab-1"
_VERDICTS = {
    CheckVerdict.PASSED: ("check_circle", "text-positive"),
    CheckVerdict.FAILED: ("error", "text-negative"),
    CheckVerdict.NOT_DONE: ("help_outline", "text-warning"),
    CheckVerdict.NOTED: ("info", ""),
}
_RESULTS = {
    StageResult.OPEN: ("radio_button_unchecked", ""),
    StageResult.PASSED: ("check_circle", "text-positive"),
    StageResult.FAILED: ("error", "text-negative"),
    StageResult.NOT_NEEDED: ("remove", ""),
}
_CSS = (
    ".membrane-guide { display: grid; gap: 1rem; grid-template-columns: minmax(0, 1fr) }"
    "@media (min-width: 1024px) { .membrane-guide"
    " { grid-template-columns: 16rem minmax(0, 1fr) } }"
    ".membrane-guide-line { white-space: pre-wrap; overflow-wrap: anywhere }"
)


class CommissioningPanel:
    """The elements of the tab.

    Parameters
    ----------
    session : GuidedSession
        The one session of this service, which all viewers see.
    user : WebUser
        Needs the role `COMMISSIONS`; the name is logged with each answer.
    """

    def __init__(self, session: GuidedSession, user: WebUser) -> None:
        self._session = session
        self._user = user
        self._shown = SeenSession()
        self._entries: list[SessionEntry] = []
        self._count = 0  # of messages that are shown
        self._former_head = ""  # of the stage whose results are shown
        ui.add_css(_CSS)
        self._build_start()
        self._ended = ui.label().classes("text-subtitle1 membrane-guide-line")
        self._ended.props('role="status"')
        self._report = ui.row()
        with ui.element("div").classes("membrane-guide w-full") as self._body:
            self._plan = ui.column().classes("gap-0 max-lg:order-last")
            with ui.column().classes("min-w-0 w-full"):
                self._head = ui.column().classes("gap-0 w-full")
                self._present = ui.column().classes("w-full").props('aria-label="checks"')
                self._question = ui.column().classes("w-full")
                self._stop = ui.button(
                    "Stop safely, resume later", icon="pause_circle", on_click=self._confirm_stop
                )
                self._stop.props("no-caps outline color=negative")
                self._before = ui.column().classes("w-full").props('aria-label="results so far"')
        self._show(self._session.seen)
        ui.timer(_LOOK_S, self._look)

    async def load_list(self) -> None:
        """List the sessions that can be resumed."""
        try:
            self._entries = await RUN_LISTS.run(self._session.list_sessions)
        except PoolFullError as error:
            show_message(str(error), good=False)
            return
        self._known.clear()
        with self._known:
            for entry in self._entries:
                bench = "emulated bench" if entry.simulated else "real bench"
                words = entry.problem or f"{bench}, {entry.stages_done} stages done"
                button = ui.button(
                    f"{entry.name}: {words}",
                    icon="history",
                    color=None,
                    on_click=lambda _, chosen=entry: self._choose(chosen),
                )
                button.props("flat no-caps dense").set_enabled(not entry.problem)

    @property
    def _may(self) -> bool:
        return role_includes(self._user.role, COMMISSIONS)

    def _build_start(self) -> None:
        with ui.card().classes("w-full") as self._start:
            ui.label(
                "From a box of parts to the first accepted hold, in six steps. Each stage states "
                "what it does and what must be seen, and stops safely."
            )
            with ui.row().classes("items-end"):
                self._name = ui.input("name of the session", value=_FIRST_NAME)
                self._name.props('aria-label="name of the session"')
                self._simulated = ui.checkbox("practise on the emulated bench")
                ui.button("Begin or resume", icon="play_arrow", on_click=self._begin).props(
                    "no-caps"
                )
            self._known = ui.column().classes("gap-0")

    def _choose(self, entry: SessionEntry) -> None:
        self._name.set_value(entry.name)
        self._simulated.set_value(entry.simulated)

    async def _begin(self) -> None:
        name = str(self._name.value or "").strip()
        simulated = bool(self._simulated.value)
        if not self._may:
            return
        await self._try(lambda: self._session.start(name, simulated, self._user.name))

    async def _confirm_stop(self) -> None:
        does = "The pump is switched off. The session can be resumed, here or in a terminal."
        if (
            await confirm("Stop the session?", (does,), "Stop the session", "negative")
            and self._may
        ):
            await self._try(lambda: self._session.stop(self._user.name))

    async def _give(self, number: int, text: str) -> None:
        """Answer the question of that number; it disappears at once."""
        if not self._may:
            return
        self._question.clear()
        await self._try(lambda: self._session.answer(number, text, self._user.name))

    async def _try(self, act: Callable[[], None]) -> None:
        try:
            await RUN_LISTS.run(act)
        except errors.CommandError as error:
            show_message("; ".join(error.lines), good=False)
        except PoolFullError as error:
            show_message(str(error), good=False)

    async def _look(self) -> None:
        seen = self._session.seen
        if seen is self._shown:
            return
        had_ended = self._shown.ended
        self._show(seen)
        if seen.ended and not had_ended:
            await self.load_list()

    def _show(self, seen: SeenSession) -> None:
        """Show what differs from what is shown."""
        # 1. Plan and head, if they have changed
        before, self._shown = self._shown, seen
        self._start.set_visibility(not seen.is_running)
        self._body.set_visibility(bool(seen.plan))
        self._stop.set_visibility(seen.is_running)
        self._ended.set_text(seen.ended)
        if seen.plan != before.plan or seen.stage != before.stage:
            self._show_plan(seen)
        if seen.stage != before.stage:
            self._show_head(seen)
        # 2. The messages that are new, by their number since the start, of which the oldest are
        #    dropped. A smaller count means that the session was started again
        if seen.dropped + len(seen.messages) < self._count:
            self._present.clear()
            self._before.clear()
            self._count = 0
        for message in seen.messages[max(0, self._count - seen.dropped) :]:
            self._show_message(message)
        self._count = seen.dropped + len(seen.messages)
        # 3. What waits for the viewer
        if seen.question != before.question:
            self._show_question(seen)
        if seen.ended != before.ended:
            self._show_report(seen)

    def _show_plan(self, seen: SeenSession) -> None:
        self._plan.clear()
        title = ""
        with self._plan:
            ui.label(f"Session {seen.name}").classes("text-bold")
            for stage in seen.plan:
                if stage.title != title:
                    title = stage.title
                    ui.label(f"{stage.step}. {title}").classes("text-caption q-mt-sm")
                is_present = seen.stage is not None and seen.stage.name == stage.name
                _show_stage(stage, is_present and seen.is_running)

    def _show_head(self, seen: SeenSession) -> None:
        self._head.clear()
        if seen.stage is None:
            return
        with self._head:
            head = f"{seen.stage.step}. {seen.stage.title}: {_plain(seen.stage.name)}"
            ui.label(head).classes("text-h6").props('role="heading"')
            ui.label(f"It {seen.stage.does}.")
            ui.label(f"To be seen: {seen.stage.look_for}.").classes("text-bold")

    def _show_message(self, message: ShownMessage) -> None:
        """Show a message in the present stage's part; a new stage moves it below, newest first."""
        if not isinstance(message, StageMessage):
            with self._present:
                _show_result(message)
            return
        # A new stage: the elements of the former one move into a card below
        former = list(self._present.default_slot.children)
        if former and self._former_head:
            with self._before:
                card = ui.card().classes("w-full gap-1")
            card.move(self._before, target_index=0)
            with card:
                ui.label(self._former_head).classes("text-bold")
            for element in former:
                element.move(card)
        else:
            self._present.clear()
        stage = message.stage
        self._former_head = f"{stage.step}. {stage.title}: {_plain(stage.name)}"

    def _show_question(self, seen: SeenSession) -> None:
        self._question.clear()
        if seen.question is None:
            return
        number, asked = seen.question.number, seen.question.question
        with self._question, ui.card().classes("w-full").props('aria-label="question"'):
            _ask_question(asked, lambda text: self._give(number, text))

    def _show_report(self, seen: SeenSession) -> None:
        self._report.clear()
        if not seen.ended or StageResult.OPEN in {stage.result for stage in seen.plan}:
            return
        place = f"/commissioning/{quote(seen.name, safe='')}"
        with self._report:
            ui.link("Report", f"{place}/{HTML}", new_tab=True)
            ui.link("Report as PDF", f"{place}/{PDF}", new_tab=True)


def _ask_question(asked: Question, give: Callable[[str], object]) -> None:
    """Build the elements that answer a question; `give` takes the answer."""
    text = asked.text
    if asked.kind == QuestionKind.READINESS:
        text = f"{text}, then confirm."
    ui.label(text[:1].upper() + text[1:]).classes("text-subtitle1 membrane-guide-line")
    match asked.kind:
        case QuestionKind.CONFIRMATION:
            answers = {"Yes": "y", "No": "n"}
            with ui.row():
                for label, answer in answers.items():
                    ui.button(label, on_click=lambda _, given=answer: give(given)).props("no-caps")
                _build_back(give)
        case QuestionKind.READINESS:
            with ui.row():
                ui.button("Done", icon="done", on_click=lambda: give("")).props("no-caps")
                _build_back(give)
        case QuestionKind.CHOICE:
            labels = {
                choice.name: f"{choice.name}: {choice.meaning}" if choice.meaning else choice.name
                for choice in asked.choices
            }
            chosen = ui.radio(labels, value=asked.default if asked.default in labels else None)
            with ui.row():
                ui.button("Choose", on_click=lambda: give(str(chosen.value or ""))).props("no-caps")
                _build_back(give)
        case _:
            field = ui.input(value=asked.default, suffix=asked.unit).classes("w-full")
            field.props('aria-label="answer" autofocus').style("max-width: 30rem")
            if asked.kind == QuestionKind.NUMBER:
                field.props(f'hint="{asked.low:g} .. {asked.high:g}"')
            field.on("keydown.enter", lambda: give(str(field.value or "")))
            with ui.row():
                ui.button("Enter", on_click=lambda: give(str(field.value or ""))).props("no-caps")
                _build_back(give)


def _build_back(give: Callable[[str], object]) -> None:
    back = ui.button("Stage before", icon="undo", color=None, on_click=lambda: give(BACK))
    back.props("flat no-caps")


def _show_stage(stage: StageProgress, is_present: bool) -> None:
    icon, colour = _RESULTS[stage.result]
    if is_present:
        icon, colour = "play_circle", "text-primary"
    with ui.row().classes("items-center no-wrap gap-1"):
        ui.icon(icon).classes(colour)
        words = _plain(stage.name)
        if stage.result == StageResult.NOT_NEEDED:
            words += " (not on this bench)"
        ui.label(words).classes("text-bold" if is_present else "")


def _show_result(message: LineMessage | CheckMessage) -> None:
    if isinstance(message, CheckMessage):
        _show_check(message.check)
    elif message.text.strip():
        ui.label(message.text).classes("membrane-guide-line text-body2")


def _show_check(check: CheckRecord) -> None:
    icon, colour = _VERDICTS[check.verdict]
    with ui.row().classes("items-start no-wrap gap-2"):
        ui.icon(icon, size="sm").classes(colour).props(f'aria-label="{check.verdict}"')
        with ui.column().classes("gap-0 min-w-0"):
            limit = f" ({check.limit})" if check.limit else ""
            ui.label(f"{check.name}: {check.measured}{limit}").classes("membrane-guide-line")
            if check.remedy:
                ui.label(check.remedy).classes("text-caption membrane-guide-line")


def _plain(name: str) -> str:
    return name.replace("_", " ")
