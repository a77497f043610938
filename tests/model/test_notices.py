"""Notices that events open and close."""

from __future__ import annotations

import pytest

from membrane_ctrl.model.child_events import ChildEnded, ChildRestarted
from membrane_ctrl.model.event_base import Event
from membrane_ctrl.model.event_lines import KINDS
from membrane_ctrl.model.events import (
    Cleared,
    Fault,
    InterlockClosed,
    InterlockOpened,
    LockRemoved,
    LockSet,
    Maintenance,
    MaintenanceOver,
    StateEntered,
)
from membrane_ctrl.model.notices import NoticeKey, Topic
from membrane_ctrl.model.recorder_events import DiskLow, RecorderError
from membrane_ctrl.model.run_events import Link, LockNotStored
from membrane_ctrl.model.run_status import RunStatus

HOLDS_FLOW = Fault(
    10,
    "displacement_missing",
    "no valid laser reading",
    "",
    "",
    "hold_flow",
    False,
    "aim the laser",
)
LATCHED = Fault(20, "over_pressure", "too much", "", "", "vent", True, "find out why")


def status_after(*told: Event) -> RunStatus:
    status = RunStatus()
    for event in told:
        status = status.after_event(event)
    return status


def keys_after(*told: Event) -> list[NoticeKey]:
    return list(status_after(*told).notices)


def test_a_notice_stays_open_until_the_event_that_closes_its_subject() -> None:
    door, gate = (InterlockOpened(name, "text", "vent") for name in ("door", "gate"))
    assert keys_after(door, gate) == [
        NoticeKey(Topic.INTERLOCK, "door"),
        NoticeKey(Topic.INTERLOCK, "gate"),
    ]
    assert keys_after(door, gate, InterlockClosed("door")) == [NoticeKey(Topic.INTERLOCK, "gate")]
    assert keys_after(Maintenance("creep", "x"), MaintenanceOver("creep", "y")) == []
    assert keys_after(MaintenanceOver("creep", "y")) == []


def test_the_text_of_a_notice_is_the_sentence_of_the_newest_event() -> None:
    opened = [RecorderError("disk", "full"), DiskLow("disk", "500 MB left")]
    (notice,) = status_after(*opened).notices.values()
    assert notice.text == "Disk almost full: 500 MB left"


def test_a_fault_that_held_the_flow_for_too_long_is_latched() -> None:
    latched = status_after(HOLDS_FLOW, StateEntered("fault", "hold", "too long")).notices
    fault = latched[NoticeKey(Topic.FAULT)]
    assert (fault.severity, fault.always_new, fault.text) == ("critical", True, HOLDS_FLOW.sentence)
    assert keys_after(HOLDS_FLOW, Cleared("displacement_missing")) == []
    assert (
        keys_after(
            HOLDS_FLOW, StateEntered("fault", "hold", ""), StateEntered("standby", "fault", "")
        )
        == []
    )


def test_a_latched_fault_is_one_notice() -> None:
    assert keys_after(LATCHED, StateEntered("fault", "hold", "")) == [NoticeKey(Topic.FAULT)]


def test_a_removed_lock_closes_the_notice_on_its_storage() -> None:
    lock = LockSet("bofak", "hands", "ann", "", "", "", 1)
    removed = LockRemoved("bofak", "hands", "ann", "", "ann", "author", 2)
    assert keys_after(lock, LockNotStored("bofak", "full"), removed) == []


def test_a_new_recorder_closes_the_notices_of_the_previous_one_only() -> None:
    before = (
        RecorderError("disk", "full"),
        RecorderError("tables", "x"),
        Maintenance("creep", "x"),
    )
    left = keys_after(*before, ChildEnded("recorder", -9), ChildRestarted("recorder", 1))
    assert left == [NoticeKey(Topic.MAINTENANCE, "creep")]
    assert len(keys_after(*before, ChildRestarted("screen", 1))) == 3


def test_displays_list_what_they_do_not_show_with_details() -> None:
    status = status_after(
        LATCHED, LockSet("bofak", "x", "ann", "", "", "", 1), Link("no answer", False)
    )
    assert [notice.text for notice in status.other_notices] == ["Link to the pump board: no answer"]
    assert status.recording_problems == ()


@pytest.mark.parametrize(
    ("key", "alarm"),
    [
        (NoticeKey(Topic.MAINTENANCE, "creep"), "maintenance_creep"),
        (NoticeKey(Topic.CHILD, "screen"), "screen_ended"),
        (NoticeKey(Topic.RECORDING, "disk"), "recorder"),
        (NoticeKey(Topic.INTERLOCK, "door"), "interlock"),
    ],
)
def test_the_name_of_the_alarm(key: NoticeKey, alarm: str) -> None:
    assert key.alarm == alarm


def test_every_topic_that_can_be_opened_can_be_closed() -> None:
    opened = {topic for cls in KINDS.values() for topic in cls.opens}
    closed = {topic for cls in KINDS.values() for topic in cls.closes}
    assert opened == set(Topic)
    assert opened - closed == {Topic.RUN_END}
