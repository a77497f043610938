"""A commissioning session with a scripted person."""

from __future__ import annotations

from pathlib import Path

from membrane_ctrl.commissioning.guide.bench_access import BenchAccess
from membrane_ctrl.commissioning.guide.dialogue import SessionDisplay
from membrane_ctrl.commissioning.guide.emulated_bench import EmulatedBench, MakeHold
from membrane_ctrl.commissioning.guide.session import CommissioningSession
from membrane_ctrl.commissioning.guide.session_state import SessionState, read_state
from membrane_ctrl.commissioning.guide.stage import SessionPlan
from membrane_ctrl.commissioning.guide.stage_list import STAGES
from membrane_ctrl.commissioning.guide.text_display import TextDisplay
from membrane_ctrl.hold.virtual_hold import VirtualHold
from membrane_ctrl.model.errors import Exit

# A flow controller of 100 mL/s fills the mirror in eight minutes
PERSON = {
    "mirror.preset": "own",
    "mirror.relief_pa": "900",
    "mirror.pump_ml_per_s": "100",
    "mirror.pump_kind": "proportional",
    "camera.driver": "none",
    "interlock1.driver": "board_input",
    "interlock1.name": "emergency_stop",
    "interlock1.text": "turn the red button",
    "interlock1.input": "0",
    "interlock2.driver": "none",
    "signature": "Ann",
}
_QUESTIONS_MOST = 1000
SHORT = SessionPlan(settled_s=5.0, hold_s=20.0)


class QuickBench(EmulatedBench):
    """`tune` is a program of its own, with tests of its own: here it only ends."""

    tuned: list[str]
    exit_code = 0

    def __init__(self, make_hold: MakeHold = VirtualHold) -> None:
        super().__init__(make_hold)
        self.tuned = []

    def run_tuning(self, folder: Path, config: object, command: str, show: object) -> int:
        self.tuned.append(command)
        return self.exit_code


class Person:
    """Answers by the key of a question: a text, or texts in turn; `y` or Enter otherwise.

    After a failed stage the person stops, unless the test states otherwise.
    """

    def __init__(self, **answers: str | list[str]) -> None:
        self._answers: dict[str, str | list[str]] = {**PERSON, **answers}
        self.asked: list[str] = []
        self.shown: list[str] = []

    def read_line(self, key: str, prompt: str) -> str:
        self.asked.append(key)
        assert len(self.asked) < _QUESTIONS_MOST, f"{key} is asked again and again"
        answer = self._answers.get(key)
        if isinstance(answer, list):
            if answer:
                return answer.pop(0)
            answer = None
        if answer is not None:
            return answer
        if key.endswith(".after"):
            return "stop"
        return "y" if prompt.endswith("[y/n]") else ""

    @property
    def display(self) -> TextDisplay:
        return TextDisplay(self.read_line, self.shown.append)

    @property
    def text(self) -> str:
        return "\n".join(self.shown)


def make_session(
    folder: Path, bench: EmulatedBench, display: SessionDisplay, plan: SessionPlan = SHORT
) -> CommissioningSession:
    """A session of all stages."""
    return CommissioningSession(folder, bench, display, plan)


def run_stages(
    folder: Path, bench: BenchAccess, person: Person, *names: str, plan: SessionPlan = SHORT
) -> Exit:
    """Run the named stages, or all, of a session in a folder."""
    stages = tuple(stage for stage in STAGES if not names or stage.name in names)
    session = CommissioningSession(folder, bench, person.display, plan, stages)
    return session.run()


def state_of(folder: Path) -> SessionState:
    """The state that the session has written."""
    state = read_state(folder)
    assert state is not None
    return state


def failed_in(folder: Path, person: Person) -> list[str]:
    """Names of the checks that were shown as failed."""
    mark = "  failed: "
    return [line.removeprefix(mark).partition(":")[0] for line in person.shown if mark in line]
