"""A child process is replaced at once, then after growing pauses, a limited number of times."""

from __future__ import annotations

from itertools import pairwise
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any

import pytest

from membrane_ctrl.model.child_events import Alive, ChildSilent
from membrane_ctrl.model.events import Event
from membrane_ctrl.model.recorder_events import DiskLow
from membrane_ctrl.processes.managed_child import ManagedChild


class FakeChild:
    """A child that ends on command."""

    name = "recorder"

    def __init__(self) -> None:
        self.alive = False
        self.exit_code: int | None = None

    def start(self) -> None:
        self.alive = True

    def kill(self) -> None:
        self.alive, self.exit_code = False, -9


class Agency:
    """Makes fake children and keeps the other ends of their pipes."""

    def __init__(self) -> None:
        self.numbers: list[int] = []
        self.theirs: list[Connection] = []

    def make(self, number: int) -> Any:
        ours, theirs = Pipe()
        self.numbers.append(number)
        self.theirs.append(theirs)
        return FakeChild(), ours


def kinds(events: list[Event]) -> list[str]:
    return [event.kind for event in events]


def make_managed() -> tuple[ManagedChild, Agency]:
    agency = Agency()
    managed = ManagedChild(agency.make)
    managed.start(0.0)
    return managed, agency


def test_the_messages_of_the_child_are_passed_on() -> None:
    managed, agency = make_managed()
    agency.theirs[0].send({"kind": "disk_low", "what": "disk", "message": "full"})
    assert managed.check_child(0.0) == [DiskLow("disk", "full")]
    assert managed.check_child(0.5) == []


def test_a_message_reaches_the_present_child_only() -> None:
    managed, agency = make_managed()
    assert managed.send("capture")
    assert agency.theirs[0].recv() == "capture"
    managed.child.kill()
    assert not managed.send("capture")


def test_a_dead_child_is_replaced_at_once_and_reported() -> None:
    managed, agency = make_managed()
    agency.theirs[0].send({"kind": "last words"})
    managed.child.kill()
    assert kinds(managed.check_child(3.0)) == ["last words", "child_ended", "child_restarted"]
    assert agency.numbers == [0, 1]
    assert managed.child.alive
    agency.theirs[1].send({"kind": "hello"})
    assert kinds(managed.check_child(3.5)) == ["hello"]


def test_replacements_are_delayed_increasingly_and_limited_to_ten_an_hour() -> None:
    managed, _ = make_managed()
    messages: list[str] = []
    restarted_s = []
    for half_second in range(2 * 3600):
        if managed.child.alive:
            managed.child.kill()
        events = kinds(managed.check_child(0.5 * half_second))
        messages += events
        if "child_restarted" in events:
            restarted_s.append(0.5 * half_second)
    waits = [later - before for before, later in pairwise(restarted_s)]
    assert len(restarted_s) == 10
    assert waits == sorted(waits)
    assert waits[0] <= 2.0
    assert waits[-1] >= 60.0
    assert messages.count("child_given_up") == 1
    assert messages.count("child_ended") == 11


def test_after_an_hour_it_is_tried_again() -> None:
    managed, agency = make_managed()
    for second in range(3000):
        if managed.child.alive:
            managed.child.kill()
        managed.check_child(float(second))
    assert agency.numbers[-1] == 10
    assert kinds(managed.check_child(3700.0)) == ["child_restarted"]


def test_a_child_that_stops_its_heartbeat_is_killed_and_replaced() -> None:
    managed, agency = make_managed()
    agency.theirs[0].send(Alive(5.0).to_dict())
    assert managed.check_child(10.0) == []
    assert managed.check_child(15.0) == []
    (silent,) = managed.check_child(15.5)
    assert silent == ChildSilent("recorder", 0.5, killed=True)
    assert kinds(managed.check_child(16.0)) == ["child_ended", "child_restarted"]
    agency.theirs[1].send(Alive(5.0).to_dict())
    assert managed.check_child(17.0) == []


@pytest.mark.parametrize(("moment_s", "messages"), [(59.0, []), (61.0, ["child_silent"])])
def test_a_child_that_never_sends_a_heartbeat_is_not_waited_for(
    moment_s: float, messages: list[str]
) -> None:
    managed, _ = make_managed()
    assert kinds(managed.check_child(moment_s)) == messages


def test_a_child_beyond_its_replacements_is_not_killed_and_may_recover() -> None:
    managed, agency = make_managed()
    for second in range(0, 1200, 2):
        if len(agency.numbers) <= 10 and managed.child.alive:
            managed.child.kill()
        managed.check_child(float(second))
    agency.theirs[-1].send(Alive(5.0).to_dict())
    assert managed.check_child(1200.0) == []
    (silent,) = managed.check_child(1206.0)
    assert not silent.to_dict()["killed"]
    assert managed.child.alive
    assert managed.check_child(1207.0) == [], "said once"
    agency.theirs[-1].send(Alive(5.0).to_dict())
    managed.check_child(1208.0)
    assert kinds(managed.check_child(1214.0)) == ["child_silent"]
