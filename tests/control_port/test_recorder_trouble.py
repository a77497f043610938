from __future__ import annotations

from membrane_ctrl.model.child_events import ChildEnded, ChildGivenUp, ChildRestarted
from membrane_ctrl.model.events import Event
from membrane_ctrl.model.recorder_events import DiskLow, RecorderError
from membrane_ctrl.model.run_status import RunStatus
from membrane_ctrl.recorder.recorder_errors import RecorderErrors


class Trouble:
    """The recorder's part of a run's status."""

    def __init__(self) -> None:
        self.status = RunStatus()

    def take(self, event: Event) -> None:
        self.status = self.status.after_event(event)

    @property
    def words(self) -> str:
        return "; ".join(self.status.recording_problems)


def test_each_trouble_stands_until_its_own_end() -> None:
    trouble = Trouble()
    recorder_errors = RecorderErrors(trouble.take)
    assert trouble.words == ""
    recorder_errors.report_error("disk", "less than 500 MB free", DiskLow)
    recorder_errors.report_error("state file", "state file: x")
    recorder_errors.report_error("state file", "state file:\n  y")
    low = "Disk almost full: less than 500 MB free"
    failed = "Not recorded: state file: y. Do: check the disk and the folder of the run"
    assert trouble.words == f"{low}; {failed}"
    recorder_errors.report_recovered("state file")
    assert trouble.words == low
    recorder_errors.report_recovered("disk")
    assert trouble.words == ""
    recorder_errors.report_error("recording", "x" * 5000)
    assert trouble.words == f"Not recorded: {'x' * 286}", "it is in every line of the log"


def test_without_a_recorder_nothing_is_recorded_and_the_next_one_reports_its_own_trouble() -> None:
    trouble = Trouble()
    trouble.take(RecorderError("state file", "state file: x"))
    trouble.take(ChildEnded("screen", 1))
    assert "screen" not in trouble.words
    trouble.take(ChildEnded("recorder", -9))
    assert "The recorder process ended with exit code -9; the hold continues" in trouble.words
    trouble.take(ChildRestarted("screen", 1))
    assert trouble.words
    trouble.take(ChildRestarted("recorder", 1))
    assert trouble.words == ""


def test_a_recorder_that_is_left_alone_for_an_hour_stays_in_sight() -> None:
    trouble = Trouble()
    trouble.take(ChildGivenUp("recorder", 10))
    assert trouble.words.startswith("The recorder process ended too often")
