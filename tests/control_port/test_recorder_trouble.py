from __future__ import annotations

from membrane_ctrl.control_port.status import RecorderTrouble
from membrane_ctrl.recorder.sink import RecorderErrors


def test_each_trouble_stands_until_its_own_end() -> None:
    trouble = RecorderTrouble()
    recorder_errors = RecorderErrors(trouble.take)
    assert trouble.words == ""
    recorder_errors.report_error("disk", "less than 500 MB free", kind="disk_low")
    recorder_errors.report_error("state file", "state file: x")
    recorder_errors.report_error("state file", "state file:\n  y")
    assert trouble.words == "less than 500 MB free; state file: y"
    recorder_errors.recovered("state file")
    assert trouble.words == "less than 500 MB free"
    recorder_errors.recovered("disk")
    assert trouble.words == ""
    recorder_errors.report_error("recording", "x" * 5000)
    assert trouble.words == "x" * 300, "it is in every line of the log"


def test_without_a_recorder_nothing_is_recorded_and_the_next_one_tells_its_own_trouble() -> None:
    trouble = RecorderTrouble()
    trouble.take({"kind": "recorder_error", "what": "state file", "message": "state file: x"})
    trouble.take({"kind": "child_ended", "child": "screen", "exit_code": 1})
    assert "recorder" not in trouble.standing
    trouble.take({"kind": "child_ended", "child": "recorder", "exit_code": -9})
    assert trouble.standing["recorder"] == "no recorder runs"
    trouble.take({"kind": "child_restarted", "child": "screen", "restarts": 1})
    assert trouble.words
    trouble.take({"kind": "child_restarted", "child": "recorder", "restarts": 1})
    assert trouble.words == ""


def test_a_recorder_that_is_left_alone_for_an_hour_stays_in_sight() -> None:
    trouble = RecorderTrouble()
    trouble.take({"kind": "child_given_up", "child": "recorder", "restarts": 10})
    assert trouble.words == "no recorder runs"
