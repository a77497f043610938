"""A session reads the rings that a run has published, and opens nothing else that a run folder
names.
"""

from __future__ import annotations

import json
import os
import random
from collections.abc import Iterator
from contextlib import ExitStack
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path

import pytest

from membrane_ctrl.processes.published_rings import (
    attach_rings,
    is_control_alive,
    publish_rings,
)
from membrane_ctrl.processes.ring import RingAddress, RingError, RingWriter, open_ring


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as found:
        yield found


@pytest.fixture
def address() -> Iterator[RingAddress]:
    with open_ring(4, 16) as found:
        yield found


def test_a_session_reads_on_from_the_newest_message(
    tmp_path: Path, stack: ExitStack, address: RingAddress
) -> None:
    writer = RingWriter(address)
    writer.put(b"before")
    publish_rings(tmp_path, {"telemetry": address, "shapes": None}, stack)
    readers = attach_rings(tmp_path)
    writer.put(b"after")
    assert {name: reader.drain() for name, reader in readers.items()} == {"telemetry": [b"after"]}
    readers["telemetry"].close()
    writer.close()


def test_events_are_read_from_the_oldest_on_where_that_is_wanted(
    tmp_path: Path, address: RingAddress, stack: ExitStack
) -> None:
    writer = RingWriter(address)
    writer.put(b"before")
    publish_rings(tmp_path, {"telemetry": address, "events": address}, stack)
    readers = attach_rings(tmp_path, whole=("events",))
    found = {name: reader.drain() for name, reader in readers.items()}
    assert found == {"telemetry": [], "events": [b"before"]}
    for reader in readers.values():
        reader.close()
    writer.close()


def test_a_control_process_is_alive_until_it_lets_go(tmp_path: Path, address: RingAddress) -> None:
    with pytest.raises(FileNotFoundError):
        is_control_alive(tmp_path)
    with ExitStack() as process:
        publish_rings(tmp_path, {"telemetry": address}, process)
        assert is_control_alive(tmp_path)
        assert is_control_alive(tmp_path), "asking changes nothing"
    assert not is_control_alive(tmp_path)


def test_a_reader_cannot_write(tmp_path: Path, stack: ExitStack, address: RingAddress) -> None:
    publish_rings(tmp_path, {"telemetry": address}, stack)
    reader = attach_rings(tmp_path)["telemetry"]
    with pytest.raises(TypeError, match="read-only"):
        reader._slots.words[0] = 1
    reader.close()


def named(folder: Path, **values: object) -> None:
    (folder / "rings.json").write_text(json.dumps({"telemetry": values}))


@pytest.mark.parametrize(
    "changed",
    [
        {"name": "../../etc/passwd"},
        {"name": "psm_00000000/../../../etc/passwd"},
        {"name": "sem.something"},
        {"name": 5},
        {"slots": 5},
        {"slots": 0},
        {"slots": -4},
        {"slots": 10**12},
        {"slots": 4.0},
        {"slots": True},
        {"slot_bytes": 15},
        {"slot_bytes": -1},
        {"slot_bytes": 2**63},
        {"slot_bytes": "16"},
        {"slot_bytes": None},
    ],
)
def test_another_address_is_refused_in_one_line(
    tmp_path: Path, address: RingAddress, changed: dict[str, object]
) -> None:
    named(tmp_path, **{"name": address.name, "slots": 4, "slot_bytes": 16} | changed)
    with pytest.raises(RingError) as refused:
        attach_rings(tmp_path)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "text",
    [b"", b"[]", b"5", b"\xff", b"[" * 4000, b'{"telemetry": 5}', b'{"a": {}}', b" " * 10_000_000],
)
def test_a_damaged_file_is_refused(tmp_path: Path, text: bytes) -> None:
    (tmp_path / "rings.json").write_bytes(text)
    with pytest.raises((RingError, OSError)):
        attach_rings(tmp_path)


def test_a_pipe_in_place_of_the_file_blocks_no_reader(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "rings.json")
    with pytest.raises(OSError, match="plain file"):
        attach_rings(tmp_path)


def test_a_link_in_place_of_the_file_is_not_followed(
    tmp_path: Path, stack: ExitStack, address: RingAddress
) -> None:
    publish_rings(tmp_path, {"telemetry": address}, stack)
    (tmp_path / "rings.json").rename(tmp_path / "other.json")
    (tmp_path / "rings.json").symlink_to("other.json")
    with pytest.raises(OSError, match=r"rings\.json"):
        attach_rings(tmp_path)


def test_shared_memory_of_another_user_is_refused(
    tmp_path: Path,
    stack: ExitStack,
    address: RingAddress,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    publish_rings(tmp_path, {"telemetry": address}, stack)
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    with pytest.raises(RingError, match=f"belongs to user {os.getuid()}"):
        attach_rings(tmp_path)


def test_shared_memory_of_another_size_is_refused(tmp_path: Path) -> None:
    with open_ring(8, 16) as larger:
        named(tmp_path, name=larger.name, slots=4, slot_bytes=16)
        with pytest.raises(RingError, match="bytes, not the"):
            attach_rings(tmp_path)


def test_shared_memory_that_is_no_ring_is_refused(tmp_path: Path) -> None:
    memory = SharedMemory(create=True, size=RingAddress("", 4, 16).size_bytes)
    try:
        memory.buf[:] = random.Random(1).randbytes(len(memory.buf))
        named(tmp_path, name=memory.name, slots=4, slot_bytes=16)
        with pytest.raises(RingError, match="not the expected ring"):
            attach_rings(tmp_path)
    finally:
        memory.close()
        memory.unlink()


def test_a_run_that_is_over_has_none(tmp_path: Path, stack: ExitStack) -> None:
    with open_ring(4, 16) as address:
        publish_rings(tmp_path, {"telemetry": address}, stack)
    with pytest.raises(FileNotFoundError):
        attach_rings(tmp_path)
