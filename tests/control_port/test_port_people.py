from __future__ import annotations

from membrane_ctrl.control_port.commander import Commander
from membrane_ctrl.control_port.refusal_record import Refusals
from membrane_ctrl.control_port.sender import Peer, explain_missing_role
from membrane_ctrl.model.events import Event


def test_the_first_to_command_has_it_and_the_second_learns_who() -> None:
    commander = Commander(600.0)
    assert commander.holder(0.0) == ""
    assert commander.claim("unix:ann", False, 0.0) == ""
    assert "unix:ann" in commander.claim("unix:bob", False, 10.0)
    assert commander.holder(10.0) == "unix:ann"


def test_it_is_taken_over_given_back_or_lapses() -> None:
    commander = Commander(600.0)
    commander.claim("unix:ann", False, 0.0)
    assert commander.claim("unix:bob", True, 1.0) == ""
    assert commander.holder(1.0) == "unix:bob"
    commander.release("unix:ann")
    assert commander.holder(1.0) == "unix:bob", "only who has it gives it back"
    commander.release("unix:bob")
    assert commander.holder(1.0) == ""
    commander.claim("unix:ann", False, 2.0)
    assert commander.holder(602.0) == "unix:ann"
    assert commander.holder(602.1) == ""
    assert commander.claim("unix:bob", False, 602.1) == ""


def test_each_command_keeps_it_from_lapsing() -> None:
    commander = Commander(600.0)
    for now_s in range(0, 6000, 500):
        assert commander.claim("unix:ann", False, float(now_s)) == ""
    assert commander.holder(6000.0) == "unix:ann"


def test_roles_are_steps() -> None:
    assert "needs the role tune; unix:ann has operate" in explain_missing_role(
        Peer("unix:ann", "operate"), "gains"
    )
    assert explain_missing_role(Peer("unix:ann", "operate"), "stop") == ""
    assert explain_missing_role(Peer("unix:ann", "tune"), "stop") == ""
    assert "needs the role operate" in explain_missing_role(Peer("unix:eve", "read"), "stop")


def test_a_flood_of_refusals_is_counted_and_not_written() -> None:
    now_s = 0.0
    events: list[Event] = []
    refusals = Refusals(events.append, lambda: now_s)
    for _ in range(1000):
        refusals.record("unix:eve", "stop", "no")
    assert len(events) == 10
    assert refusals.count == 1000
    now_s = 10.0
    refusals.record("unix:eve", "stop", "no")
    assert events[-1].to_dict()["and_unrecorded"] == 990
    now_s = 1e6
    for _ in range(11):
        refusals.record("unix:eve", "stop", "no")
    assert len(events) == 21, "a long silence buys no longer burst"
    assert "and_unrecorded" not in events[-1].to_dict()
