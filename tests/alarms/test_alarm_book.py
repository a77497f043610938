"""Which notices people get and when; time is a number here."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from membrane_ctrl.alarms.book import AlarmBook, AlarmMessage, Sign, signs_of
from membrane_ctrl.config.alarms import AlarmsConfig
from membrane_ctrl.model.child_events import ChildRestarted
from membrane_ctrl.model.events import Event
from membrane_ctrl.model.recorder_events import DiskLow
from membrane_ctrl.model.run_status import RunStatus
from membrane_ctrl.recorder.recorder_errors import RecorderErrors

LOW = "Disk almost full: less than 500 MB free"
NOT_RECORDED = "Not recorded: state file: x. Do: check the disk and the folder of the run"
CONFIG = AlarmsConfig(escalate_after_s=900, remind_every_s=3600, clear_after_s=30)
BAD, GOOD = Sign("leak", True, "warning", "it leaks", for_s=10.0), Sign("leak", False)


def kinds(notices: list[AlarmMessage]) -> list[str]:
    return [notice.kind for notice in notices]


def book_with_a_told_alarm() -> AlarmBook:
    book = AlarmBook(CONFIG)
    book.take_sign(BAD, 0.0)
    assert kinds(book.step(10.0)) == ["raised"]
    return book


def test_a_condition_must_stand_for_its_time() -> None:
    book = AlarmBook(CONFIG)
    book.take_sign(BAD, 0.0)
    assert book.step(9.9) == []
    assert book.step(10.0) == [AlarmMessage("raised", "leak", "warning", "it leaks")]
    assert book.step(11.0) == [], "sent once"


def test_an_alarm_that_clears_before_its_time_is_not_sent() -> None:
    book = AlarmBook(CONFIG)
    for start_s in range(0, 100, 10):
        book.take_sign(BAD, float(start_s))
        book.take_sign(GOOD, start_s + 9.0)
        assert book.step(start_s + 9.5) == []


def test_it_is_over_when_it_stays_away_and_not_before() -> None:
    book = book_with_a_told_alarm()
    for start_s in range(20, 200, 20):  # flaps every 20 s
        book.take_sign(GOOD, float(start_s))
        assert book.step(start_s + 9.0) == []
        book.take_sign(BAD, start_s + 10.0)
        assert book.step(start_s + 11.0) == []
    book.take_sign(GOOD, 300.0)
    book.take_sign(GOOD, 320.0)
    assert book.step(329.9) == []
    assert kinds(book.step(330.0)) == ["cleared"]
    book.take_sign(BAD, 400.0)
    assert kinds(book.step(410.0)) == ["raised"], "a new alarm"


def test_without_an_acknowledgement_more_people_receive_the_alarm() -> None:
    book = book_with_a_told_alarm()
    assert book.step(909.0) == []
    (notice,) = book.step(910.0)
    assert (notice.kind, notice.escalated) == ("escalated", True)
    assert book.step(911.0) == []
    (notice,) = book.step(910.0 + 3600.0)
    assert (notice.kind, notice.escalated) == ("reminder", True)
    book.take_sign(GOOD, 5000.0)
    (notice,) = book.step(5030.0)
    assert (notice.kind, notice.escalated) == ("cleared", True), (
        "a person who was woken also gets the end"
    )


def test_acknowledged_it_is_quiet_until_it_is_over() -> None:
    book = book_with_a_told_alarm()
    book.acknowledge_all(20.0)
    assert book.step(1e6) == []
    book.take_sign(GOOD, 1e6)
    assert kinds(book.step(1e6 + 30.0)) == ["cleared"]


def test_an_acknowledgement_is_not_for_what_comes_later() -> None:
    book = AlarmBook(CONFIG)
    book.take_sign(BAD, 0.0)
    book.acknowledge_all(20.0)  # no notice of it was sent yet
    assert kinds(book.step(10.0)) == ["raised"]
    assert kinds(book.step(910.0)) == ["escalated"]


def test_a_good_sign_of_nothing_is_nothing() -> None:
    book = AlarmBook(CONFIG)
    book.take_sign(GOOD, 0.0)
    assert book.step(1e6) == []
    assert not book.is_standing("leak")


@given(st.lists(st.tuples(st.booleans(), st.floats(0.1, 100.0)), max_size=60))
def test_raised_and_cleared_take_turns(changes: list[tuple[bool, float]]) -> None:
    book = AlarmBook(CONFIG)
    now_s, sent = 0.0, []
    for bad, wait_s in changes:
        book.take_sign(BAD if bad else GOOD, now_s)
        now_s += wait_s
        sent += [kind for kind in kinds(book.step(now_s)) if kind in ("raised", "cleared")]
    assert sent == (["raised", "cleared"] * len(sent))[: len(sent)]


@pytest.mark.parametrize("name", ["fault", "silent"])
def test_alarms_stand_beside_each_other(name: str) -> None:
    book = book_with_a_told_alarm()
    book.take_sign(Sign(name, True, "critical", "!"), 20.0)
    (notice,) = book.step(20.0)
    assert (notice.name, notice.severity) == (name, "critical")


class Disk:
    """The recorder's errors as the alarms get them, at a time set by hand."""

    def __init__(self) -> None:
        self.book = AlarmBook(CONFIG)
        self.recorder_errors = RecorderErrors(self.hear)
        self.now_s = 0.0
        self.status = RunStatus()

    def hear(self, event: Event) -> None:
        for sign in signs_of(event.notice_changes(self.status.notices)):
            self.book.take_sign(sign, self.now_s)
        self.status = self.status.after_event(event)

    def step(self, now_s: float) -> list[tuple[str, str]]:
        self.now_s = now_s
        return [(notice.kind, notice.text) for notice in self.book.step(now_s)]


def test_trouble_with_the_disk_is_over_with_the_last_of_it_and_not_with_the_first() -> None:
    disk = Disk()
    disk.recorder_errors.report_error("disk", "less than 500 MB free", DiskLow)
    assert disk.step(0.0) == [("raised", LOW)]
    disk.step(5.0)
    disk.recorder_errors.report_error("state file", "state file: x")
    disk.step(6.0)
    disk.recorder_errors.report_recovered("state file")
    assert disk.step(37.0) == []
    assert disk.book.is_standing("recorder")
    assert disk.step(910.0) == [("escalated", LOW)]
    disk.recorder_errors.report_recovered("disk")
    assert disk.step(940.0) == [("cleared", LOW)]


def test_a_reminder_names_what_still_stands() -> None:
    disk = Disk()
    disk.recorder_errors.report_error("disk", "less than 500 MB free", DiskLow)
    disk.recorder_errors.report_error("state file", "state file: x")
    disk.step(0.0)
    disk.recorder_errors.report_recovered("disk")
    assert disk.step(900.0) == [("escalated", NOT_RECORDED)]


def test_another_recorder_begins_without_the_formers_trouble_and_reports_its_own() -> None:
    disk = Disk()
    disk.recorder_errors.report_error("state file", "state file: x")
    disk.step(0.0)
    disk.hear(ChildRestarted("recorder", 1))
    disk.step(1.0)
    assert not disk.book.is_standing("recorder")
    RecorderErrors(disk.hear).report_error("disk", "less than 500 MB free", DiskLow)
    assert disk.step(40.0) == [], "the same alarm, not cleared and raised again"
    assert disk.step(900.0) == [("escalated", LOW)]
