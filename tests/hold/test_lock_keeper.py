"""The locks of a hold on disk: confirmed when synced, kept in memory when the disk is full, removed
singly.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from membrane_ctrl.config.schema import Config, DevicesConfig, StatesConfig
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.commands import AT_START
from membrane_ctrl.controller.tick import TickOutputs
from membrane_ctrl.hold import lock_keeper
from membrane_ctrl.hold.hold_options import HoldOptions
from membrane_ctrl.hold.lock_keeper import LockKeeper, LockStorage
from membrane_ctrl.hold.start_checks import BoardAtStart, find_locks
from membrane_ctrl.hold.tick_run import _send_first_commands
from membrane_ctrl.instruments.lock_keys import list_device_keys
from membrane_ctrl.instruments.lock_store import LockStore
from membrane_ctrl.model.errors import DeviceError
from membrane_ctrl.model.events import Event, LockRemoved, LockSet
from membrane_ctrl.model.lock import Lock
from membrane_ctrl.model.run_events import LockNotStored, LockStored

DEVICES = frozenset({"10.0.0.5 port 502 unit 1"})
SET = LockSet(
    "bofak", "hands inside", "unix:ann", "unix:ann", "process 7", "2026-01-02T03:04:05+00:00", 3
)
REMOVED = LockRemoved("bofak", "hands inside", "unix:ann", SET.set_utc, "page:bob", "word", 4)
BOARD = Config(devices=DevicesConfig(board="tcp://10.0.0.5:502"))


class Told:
    def __init__(self, *events: Event) -> None:
        self.events = events


def outputs(*events: Event) -> TickOutputs:
    return cast(TickOutputs, Told(*events))


@contextmanager
def keeper(
    folder: Path, recorded: list[Event], asked: list[Command] | None = None
) -> Iterator[LockKeeper]:
    store = LockStore([folder])
    storage = LockStorage(store, DEVICES, tuple(store.find_locks(DEVICES)))
    with LockKeeper(storage, recorded.append, [].append if asked is None else asked.append) as made:
        yield made


def outcome(kept: LockKeeper, number: int) -> str:
    future = kept.find_outcome(number)
    assert future is not None
    return future.result(5.0)


def words(folder: Path) -> list[str]:
    return [each.lock.word for each in LockStore([folder]).find_locks()]


def test_a_lock_or_its_removal_is_on_the_disk_before_its_outcome(
    tmp_path: Path,
) -> None:
    with keeper(tmp_path, []) as kept:
        kept.handle_tick(outputs(SET))
        assert outcome(kept, 3) == ""
        assert words(tmp_path) == ["bofak"]
        assert kept.find_outcome(3) is None
        assert kept.find_outcome(99) is None
        kept.handle_tick(outputs(REMOVED))
        assert outcome(kept, 4) == ""
    assert words(tmp_path) == []


def test_a_lock_of_an_earlier_run_is_not_stored_twice_and_is_removed_from_its_file(
    tmp_path: Path,
) -> None:
    LockStore([tmp_path]).write_lock(Lock("bofak", "hands inside", "unix:ann"), DEVICES)
    at_start = LockSet("bofak", "hands inside", "unix:ann", "", "", "", 0)
    with keeper(tmp_path, []) as kept:
        assert [lock.word for lock in kept.at_start] == ["bofak"]
        kept.handle_tick(outputs(at_start))
    assert words(tmp_path) == ["bofak"]
    with keeper(tmp_path, []) as kept:
        kept.handle_tick(outputs(at_start, REMOVED))
    assert words(tmp_path) == []


def full(*_: Any) -> None:
    raise OSError(28, "No space left on device")


def test_on_a_full_disk_the_outcome_states_it_and_the_lock_is_stored_once_there_is_space(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    events: list[Event] = []
    monkeypatch.setattr(lock_keeper, "_RETRY_S", 0.0)
    with keeper(tmp_path, events) as kept:
        with monkeypatch.context() as patch:
            patch.setattr(os, "fsync", full)
            kept.handle_tick(outputs(SET))
            assert "no space left" in outcome(kept, 3)
            kept.handle_tick(outputs())
            assert words(tmp_path) == []
        until(lambda: kept.handle_tick(outputs()), lambda: words(tmp_path) == ["bofak"])
    assert [type(event) for event in events] == [LockNotStored, LockStored]


def until(act: Callable[[], object], what: Callable[[], bool]) -> None:
    give_up_s = time.monotonic() + 10.0
    while not what():
        act()
        time.sleep(0.01)
        assert time.monotonic() < give_up_s


def test_a_lock_that_was_removed_before_there_was_room_is_not_stored_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with keeper(tmp_path, []) as kept:
        with monkeypatch.context() as patch:
            patch.setattr(os, "fsync", full)
            kept.handle_tick(outputs(SET))
            assert outcome(kept, 3) != ""
        kept.handle_tick(outputs(REMOVED))
        assert outcome(kept, 4) == ""
    assert words(tmp_path) == []


def test_a_removal_that_fails_is_tried_again_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with keeper(tmp_path, []) as kept:
        kept.handle_tick(outputs(SET))
        assert outcome(kept, 3) == ""
        with monkeypatch.context() as patch:
            patch.setattr(os, "unlink", full)
            kept.handle_tick(outputs(REMOVED))
            assert outcome(kept, 4) != ""
        assert words(tmp_path) == ["bofak"]
    assert words(tmp_path) == []


def test_a_lock_that_another_program_stores_becomes_a_command_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lock_keeper, "_CHECK_S", 0.0)
    asked: list[Command] = []
    other = LockStore([tmp_path])
    other.write_lock(Lock("tarep", "of an earlier run", "unix:ann"), DEVICES)
    with keeper(tmp_path, [], asked) as kept:
        kept.handle_tick(outputs(SET))
        assert outcome(kept, 3) == ""
        other.write_lock(
            Lock("gumil", "on another bench", "unix:bob"), {"10.0.0.6 port 502 unit 1"}
        )
        (tmp_path / "damaged.json").write_text("{")
        other.write_lock(Lock("bofak", "made safe by hand", "unix:bob"), DEVICES)
        until(lambda: kept.handle_tick(outputs()), lambda: bool(asked))
        for _ in range(20):
            kept.handle_tick(outputs())
            time.sleep(0.005)
        (command,) = asked
        assert (command.kind, command.text) == ("latch", "made safe by hand")
        lock = command.lock
        assert lock is not None
        assert lock.word not in ("bofak", "tarep")
        kept.handle_tick(outputs(LockSet(lock.word, lock.text, lock.author, "", "", "", 0)))
        kept.handle_tick(outputs(LockRemoved(lock.word, "", "", "", "page:bob", "word", 9)))
        assert outcome(kept, 9) == ""
    texts = [each.lock.text for each in other.find_locks(DEVICES) if each.devices]
    assert texts == ["of an earlier run", "hands inside"]


def test_the_twin_stores_nothing() -> None:
    with LockKeeper(None, lambda _: None) as kept:
        kept.handle_tick(outputs(SET, REMOVED))
        assert kept.find_outcome(3) is None
        assert kept.at_start == ()


def options(config: Config, **changes: Any) -> HoldOptions:
    given = {"twin": False, "clear_faults": False, "standby": False, "logs_dir": None} | changes
    return HoldOptions(
        config=config, source="lab.toml", duration_s=None, name="hold", json=False, **given
    )


@pytest.mark.parametrize("changes", [{}, {"clear_faults": True}, {"logs_dir": Path("elsewhere")}])
def test_a_hold_does_not_start_on_a_locked_device(changes: dict[str, Any]) -> None:
    assert find_locks(BOARD, options(BOARD, **changes)) is not None
    LockStore.of_machine().write_lock(
        Lock("bofak", "hands inside", "unix:ann"), list_device_keys(BOARD.devices or no())
    )
    with pytest.raises(DeviceError, match="hands inside"):
        find_locks(BOARD, options(BOARD, **changes))
    other = Config(devices=DevicesConfig(board="tcp://10.0.0.6:502"))
    assert find_locks(other, options(other, **changes)) is not None


def no() -> DevicesConfig:
    raise AssertionError


def test_in_standby_it_starts_with_the_locks() -> None:
    LockStore.of_machine().write_lock(
        Lock("bofak", "hands inside", "unix:ann"), list_device_keys(BOARD.devices or no())
    )
    storage = find_locks(BOARD, options(BOARD, standby=True))
    assert storage is not None
    assert [each.lock.word for each in storage.locks] == ["bofak"]


class Latch:
    """The latched fault of an earlier run."""

    latched_line, resumes_s = "over_pressure", ()


def test_a_run_in_standby_begins_with_its_locks_and_its_latched_fault_as_commands() -> None:
    asked: list[Command] = []
    supervisor, latch = cast(Any, SimpleNamespace(queue_command=asked.append)), cast(Any, Latch())
    lock = Lock("bofak", "hands inside", "unix:ann", "unix:ann")
    _send_first_commands(
        supervisor, True, latch, BoardAtStart(latched="the board has latched"), (lock,)
    )
    first, second = asked
    assert (first.kind, first.who, first.lock) == ("latch", AT_START, lock)
    assert (second.kind, second.who) == ("latched", AT_START)
    assert second.text == "over_pressure; the board has latched"


def test_the_twin_has_locks_of_earlier_runs_only_if_configured() -> None:
    assert find_locks(BOARD, options(BOARD, twin=True)) is None
    practice = BOARD.model_copy(update={"states": StatesConfig(latch_twin_faults=True)})
    storage = find_locks(practice, options(practice, twin=True))
    assert storage is not None
    storage.store.write_lock(Lock("bofak", "hands inside", "unix:ann"), storage.devices)
    with pytest.raises(DeviceError, match="hands inside"):
        find_locks(practice, options(practice, twin=True))
    assert find_locks(BOARD, options(BOARD)) is not None  # a twin's lock locks no bench
