"""One process sends the alarms of a run, whichever it is: each message is sent once."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from membrane_ctrl.alarms import sent_log
from membrane_ctrl.alarms.book import AlarmMessage
from membrane_ctrl.alarms.run_alarms import RunAlarms
from membrane_ctrl.alarms.sent_log import LOCK_NAME, LOG_NAME, STALE_S, SentLog
from membrane_ctrl.config.alarms import AlarmsConfig
from membrane_ctrl.model.telemetry import FIELDS, TelemetryRow

CONFIG = AlarmsConfig(urls_file="lab", escalation_urls_file="boss")
ROW = TelemetryRow(*(0.0 for _ in FIELDS)).pack()
HOLD_PATIENCE_S = 30.0


def event(**fields: object) -> bytes:
    return json.dumps(fields).encode()


def fault(name: str, mono_s: float) -> bytes:
    return event(kind="fault", name=name, latching=True, mono_s=mono_s)


def acknowledgement(mono_s: float) -> list[bytes]:
    return [
        event(kind="command", command="ack", mono_s=mono_s),
        event(kind="state", state="standby", mono_s=mono_s, **{"from": "fault"}),
    ]


@dataclass
class Phones:
    """What the lab and the boss have received, with the process that sent it."""

    lab: list[tuple[str, str, str]] = field(default_factory=list)
    boss: list[tuple[str, str, str]] = field(default_factory=list)
    boss_is_down: bool = False

    def kinds(self) -> list[tuple[str, str]]:
        return [(name, kind) for _, name, kind in self.lab]


@dataclass
class World:
    """A run's folder, its clock, and processes that follow it."""

    folder: Path
    phones: Phones
    now_s: float = 0.0
    running: dict[str, tuple[RunAlarms, SentLog]] = field(default_factory=dict)

    def start(self, who: str, patience_s: float = 0.0) -> None:
        def to_lab(message: AlarmMessage) -> bool:
            self.phones.lab.append((who, message.name, message.kind))
            return True

        def to_boss(message: AlarmMessage) -> bool:
            if not self.phones.boss_is_down:
                self.phones.boss.append((who, message.name, message.kind))
            return not self.phones.boss_is_down

        log = SentLog(self.folder, who)
        alarms = RunAlarms(CONFIG, log, [to_lab, to_boss], patience_s, lambda: self.now_s)
        self.running[who] = alarms, log

    def kill(self, who: str) -> None:
        _, log = self.running.pop(who)
        log.close()

    def step(self, now_s: float, *events: bytes, only: str = "") -> None:
        self.now_s = now_s
        for who, (alarms, _) in list(self.running.items()):
            if not only or who == only:
                alarms.process_news([ROW], events)


@pytest.fixture
def world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[World]:
    found = World(tmp_path, Phones())
    monkeypatch.setattr(sent_log.time, "monotonic", lambda: 1000.0 + found.now_s)
    yield found
    for who in list(found.running):
        found.kill(who)


def test_the_service_sends_and_the_hold_does_not(world: World) -> None:
    world.start("hold", HOLD_PATIENCE_S)
    world.start("service")
    world.step(0.0)
    world.step(5.0, fault("late", 5.0))
    for now_s in range(6, 200):
        world.step(float(now_s))
    assert world.phones.lab == [("service", "fault", "raised")]


def test_the_hold_sends_after_half_a_minute_without_a_service(world: World) -> None:
    world.start("hold", HOLD_PATIENCE_S)
    world.step(0.0)
    world.step(5.0, fault("late", 5.0))
    world.step(29.9)
    assert world.phones.lab == []
    world.step(30.0)
    assert world.phones.lab == [("hold", "fault", "raised")]
    world.step(40.0, fault("over_pressure", 40.0))
    assert len(world.phones.lab) == 1, "the same alarm continues"


def test_a_service_that_comes_later_repeats_nothing(world: World) -> None:
    past = fault("late", 5.0)
    world.start("hold", HOLD_PATIENCE_S)
    world.step(0.0, past)
    world.step(30.0)
    world.start("service")
    world.step(40.0, past, only="service")
    world.kill("hold")
    world.step(41.0)
    world.step(100.0)
    assert world.phones.lab == [("hold", "fault", "raised")]
    world.step(101.0, *acknowledgement(101.0))
    world.step(140.0)
    world.step(150.0, fault("over_pressure", 150.0))
    assert world.phones.lab[1:] == [
        ("service", "fault", "cleared"),
        ("service", "fault", "raised"),
    ]


def test_a_service_that_dies_before_it_sends_is_replaced_by_the_hold(world: World) -> None:
    world.start("hold", HOLD_PATIENCE_S)
    world.start("service")
    world.step(0.0)
    world.kill("service")
    for now_s in range(1, 60):
        world.step(float(now_s), *([fault("late", 1.0)] if now_s == 1 else []))
    assert world.phones.lab == [("hold", "fault", "raised")]


def test_a_service_that_restarts_continues_where_it_was(world: World) -> None:
    past = fault("late", 5.0)
    world.start("hold", HOLD_PATIENCE_S)
    world.start("service")
    world.step(5.0, past)
    world.kill("service")
    world.step(15.0, only="hold")
    world.start("service")
    world.step(20.0, past, only="service")
    for now_s in range(25, 910, 5):
        world.step(float(now_s))
    world.step(910.0, *acknowledgement(910.0))
    world.step(950.0)
    assert world.phones.kinds() == [
        ("fault", "raised"),
        ("fault", "escalated"),
        ("fault", "cleared"),
    ]
    assert {who for who, *_ in world.phones.lab} == {"service"}


def test_of_two_services_one_sends(world: World) -> None:
    world.start("first")
    world.start("second")
    world.step(0.0)
    world.step(5.0, fault("late", 5.0))
    world.kill("first")
    world.step(6.0)
    world.step(7.0, event(kind="end", exit="safety_trip", mono_s=7.0))
    assert world.phones.lab == [("first", "fault", "raised"), ("second", "run_ended", "raised")]


def test_a_fault_that_came_while_no_process_sent_is_a_new_one(world: World) -> None:
    world.start("hold", HOLD_PATIENCE_S)
    world.start("service")
    world.step(0.0)
    world.step(5.0, fault("late", 5.0))
    world.kill("service")
    world.step(6.0, *acknowledgement(6.0))
    world.step(7.0, fault("over_pressure", 7.0))
    world.step(40.0)
    assert world.phones.lab == [("service", "fault", "raised"), ("hold", "fault", "raised")]


def test_an_alarm_that_ended_while_no_process_sent_is_cleared(world: World) -> None:
    world.start("hold", HOLD_PATIENCE_S)
    world.start("service")
    world.step(0.0)
    world.step(5.0, fault("late", 5.0))
    world.kill("service")
    world.step(6.0, *acknowledgement(6.0))
    world.step(40.0)
    world.step(40.0 + CONFIG.clear_after_s)
    assert world.phones.lab == [("service", "fault", "raised"), ("hold", "fault", "cleared")]


def test_an_acknowledgement_while_no_process_sent_prevents_the_escalation(world: World) -> None:
    world.start("hold", HOLD_PATIENCE_S)
    world.start("service")
    world.step(0.0)
    world.step(5.0, fault("late", 5.0))
    world.kill("service")
    world.step(6.0, event(kind="alarms_acknowledged", mono_s=6.0))
    world.step(40.0)
    world.step(5000.0)
    assert world.phones.kinds() == [("fault", "raised")]
    assert world.phones.boss == []


def test_each_list_gets_what_it_has_not_got(world: World) -> None:
    world.phones.boss_is_down = True
    world.start("service")
    world.step(5.0, fault("late", 5.0))
    world.step(5.0 + CONFIG.escalate_after_s)
    world.kill("service")
    world.phones.boss_is_down = False
    world.start("second")
    world.step(906.0, fault("late", 5.0))
    world.step(1000.0)
    assert world.phones.kinds() == [("fault", "raised"), ("fault", "escalated")]
    assert world.phones.boss == [("second", "fault", "escalated")]


def test_a_sender_that_hangs_is_replaced_and_stays_silent_when_it_returns(world: World) -> None:
    world.start("hold", HOLD_PATIENCE_S)
    world.start("service")
    world.step(0.0)
    world.step(1.0, fault("late", 1.0), only="hold")  # the service is stopped
    for now_s in range(2, 120):
        world.step(float(now_s), only="hold")
        if now_s < STALE_S + HOLD_PATIENCE_S:
            assert world.phones.lab == []
    assert world.phones.lab == [("hold", "fault", "raised")]
    world.step(121.0, fault("late", 1.0), only="service")
    for now_s in range(122, 300):
        world.step(float(now_s))
    assert world.phones.lab == [("hold", "fault", "raised")]


@pytest.mark.parametrize("first", ["hold", "service"])
def test_a_control_process_that_vanished_is_reported_once(world: World, first: str) -> None:
    world.start("hold", HOLD_PATIENCE_S)
    world.start("service")
    world.step(0.0)
    if first == "hold":
        world.kill("service")
        world.step(31.0)
        world.step(62.0)
        world.start("service")
    world.now_s = 63.0
    for who in (first, "service" if first == "hold" else "hold"):
        alarms, _ = world.running[who]
        alarms.end_patience()
        alarms.report_orphan()
        assert alarms.is_done
    world.kill(first)
    for alarms, _ in world.running.values():
        alarms.send_due()
    assert world.phones.lab == [(first, "control_gone", "raised")]


def test_a_full_disk_keeps_no_alarm_from_being_sent(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> int:
        raise OSError(errno.ENOSPC, "disk full")

    world.start("service")
    monkeypatch.setattr(os, "write", refuse)
    world.step(0.0)
    world.step(5.0, fault("late", 5.0))
    world.step(6.0)
    assert world.phones.lab == [("service", "fault", "raised")]


def test_a_torn_line_takes_no_other_with_it(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    write = os.write
    world.start("service")
    world.step(0.0)
    monkeypatch.setattr(os, "write", lambda handle, data: write(handle, data[:7]))
    world.step(5.0, fault("late", 5.0))
    monkeypatch.setattr(os, "write", write)
    world.step(6.0, event(kind="end", exit="safety_trip", mono_s=6.0))
    world.kill("service")
    world.start("second")
    past = [fault("late", 5.0), event(kind="end", exit="safety_trip", mono_s=6.0)]
    world.step(7.0, *past)
    assert ("second", "run_ended", "raised") not in world.phones.lab


@pytest.mark.parametrize(
    "text",
    ["[]", "5", "{", '{"sent": true}', '{"sent": true, "kind": "raised", "name": 5}', "\0" * 40],
)
def test_damaged_lines_are_no_messages(world: World, text: str) -> None:
    (world.folder / LOG_NAME).write_text(text + "\n")
    (world.folder / LOCK_NAME).write_text(text)
    world.start("service")
    world.step(0.0)
    world.step(5.0, fault("late", 5.0))
    assert world.phones.lab == [("service", "fault", "raised")]
