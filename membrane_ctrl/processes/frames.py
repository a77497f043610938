"""Camera frames in shared memory: pixels are written in place by the camera and read by whoever wants them.

The same idea as `membrane_ctrl.processes.ring`, for messages too big to copy on every write: one writer that never
waits, a slot with its sequence number before and after the pixels. The number in front changes before the
camera touches the pixels, the one behind when the frame is whole; a reader keeps a copy only if both were the
expected one, the one behind before copying and the one in front after it.
"""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass
from math import prod
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path

import numpy as np

from firmware_iface.roles import Pixels
from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.processes.ring import FrameAddress

_ALIGN_BYTES = 64  # a cache line: pixels start on one, and the write counter has one of its own
_HEAD = struct.Struct("<QddQ24s")  # sequence, time_s, displacement_um, cycle, pattern name in ASCII
_SHARED_MEMORY_FOLDER = Path("/dev/shm")


@dataclass(frozen=True, slots=True)
class FrameHead:
    """What is known of a stored frame.

    Attributes
    ----------
    index : int
        Count of the frames stored before it in the run; names the frame to `FrameReader.copy`.
    pattern : str
        What the screen showed (`firmware_iface.roles.Pattern.name`).
    time_s : float
        Start of exposure on the run's clock.
    displacement_um : float
        Laser reading then, as far as it was known when the frame arrived; NaN if not.
    cycle : int
        Number of the measurement cycle.
    """

    index: int
    pattern: str
    time_s: float
    displacement_um: float
    cycle: int


class FrameRing:
    """Owns the shared memory; create it in the process that outlives writer and readers.

    Parameters
    ----------
    slots : int
        Frames kept: a full cycle plus the one being taken.
    height_px, width_px : int
        Size of a frame.
    dtype : str
        "uint8" or "uint16".

    Raises
    ------
    OSError
        If the machine's shared memory has no room. It is reserved here: memory that is only promised would end
        the writing process with SIGBUS at its first frame.
    """

    def __init__(self, slots: int, height_px: int, width_px: int, dtype: str = "uint8") -> None:
        self.address = FrameAddress("", slots, height_px, width_px, dtype)
        size_bytes = _ALIGN_BYTES + slots * _stride(self.address)
        self._memory = SharedMemory(create=True, size=size_bytes)
        self.address = FrameAddress(self._memory.name, slots, height_px, width_px, dtype)
        try:
            _reserve(self._memory.name, size_bytes)
        except OSError as error:
            self.close()
            raise OSError(
                error.errno,
                f"no shared memory for {slots} camera frames ({size_bytes / 1e6:.0f} MB): "
                f"enlarge {_SHARED_MEMORY_FOLDER} or use a smaller [optics.camera]",
            ) from error

    @classmethod
    def for_optics(cls, optics: OpticsConfig, kept_cycles: int = 1) -> FrameRing:
        """A ring for the frames of one full cycle (2 x (N sinusoids + 4 Gray) + white + black) and one more.

        Larger if `kept_cycles` cycles of 2 N sinusoids need it.
        """
        camera = optics.camera
        slots = max(2 * (optics.pattern.steps + 4) + 2, kept_cycles * 2 * optics.pattern.steps) + 1
        return cls(slots, camera.height_px, camera.width_px, "uint8" if camera.bits == 8 else "uint16")

    def close(self) -> None:
        """Give the memory back; who is still attached keeps it."""
        self._memory.close()
        self._memory.unlink()


class FrameSlot:
    """A frame being taken: let the camera write into `pixels`, then `commit` it."""

    def __init__(self, writer: FrameWriter, pixels: Pixels) -> None:
        self._writer = writer
        self.pixels = pixels

    def commit(self, pattern: str, time_s: float, displacement_um: float, cycle: int) -> None:
        """Make the frame visible to readers."""
        self._writer._commit(pattern, time_s, displacement_um, cycle)


class FrameWriter:
    """The one writer. A frame's pixels stay as they are until `slots` more frames were begun."""

    def __init__(self, address: FrameAddress) -> None:
        self._memory = SharedMemory(address.name)
        self._slots = _Slots(self._memory, address)
        self._next = self._slots.written()

    def begin(self) -> FrameSlot:
        """The oldest slot, to be written over; a slot that was begun and not committed is begun again."""
        self._slots.set_before(self._next)
        return FrameSlot(self, self._slots.pixels(self._next))

    def _commit(self, pattern: str, time_s: float, displacement_um: float, cycle: int) -> None:
        self._slots.set_head(FrameHead(self._next, pattern, time_s, displacement_um, cycle))
        self._slots.set_after(self._next)
        self._next += 1
        self._slots.set_written(self._next)

    def close(self) -> None:
        """Detach. Raises BufferError while someone still holds the pixels of a slot."""
        self._slots.release()
        self._memory.close()


class FrameReader:
    """One of any number of readers; it never holds the writer up."""

    def __init__(self, address: FrameAddress) -> None:
        self._memory = SharedMemory(address.name)
        self._slots = _Slots(self._memory, address)
        self._count = address.slots

    def heads(self) -> list[FrameHead]:
        """Heads of all whole frames in the ring, oldest first."""
        written = self._slots.written()
        heads = (self._slots.head(index) for index in range(max(0, written - self._count), written))
        return [head for head in heads if head is not None]

    def copy(self, head: FrameHead, step: int = 1) -> Pixels | None:
        """Copy of a frame's pixels, every `step`-th in both directions.

        Returns
        -------
        (H // step, W // step) array or None
            None if the writer has come round to this slot meanwhile.
        """
        slots = self._slots
        if slots.after(head.index) != head.index + 1:
            return None
        pixels = slots.pixels(head.index)[::step, ::step].copy()
        return pixels if slots.before(head.index) == head.index + 1 else None

    def close(self) -> None:
        """Detach."""
        self._slots.release()
        self._memory.close()


class _Slots:
    """The layout: write counter; then for each slot a head with the sequence number, pixels, and the number again."""

    def __init__(self, memory: SharedMemory, address: FrameAddress) -> None:
        assert memory.buf is not None  # None only after close()
        self._buffer = memory.buf
        self._words = memory.buf.cast("Q")  # each assignment is one store (`membrane_ctrl.processes.ring`)
        self._stride = _stride(address)
        shape = (address.height_px, address.width_px)
        # frombuffer keeps hold of the memory, so that closing under a living view raises; ndarray(buffer=...)
        # would let it be unmapped, and the next look at a pixel would end the process
        self._pixels: list[Pixels] = [
            np.frombuffer(memory.buf, address.dtype, prod(shape), _ALIGN_BYTES * 2 + k * self._stride).reshape(shape)
            for k in range(address.slots)
        ]

    def pixels(self, index: int) -> Pixels:
        return self._pixels[index % len(self._pixels)]

    def head(self, index: int) -> FrameHead | None:
        fields = _HEAD.unpack_from(self._buffer, self._start(index))
        sequence, time_s, displacement_um, cycle, pattern = fields
        if not sequence == self.after(index) == self.before(index) == index + 1:
            return None
        return FrameHead(index, pattern.rstrip(b"\0").decode("ascii"), time_s, displacement_um, cycle)

    def set_head(self, head: FrameHead) -> None:
        pattern = head.pattern.encode("ascii")
        fields = (head.index + 1, head.time_s, head.displacement_um, head.cycle, pattern)
        _HEAD.pack_into(self._buffer, self._start(head.index), *fields)

    def before(self, index: int) -> int:
        return self._words[self._start(index) // 8]

    def set_before(self, index: int) -> None:
        self._words[self._start(index) // 8] = index + 1

    def after(self, index: int) -> int:
        return self._words[(self._start(index) + self._stride) // 8 - 1]

    def set_after(self, index: int) -> None:
        self._words[(self._start(index) + self._stride) // 8 - 1] = index + 1

    def written(self) -> int:
        return self._words[0]

    def set_written(self, count: int) -> None:
        self._words[0] = count

    def release(self) -> None:
        self._pixels.clear()
        self._words.release()

    def _start(self, index: int) -> int:
        return _ALIGN_BYTES + (index % len(self._pixels)) * self._stride


def _stride(address: FrameAddress) -> int:
    pixel_bytes = prod((address.height_px, address.width_px, np.dtype(address.dtype).itemsize))
    return _ALIGN_BYTES + (pixel_bytes + 8 + _ALIGN_BYTES - 1) // _ALIGN_BYTES * _ALIGN_BYTES


def _reserve(name: str, size_bytes: int) -> None:
    path = _SHARED_MEMORY_FOLDER / name.lstrip("/")
    if not path.exists():  # another system than Linux: its shared memory is not a folder
        return
    handle = os.open(path, os.O_RDWR)
    try:
        os.posix_fallocate(handle, 0, size_bytes)
    finally:
        os.close(handle)
