"""The session as messages, and its claim of a folder."""

from __future__ import annotations

import io
import threading
from pathlib import Path

import pytest

from membrane_ctrl.commissioning.guide.dialogue import Question, QuestionKind
from membrane_ctrl.commissioning.guide.folder_claim import claim_folder
from membrane_ctrl.commissioning.guide.session_messages import (
    MESSAGES,
    MessageDisplay,
    PlanMessage,
    QuestionMessage,
)
from membrane_ctrl.model.errors import DeviceError
from tests.commissioning.guided import QuickBench, make_session

ASKED = Question(key="fill", kind=QuestionKind.CONFIRMATION, text="Fill?")


def test_only_the_answer_to_the_question_counts() -> None:
    ended = threading.Event()
    lines = '{"number": 7, "answer": "y"}\nnonsense\n{"number": 1, "answer": "n"}\n'
    target = io.StringIO()
    display = MessageDisplay(io.StringIO(lines), target, ended.set)
    assert display.ask_question(ASKED) == "n"
    with pytest.raises(EOFError):
        display.ask_question(ASKED)
    assert ended.wait(10.0)
    sent = [MESSAGES.validate_json(line) for line in target.getvalue().splitlines()]
    assert [message.number for message in sent if isinstance(message, QuestionMessage)] == [1, 2]


def test_the_plan_follows_the_stages(tmp_path: Path) -> None:
    target = io.StringIO()
    answers = '{"number": 1, "answer": "paper"}\n{"number": 2, "answer": "stop"}\n'
    display = MessageDisplay(io.StringIO(answers), target, lambda: None)
    make_session(tmp_path, QuickBench(), display).run()
    sent = [MESSAGES.validate_json(line) for line in target.getvalue().splitlines()]
    plan = next(message.plan for message in sent if isinstance(message, PlanMessage))
    assert {stage.result for stage in plan} == {"open"}  # no device is known yet
    assert plan[0].name == "mirror"


def test_a_folder_has_one_session(tmp_path: Path) -> None:
    runs_already = pytest.raises(DeviceError, match="runs already")
    with claim_folder(tmp_path), runs_already, claim_folder(tmp_path):
        pass
    with claim_folder(tmp_path):  # and another one after it
        pass
