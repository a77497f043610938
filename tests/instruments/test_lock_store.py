"""Locks on disk belong to devices; whatever cannot be read locks."""

from __future__ import annotations

import json
import os
from dataclasses import asdict
from pathlib import Path

import pytest

from membrane_ctrl.config.schema import DevicesConfig
from membrane_ctrl.instruments import lock_keys, lock_store
from membrane_ctrl.instruments.lock_keys import list_device_keys, modbus_keys
from membrane_ctrl.instruments.lock_store import LockStore, StoredLock, require_unlocked
from membrane_ctrl.model.errors import DeviceError
from membrane_ctrl.model.lock import Lock
from membrane_ctrl.model.program import program_identity, stated_program

ANN = Lock(
    "bofak", "hands inside", "unix:ann", "unix:ann", "process 7", "2026-01-02T03:04:05+00:00"
)
BOB = Lock("gumil", "lens off", "page:bob", "page:bob", "page 1f", "2026-01-02T03:05:05+00:00")
BENCH, OTHER = {"10.0.0.5 port 502 unit 1"}, {"10.0.0.6 port 502 unit 1"}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "state" / "locks"


@pytest.fixture
def store(folder: Path) -> LockStore:
    return LockStore([folder])


def found(store: LockStore, devices: set[str] | None = None) -> list[Lock]:
    return [each.lock for each in store.find_locks(devices)]


def test_a_lock_is_found_by_any_of_its_devices_and_by_no_other(store: LockStore) -> None:
    store.write_lock(ANN, BENCH | {"/dev/ttyUSB0"})
    assert found(store, BENCH) == found(store, {"/dev/ttyUSB0", "/dev/ttyUSB7"}) == [ANN]
    assert found(store, OTHER) == []
    assert found(store) == [ANN]


def test_locks_are_removed_singly(store: LockStore) -> None:
    first = store.write_lock(ANN, BENCH)
    store.write_lock(BOB, BENCH)
    store.remove_lock(first)
    store.remove_lock(first)
    assert found(store, BENCH) == [BOB]


def test_equal_words_are_replaced_by_distinct_ones(store: LockStore) -> None:
    store.write_lock(ANN, BENCH)
    store.write_lock(ANN, BENCH)
    assert len({lock.word for lock in found(store, BENCH)}) == 2


def test_a_file_states_the_program_that_wrote_it(store: LockStore) -> None:
    stated = json.loads(store.write_lock(ANN, BENCH).read_text())
    assert stated["schema"] == lock_store.SCHEMA
    assert stated_program(stated) == program_identity()


def test_without_a_folder_nothing_is_locked(store: LockStore) -> None:
    assert found(store) == []


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b"[]",
        b"null",
        b"\xff",
        b"[" * 5000,
        b" " * 20_000,
        json.dumps({"schema": "other", "devices": ["x"], **asdict(ANN)}).encode(),
        json.dumps({"schema": lock_store.SCHEMA, "devices": [], **asdict(ANN)}).encode(),
        json.dumps(
            {"schema": lock_store.SCHEMA, "devices": ["x"], **asdict(ANN), "word": ""}
        ).encode(),
        json.dumps(
            {"schema": lock_store.SCHEMA, "devices": ["x"], **asdict(ANN), "text": 3}
        ).encode(),
        json.dumps({"schema": lock_store.SCHEMA, "devices": ["x"], "word": "bofak"}).encode(),
    ],
)
def test_a_damaged_file_locks_every_device_and_can_be_removed_by_its_word(
    store: LockStore, content: bytes
) -> None:
    file = store.write_lock(ANN, BENCH)
    file.write_bytes(content)
    (lock,) = found(store, OTHER)
    assert str(file) in lock.text
    assert (lock.account, len(lock.word)) == ("", 5)
    assert found(store, OTHER) == [lock]  # the same word each time


def test_a_torn_file_at_every_length_locks(store: LockStore) -> None:
    file = store.write_lock(ANN, BENCH)
    whole = file.read_bytes()
    for length in range(len(whole) - 1):
        file.write_bytes(whole[:length])
        assert found(store, OTHER), length


def test_a_link_a_pipe_or_a_folder_in_a_files_place_locks(store: LockStore, folder: Path) -> None:
    folder.mkdir(parents=True)
    (folder / "a.json").symlink_to(folder / "nowhere")
    os.mkfifo(folder / "b.json")
    (folder / "c.json").mkdir()
    assert len(found(store, OTHER)) == 3


def test_an_unfinished_file_is_no_lock(store: LockStore, folder: Path) -> None:
    folder.mkdir(parents=True)
    (folder / ".20260101-bofak.json.part").write_text("{")
    assert found(store) == []


def test_a_folder_from_which_anybody_may_remove_locks_locks(store: LockStore, folder: Path) -> None:
    store.write_lock(ANN, BENCH)
    folder.chmod(0o777)
    (each,) = store.find_locks(OTHER)
    assert "chmod o-w" in each.lock.text
    assert each.file is None
    with pytest.raises(OSError, match="everybody may remove"):
        store.write_lock(BOB, BENCH)
    folder.chmod(0o1777)  # as /tmp: others cannot remove it
    assert found(store, BENCH) == [ANN]


def test_a_dangling_link_or_a_file_in_the_folders_place_locks(
    folder: Path, store: LockStore
) -> None:
    folder.parent.mkdir()
    folder.symlink_to(folder.parent / "nowhere")
    assert found(store)
    folder.unlink()
    folder.write_text("")
    assert found(store)


def test_a_folder_of_a_stranger_locks(
    store: LockStore, monkeypatch: pytest.MonkeyPatch, folder: Path
) -> None:
    store.write_lock(ANN, BENCH)
    if os.geteuid() != 0:
        pytest.skip("only root gives a folder away")
    os.chown(folder, 12345, -1)
    (lock,) = found(store, BENCH)
    assert "belongs to user 12345" in lock.text


def test_a_full_disk_leaves_no_half_lock(
    store: LockStore, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        store.write_lock(ANN, BENCH)
    assert list(folder.iterdir()) == []


def test_it_is_written_where_it_can_be_and_read_from_everywhere(tmp_path: Path) -> None:
    (tmp_path / "machine").write_text("")  # not writable, for anybody
    own, machine = tmp_path / "own", tmp_path / "other"
    LockStore([tmp_path / "machine" / "locks", own]).write_lock(ANN, BENCH)
    LockStore([machine]).write_lock(BOB, BENCH)
    assert found(LockStore([machine, own])) == [BOB, ANN]


def test_the_machines_folder_comes_first_and_the_variable_replaces_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv(lock_store.VARIABLE, str(tmp_path / "named"))
    monkeypatch.setattr(lock_store, "MACHINE_FOLDER", tmp_path / "machine")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "home"))
    for where in ("named", "machine", "home/membrane-ctrl/locks"):
        file = LockStore.of_machine().write_lock(ANN, BENCH)
        assert file.parent == tmp_path / where
        monkeypatch.delenv(lock_store.VARIABLE, raising=False)
        if where == "machine":
            file.unlink()
            file.parent.rmdir()
            monkeypatch.setattr(lock_store, "MACHINE_FOLDER", Path("/proc/nowhere/locks"))


def test_other_users_read_a_lock_whatever_the_umask(store: LockStore) -> None:
    before = os.umask(0o077)
    try:
        file = store.write_lock(ANN, BENCH)
    finally:
        os.umask(before)
    assert file.stat().st_mode & 0o777 == 0o644


def test_a_device_is_known_by_every_name_it_may_get(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert modbus_keys("tcp://LOCALHOST:5020", 1) & modbus_keys("tcp://127.0.0.1:5020", 1)
    assert not modbus_keys("tcp://127.0.0.1:5020", 2) & modbus_keys("tcp://127.0.0.1:5020", 1)
    board = DevicesConfig(board="tcp://127.0.0.1:5020")
    assert list_device_keys(board) == modbus_keys("tcp://127.0.0.1:5020", 1)
    by_id = tmp_path / "by-id"
    by_id.mkdir()
    (tmp_path / "ttyUSB0").write_text("")
    (by_id / "usb-ACME_123").symlink_to(tmp_path / "ttyUSB0")
    monkeypatch.setattr(lock_keys, "_BY_ID", by_id)
    before = modbus_keys(f"rtu://{tmp_path}/ttyUSB0?baud=115200", 1)
    (by_id / "usb-ACME_123").unlink()
    (tmp_path / "ttyUSB1").write_text("")
    (by_id / "usb-ACME_123").symlink_to(tmp_path / "ttyUSB1")  # plugged in again
    assert before & modbus_keys(f"rtu://{by_id}/usb-ACME_123", 1)


def test_single_instruments_are_each_locked() -> None:
    roles = {
        "displacement": {"driver": "optoncdt1420", "port": "/dev/laser"},
        "pump": {"driver": "ventus", "port": "/dev/pump"},
        "gauge_pressure": {"driver": "bronkhorst_propar", "port": "/dev/gauge"},
    }
    assert {"/dev/laser", "/dev/pump", "/dev/gauge"} <= list_device_keys(
        DevicesConfig.model_validate(roles)
    )


def test_the_refusal_is_one_line_with_everything_that_a_person_needs(store: LockStore) -> None:
    require_unlocked(store, BENCH)
    store.write_lock(ANN, BENCH)
    store.write_lock(BOB, BENCH)
    require_unlocked(store, OTHER)
    with pytest.raises(DeviceError) as refused:
        require_unlocked(store, BENCH)
    (line,) = refused.value.lines
    for part in (
        "hands inside",
        "unix:ann",
        ANN.set_utc,
        "bofak",
        "lens off",
        "gumil",
        "locks remove WORD",
    ):
        assert part in line
    assert refused.value.exit == 4


def test_a_stored_lock_of_unknown_devices_counts_for_all() -> None:
    assert StoredLock(ANN, None).devices == frozenset()
