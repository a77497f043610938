"""Locks in the tick: only `unlock` removes one; until then nothing admits gas."""

from __future__ import annotations

import itertools
import json
from dataclasses import asdict, replace

import pytest
from test_command_precedence import CONFIG, Mirror, in_state

from membrane_ctrl.controller import locks
from membrane_ctrl.controller.command import Command, Kind
from membrane_ctrl.controller.commands import AT_START, TABLE
from membrane_ctrl.controller.snapshot import continue_from, take_snapshot
from membrane_ctrl.controller.tick import TickInputs, TickOutputs
from membrane_ctrl.controller.tick_assembler import TickAssembler
from membrane_ctrl.controller.tick_codec import MESSAGE_BYTES, pack_tick, unpack_tick
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.events import CommandTaken, LockRemoved, LockSet
from membrane_ctrl.model.lock import LOCKS_MOST, Lock, describe_locks
from membrane_ctrl.model.lock_words import WORDS, distinct_word, make_word
from membrane_ctrl.model.run_status import RunStatus
from membrane_ctrl.model.telemetry import State

ANN = Lock(
    "bofak", "hands inside", "unix:ann", "unix:ann", "process 7", "2026-01-02T03:04:05+00:00"
)
BOB = Lock("gumil", "lens off", "page:bob", "page:bob", "page 1f", "2026-01-02T03:05:05+00:00")
LINK = Lock("tarep", "I am inside", "page:link", "", "page 2a", "2026-01-02T03:06:05+00:00")


def lock(of: Lock) -> Command:
    return Command("latch", of.author, text=of.text, lock=of)


def unlock(word: str = "", account: str = "", from_person: bool = True) -> Command:
    return Command(
        "unlock", account or "page:link", text=word, account=account, from_person=from_person
    )


def give(mirror: Mirror, *given: Command) -> TickOutputs:
    """A tick of the mirror with these commands."""
    return mirror.tick_with(given)


def refusals(outputs: TickOutputs) -> list[str]:
    return [event.refused or "" for event in outputs.events if isinstance(event, CommandTaken)]


def words(mirror: Mirror) -> list[str]:
    return [each.word for each in mirror.controller._context.locks]


def locked(*of: Lock, state: State = State.STANDBY) -> Mirror:
    mirror = in_state(state)
    give(mirror, *map(lock, of))
    return mirror


def test_a_lock_has_text_author_time_and_word_in_its_event() -> None:
    mirror = in_state(State.STANDBY)
    (event,) = [event for event in give(mirror, lock(ANN)).events if isinstance(event, LockSet)]
    assert {name: getattr(event, name) for name in asdict(ANN)} == asdict(ANN)


@pytest.mark.parametrize("state", State, ids=lambda state: state.name)
def test_in_every_state_a_lock_stops_the_pump_in_its_tick_permanently(state: State) -> None:
    mirror = in_state(state)
    assert give(mirror, lock(ANN)).command.pump_fraction == 0.0
    for kind in ("ack", "hold", "manual", "resume", "ack", "vent", "lower", "ack", "hold", "hold"):
        assert mirror.tick(kind).command.pump_fraction == 0.0
        assert words(mirror) == ["bofak"]
    assert mirror.controller.state in (State.STANDBY, State.LOWER, State.FAULT)


@pytest.mark.parametrize("kind", [kind for kind in TABLE if kind not in ("latch", "unlock")])
def test_no_other_command_removes_a_lock(kind: Kind) -> None:
    for state in (State.STANDBY, State.HOLD, State.FAULT):
        mirror = locked(ANN, BOB, state=state)
        mirror.tick(kind)
        mirror.tick(kind)
        assert words(mirror) == ["bofak", "gumil"]


@pytest.mark.parametrize("kind", ["hold", "manual", "tune", "resume"])
def test_commands_that_admit_gas_are_refused_with_the_fields_of_the_lock(kind: Kind) -> None:
    outputs = locked(ANN).tick(kind)
    (refused,) = refusals(outputs)
    for part in ("hands inside", "unix:ann", ANN.set_utc, "bofak", "unlock"):
        assert part in refused


def test_a_lock_set_during_a_fault_is_kept_after_its_ack() -> None:
    mirror = locked(ANN, state=State.FAULT)
    mirror.tick("ack")
    mirror.until(State.STANDBY)
    assert words(mirror) == ["bofak"]
    assert refusals(mirror.tick("hold")) != [""]
    assert mirror.controller.state == State.STANDBY


def test_a_pending_hold_does_not_begin_with_a_lock() -> None:
    mirror = in_state(State.STANDBY)
    mirror.controller._context.hold_wanted = True
    give(mirror, lock(ANN))
    mirror.controller._context.hold_wanted = True  # as the resume rule does
    for _ in range(5):
        assert mirror.tick().row.state == State.STANDBY


def test_two_locks_of_two_authors_need_two_unlocks() -> None:
    mirror = locked(ANN, BOB)
    (removed,) = [
        e for e in give(mirror, unlock(account="page:bob")).events if isinstance(e, LockRemoved)
    ]
    assert (removed.word, removed.author, removed.remover, removed.how) == (
        "gumil",
        "page:bob",
        "page:bob",
        "author",
    )
    assert words(mirror) == ["bofak"]
    assert refusals(mirror.tick("hold")) != [""]
    (removed,) = [
        e for e in give(mirror, unlock("BOFAK ", "page:bob")).events if isinstance(e, LockRemoved)
    ]
    assert (removed.word, removed.author, removed.remover, removed.how) == (
        "bofak",
        "unix:ann",
        "page:bob",
        "word",
    )
    assert words(mirror) == []
    assert refusals(mirror.tick("hold")) == [""]
    mirror.until(State.HOLD)


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        (unlock("wrong", "unix:ann"), "no lock has the word 'wrong'"),
        (unlock("", "unix:eve"), "none of the locks is set by the login of unix:eve"),
        (unlock(), "none of the locks is set by the login"),
        (unlock("bofak", from_person=False), "only a person"),
        (unlock("hands inside", "unix:eve"), "no lock has the word"),
    ],
)
def test_a_refused_unlock_changes_nothing_and_is_recorded(asked: Command, message: str) -> None:
    mirror = locked(ANN, LINK)
    outputs = give(mirror, asked)
    (event,) = [event for event in outputs.events if isinstance(event, CommandTaken)]
    assert message in (event.refused or "")
    assert event.text == (asked.text or None)
    assert words(mirror) == ["bofak", "tarep"]


def test_a_lock_without_a_login_has_no_author_and_is_removed_by_its_word() -> None:
    mirror = locked(LINK)
    assert refusals(give(mirror, unlock())) != [""]
    (removed,) = [e for e in give(mirror, unlock("tarep")).events if isinstance(e, LockRemoved)]
    assert removed.how == "word"


def test_an_author_of_two_locks_must_name_one() -> None:
    second = replace(ANN, word="dinof", text="still inside")
    mirror = locked(ANN, second)
    assert "several" in refusals(give(mirror, unlock(account="unix:ann")))[0]
    (removed,) = [
        e for e in give(mirror, unlock("dinof", "unix:ann")).events if isinstance(e, LockRemoved)
    ]
    assert removed.how == "author"
    assert words(mirror) == ["bofak"]


def test_without_a_lock_there_is_nothing_to_unlock() -> None:
    assert refusals(give(in_state(State.STANDBY), unlock("bofak", "unix:ann"))) == [
        "no lock is set"
    ]


def test_locks_of_people_are_never_merged_and_a_program_that_repeats_itself_sets_one() -> None:
    mirror = locked(replace(ANN, word=""), replace(ANN, word=""))
    assert len(set(words(mirror))) == 2
    for _ in range(3):
        door = Lock("", "door", "bridge:mqtt")
        give(mirror, Command("latch", "bridge:mqtt", text="door", lock=door, from_person=False))
    assert len(words(mirror)) == 3


def test_an_unlock_never_removes_a_lock_of_the_same_tick() -> None:
    for batch in itertools.permutations((lock(ANN), unlock("bofak", "unix:ann"))):
        mirror = in_state(State.STANDBY)
        give(mirror, *batch)
        assert words(mirror) == ["bofak"]


def test_the_number_of_locks_is_limited_except_those_of_earlier_runs() -> None:
    mirror = in_state(State.STANDBY)
    give(mirror, *(lock(replace(ANN, word="")) for _ in range(LOCKS_MOST)))
    assert "the most there may be" in refusals(give(mirror, lock(BOB)))[0]
    give(mirror, Command("latch", AT_START, text=BOB.text, lock=BOB))
    assert words(mirror)[-1] == "gumil"


def test_a_replay_of_the_recorded_inputs_decides_the_same() -> None:
    mirror, again = in_state(State.HOLD), in_state(State.HOLD)
    batches = [
        (lock(ANN), lock(BOB)),
        (unlock("wrong", "page:bob"),),
        (unlock("", "page:bob"),),
        (unlock("bofak"),),
    ]
    for batch in batches:
        mirror.ticks += 1
        inputs = mirror.inputs(batch)
        outputs = mirror.controller.tick(inputs)
        messages = pack_tick(mirror.ticks, inputs, outputs, outputs.row.pack())
        assert max(map(len, messages)) <= MESSAGE_BYTES
        taken = TickAssembler().add_messages(messages)
        (record,) = taken.records
        replayed = again.controller.tick(unpack_tick(record, taken.tails[mirror.ticks], {}))
        assert replayed.events == outputs.events
        assert again.controller._context.locks == mirror.controller._context.locks
    assert words(mirror) == []


def test_inputs_of_earlier_versions_have_neither_lock_nor_account() -> None:
    command = Command("latch", "unix:ann", text="hands inside")
    plain = {
        key: value
        for key, value in asdict(command).items()
        if key not in ("lock", "account", "from_person")
    }
    inputs = TickInputs(1.0, 0.1, None, commands=(command,))
    outputs = in_state(State.STANDBY).controller.tick(inputs)
    taken = TickAssembler().add_messages(pack_tick(1, inputs, outputs, outputs.row.pack()))
    tail = json.dumps({"commands": [plain], "dead_tasks": []}).encode()
    record = taken.records[0].copy()
    record["tail_bytes"] = len(tail)
    (found,) = unpack_tick(record, tail, {}).commands
    assert (found.kind, found.lock, found.account, found.from_person) == ("latch", None, "", True)


def test_the_locks_are_part_of_the_controllers_memory() -> None:
    mirror = locked(ANN, BOB)
    again = continue_from(take_snapshot(mirror.controller), CONFIG, zernike_projection())
    assert again.memory.context.locks == (ANN, BOB)


def test_the_status_has_the_locks_until_each_is_removed() -> None:
    mirror, status = in_state(State.STANDBY), RunStatus()
    for batch in ((lock(ANN), lock(BOB)), (unlock("bofak"),)):
        for event in give(mirror, *batch).events:
            status = status.after_event(event)
        assert status.locks == mirror.controller._context.locks
    assert status.locks == (BOB,)


def test_words_are_short_distinct_and_as_many_as_stated() -> None:
    some = {make_word(number) for number in range(WORDS)}
    assert len(some) == WORDS
    assert {len(word) for word in some} == {5}
    assert make_word(WORDS) == make_word(0)
    first = make_word(0)
    assert distinct_word("", ()) == first
    assert distinct_word("bofak", {"gumil"}) == "bofak"
    assert distinct_word("bofak", {"bofak", first}) == make_word(1)


def test_many_locks_are_counted_in_one_line() -> None:
    assert describe_locks((ANN, BOB, LINK), 2).endswith("; and 1 more")
    assert describe_locks(()) == ""


def test_the_author_is_known_by_the_account_alone() -> None:
    assert locks.is_author(unlock(account="unix:ann"), ANN)
    assert not locks.is_author(
        unlock(account="unix:ann"), replace(ANN, account="", author="unix:ann")
    )
    assert not locks.is_author(unlock(), LINK)
