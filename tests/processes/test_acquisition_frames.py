"""Frames in shared memory: whole or not at all."""

from __future__ import annotations

import errno
import math
import os
import pickle
from collections.abc import Iterator
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path

import numpy as np
import pytest

from membrane_ctrl.config.schema import CameraConfig, OpticsConfig, PatternConfig
from membrane_ctrl.processes.frame_address import FrameAddress
from membrane_ctrl.processes.frames import FrameReader, FrameRing, FrameWriter

SLOTS = 3


@pytest.fixture
def address() -> Iterator[FrameAddress]:
    owner = FrameRing(SLOTS, 5, 7)
    yield owner.address
    owner.close()


@pytest.fixture
def writer(address: FrameAddress) -> Iterator[FrameWriter]:
    writer = FrameWriter(address)
    yield writer
    writer.close()


@pytest.fixture
def reader(address: FrameAddress) -> Iterator[FrameReader]:
    reader = FrameReader(address)
    yield reader
    reader.close()


def put(writer: FrameWriter, level: int) -> None:
    slot = writer.begin()
    slot.pixels[...] = level
    slot.commit(f"x_sin_{level}", level * 0.5, level * 2.0, level)


def test_frames_come_back_with_their_heads(writer: FrameWriter, reader: FrameReader) -> None:
    assert reader.heads() == []
    for level in range(2):
        put(writer, level)
    heads = reader.heads()
    assert [(h.index, h.pattern, h.time_s, h.displacement_um, h.cycle) for h in heads] == [
        (0, "x_sin_0", 0.0, 0.0, 0),
        (1, "x_sin_1", 0.5, 2.0, 1),
    ]
    for head in heads:
        pixels = reader.copy(head)
        assert pixels is not None
        assert pixels.shape == (5, 7)
        assert (pixels == head.index).all()


def test_oldest_frame_is_written_over(writer: FrameWriter, reader: FrameReader) -> None:
    for level in range(SLOTS):
        put(writer, level)
    oldest = reader.heads()[0]
    put(writer, SLOTS)
    assert [head.index for head in reader.heads()] == [1, 2, 3]
    assert reader.copy(oldest) is None


def test_frame_being_taken_hides_the_one_it_overwrites_and_nothing_else(
    writer: FrameWriter, reader: FrameReader
) -> None:
    for level in range(SLOTS):
        put(writer, level)
    oldest, *rest = reader.heads()
    writer.begin()
    assert reader.copy(oldest) is None
    assert reader.heads() == rest


def test_frame_begun_and_given_up_is_never_seen(writer: FrameWriter, reader: FrameReader) -> None:
    writer.begin().pixels[...] = 99
    assert reader.heads() == []
    put(writer, 1)
    (head,) = reader.heads()
    pixels = reader.copy(head)
    assert pixels is not None
    assert (pixels == 1).all()


def test_frame_overwritten_while_it_is_copied_is_refused(
    writer: FrameWriter, reader: FrameReader, monkeypatch: pytest.MonkeyPatch
) -> None:
    put(writer, 0)
    (head,) = reader.heads()
    pixels_of = reader._slots.pixels

    def overtaken(index: int) -> np.ndarray:
        for level in range(1, SLOTS + 1):
            put(writer, level)
        return pixels_of(index)

    monkeypatch.setattr(reader._slots, "pixels", overtaken)
    assert reader.copy(head) is None


def test_thumbnail_takes_every_step_th_pixel(writer: FrameWriter, reader: FrameReader) -> None:
    slot = writer.begin()
    slot.pixels[...] = np.arange(35, dtype=np.uint8).reshape(5, 7)
    slot.commit("white", 0.0, math.nan, 1)
    (head,) = reader.heads()
    assert math.isnan(head.displacement_um)
    thumbnail = reader.copy(head, step=3)
    assert thumbnail is not None
    np.testing.assert_array_equal(thumbnail, [[0, 3, 6], [21, 24, 27]])


def test_a_new_writer_continues_where_the_last_ended(
    address: FrameAddress, writer: FrameWriter, reader: FrameReader
) -> None:
    put(writer, 0)
    second = FrameWriter(address)
    put(second, 1)
    second.close()
    assert [head.index for head in reader.heads()] == [0, 1]


def test_ring_for_optics_holds_a_full_cycle_and_one_more() -> None:
    camera = CameraConfig(width_px=10, height_px=8, bits=12)
    owner = FrameRing.for_optics(OpticsConfig(camera=camera, pattern=PatternConfig(steps=5)))
    try:
        address = pickle.loads(pickle.dumps(owner.address))
        assert address == owner.address
        assert (address.slots, address.height_px, address.width_px) == (21, 8, 10)
        writer = FrameWriter(address)
        assert writer.begin().pixels.dtype == np.uint16
        writer.close()
    finally:
        owner.close()


def test_full_shared_memory_is_reported_and_leaves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    names: list[str] = []

    def no_room(handle: int, offset: int, size_bytes: int) -> None:
        names.append(Path(f"/proc/self/fd/{handle}").readlink().name)
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", no_room)
    with pytest.raises(OSError, match="no shared memory for 19 camera frames") as caught:
        FrameRing(19, 2048, 2448)
    assert caught.value.errno == errno.ENOSPC
    with pytest.raises(FileNotFoundError):
        SharedMemory(names[0])


def test_pixels_held_too_long_are_detected(address: FrameAddress) -> None:
    writer = FrameWriter(address)
    slot = writer.begin()
    with pytest.raises(BufferError):
        writer.close()
    del slot
    writer.close()
