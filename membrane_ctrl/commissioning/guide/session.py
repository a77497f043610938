"""The command `commission`: runs the stages in order, and resumes where it stopped."""

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from firmware_iface import roles
from membrane_ctrl.commissioning.guide import report
from membrane_ctrl.commissioning.guide.bench_access import BenchAccess
from membrane_ctrl.commissioning.guide.dialogue import (
    Choice,
    Dialogue,
    GoBackError,
    SessionDisplay,
    StageHead,
    StageProgress,
    StageResult,
    StopSessionError,
)
from membrane_ctrl.commissioning.guide.session_state import (
    CONFIGURATION,
    HTML,
    PDF,
    SessionState,
    StageRecord,
    TomlTable,
    read_state,
    read_tables,
    restore_lent_keys,
    write_state,
)
from membrane_ctrl.commissioning.guide.stage import (
    CommissioningStage,
    SessionPlan,
    StageContext,
    StageFailedError,
)
from membrane_ctrl.commissioning.guide.stage_list import STAGES
from membrane_ctrl.model import errors
from membrane_ctrl.model.account import account_name

_AGAIN, _ON, _BACK = "again", "continue", "back"
_HELP = (
    "At every prompt: `back` returns to the stage before, `quit` or Ctrl-C ends; nothing is lost."
)


class CommissioningSession:
    """Runs a session in a folder.

    Parameters
    ----------
    folder : path
        Of the session: `session.json`, `lab.toml`, runs, report.
    access : BenchAccess
        The bench: devices, or the emulated one.
    display : SessionDisplay
        Terminal or page.
    plan : SessionPlan, optional
        The durations of a full session by default.
    stages : sequence of CommissioningStage, optional
        All stages by default; tests run some of them.
    """

    def __init__(
        self,
        folder: Path,
        access: BenchAccess,
        display: SessionDisplay,
        plan: SessionPlan = SessionPlan(),  # noqa: B008
        stages: Sequence[CommissioningStage] = STAGES,
    ) -> None:
        self._folder = folder
        self._access = access
        self._plan = plan
        self._stages = stages
        self._state = self._open_state()
        self._dialogue = Dialogue(
            display, self._state.answers, lambda: write_state(folder, self._state)
        )

    def _open_state(self) -> SessionState:
        """The folder's state, or a new one. Raises InputError for one of the other kind."""
        state = read_state(self._folder)
        if state is None:
            return SessionState(
                created_utc=_now_utc(), author=account_name(), simulated=self._access.simulated
            )
        if state.simulated != self._access.simulated:
            if state.simulated:
                remedy = "a session on the emulated bench; add --twin, or name another folder"
            else:
                remedy = "a session on a real bench; leave out --twin, or name another folder"
            raise errors.InputError(f"{self._folder}: {remedy}")
        return state

    def run(self) -> errors.Exit:
        """Run the stages that are not done; returns REJECTED if the bench is not accepted.

        Raises DeviceError or InputError for files that cannot be written or read.
        """
        self._dialogue.show(_HELP)
        restored = restore_lent_keys(self._folder, self._state)
        if restored:
            names = ", ".join(restored)
            self._dialogue.show(f"the last start was cut off: {names} are as before its stage")
        self._show_plan()
        index = self._find_first_open()
        try:
            while index < len(self._stages):
                index = self._run_stage(index)
        except (StopSessionError, KeyboardInterrupt, EOFError):
            option = " --twin" if self._state.simulated else ""
            command = f"membrane-ctrl commission {self._folder}{option}"
            self._dialogue.show("", f"stopped; `{command}` resumes this session")
            return errors.Exit.INTERRUPTED
        return self._finish()

    def _find_first_open(self) -> int:
        """Index of the first stage that has no record."""
        for index, stage in enumerate(self._stages):
            if self._is_needed(stage) and self._state.find_record(stage.name) is None:
                return index
        return len(self._stages)

    def _is_needed(self, stage: CommissioningStage) -> bool:
        return stage.is_needed(self._state, read_tables(self._folder))

    def _show_plan(self) -> None:
        """Show all stages and how far each is."""
        tables = read_tables(self._folder)
        plan = [
            StageProgress(
                step=stage.step,
                title=report.STEP_TITLES[stage.step],
                name=stage.name,
                result=self._find_result(stage, tables),
            )
            for stage in self._stages
        ]
        self._dialogue.display.show_plan(tuple(plan))

    def _find_result(self, stage: CommissioningStage, tables: TomlTable) -> StageResult:
        """How far a stage is."""
        record = self._state.find_record(stage.name)
        if record is None and "devices" not in tables:
            return StageResult.OPEN
        if not stage.is_needed(self._state, tables):
            return StageResult.NOT_NEEDED
        if record is None:
            return StageResult.OPEN
        return StageResult.FAILED if record.failed else StageResult.PASSED

    def _run_stage(self, index: int) -> int:
        """Run a stage; returns the index of the next one."""
        stage = self._stages[index]
        if not self._is_needed(stage):
            return index + 1
        self._dialogue.display.show_stage(make_stage_head(stage))
        context = StageContext(self._folder, self._state, self._dialogue, self._access, self._plan)
        # A stage ends in one of three ways: the person goes back; it cannot be finished, and the
        # bench has then been made safe; or it has made its checks, passed or failed.
        problem = ""
        try:
            stage.run(context)
        except GoBackError:
            return self._go_back(index)
        except (StageFailedError, roles.LinkError, errors.DeviceError) as error:
            problem = str(error)
        record = StageRecord(
            stage=stage.name, finished_utc=_now_utc(), checks=tuple(context.checks)
        )
        if problem:
            self._dialogue.show(f"  stopped safely: {problem}")
        if not problem and not record.failed:
            self._store(record)
            return index + 1
        return self._ask_after_failure(index, record, problem)

    def _ask_after_failure(self, index: int, record: StageRecord, problem: str) -> int:
        """What to do after a stage that failed: again, back, or on where gas may move anyway."""
        stage = self._stages[index]
        choices = [
            Choice(name=_AGAIN, meaning="run this stage again"),
            Choice(name=_BACK, meaning="the stage before"),
        ]
        if not problem and not stage.must_pass:
            choices.append(
                Choice(name=_ON, meaning="continue; the report names it as a reason not to accept")
            )
        self._state.answers.pop(f"{stage.name}.after", None)
        try:
            answer = self._dialogue.ask_choice(f"{stage.name}.after", "what now?", choices)
        except GoBackError:
            answer = _BACK
        if answer == _ON:
            self._store(record)
            return index + 1
        return index if answer == _AGAIN else self._go_back(index)

    def _go_back(self, index: int) -> int:
        """Forget the stage before, and return its index."""
        for before in range(index - 1, -1, -1):
            if self._is_needed(self._stages[before]):
                self._state.remove_record(self._stages[before].name)
                write_state(self._folder, self._state)
                self._show_plan()
                return before
        self._dialogue.show("  this is the first stage")
        return index

    def _store(self, record: StageRecord) -> None:
        self._state.add_record(record)
        write_state(self._folder, self._state)
        self._show_plan()

    def _finish(self) -> errors.Exit:
        """Ask for the signature, write the report, and show the verdict."""
        try:
            signed_by = self._dialogue.ask_text("signature", "your name, to sign the report")
        except (GoBackError, StopSessionError, KeyboardInterrupt, EOFError):
            signed_by = ""
        tables = read_tables(self._folder)
        accepted = report.write_report(self._folder, self._stages, self._state, tables, signed_by)
        reasons = report.find_reasons(self._stages, self._state, tables)
        self._dialogue.show("", "accepted" if accepted else "not accepted:")
        self._dialogue.show(*(f"  {reason}" for reason in reasons))
        self._dialogue.show(
            f"report: {self._folder / HTML}, {self._folder / PDF}",
            f"configuration: {self._folder / CONFIGURATION}",
        )
        return errors.Exit.DONE if accepted else errors.Exit.REJECTED


def make_stage_head(stage: CommissioningStage) -> StageHead:
    """What is shown when a stage begins."""
    return StageHead(
        step=stage.step,
        title=report.STEP_TITLES[stage.step],
        name=stage.name,
        does=stage.does,
        look_for=stage.look_for,
    )


def _now_utc() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
