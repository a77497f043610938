"""Camera frames in shared memory: the camera writes the pixels in place, any number of readers copy
them.

As in `membrane_ctrl.processes.ring`, one writer never waits, and each slot has its sequence number
before and after the pixels. The first number changes before the camera touches the pixels, the
second when the frame is whole; a reader keeps a copy only if the second was correct before copying
and the first afterwards.
"""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass
from math import prod
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path

import numpy as np

from firmware_iface.optical_roles import Pixels
from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.processes.frame_address import FrameAddress

_ALIGN_BYTES = 64  # a cache line: pixels start on one, and the write counter has one of its own
_HEAD = struct.Struct("<QddQ24s")  # sequence, time_s, displacement_um, cycle, pattern name in ASCII
_SHARED_MEMORY_FOLDER = Path("/dev/shm")


@dataclass(frozen=True, slots=True)
class FrameHead:
    """Description of a stored frame."""

    # number of frames stored earlier in the run; identifies the frame for `FrameReader.copy`
    index: int
    pattern: str  # pattern on the screen (`firmware_iface.optical_roles.Pattern.name`)
    time_s: float  # start of exposure on the run's clock
    displacement_um: float  # laser reading then, if known when the frame arrived; else NaN
    cycle: int  # number of the measurement cycle


class FrameRing:
    """Owns the shared memory of the last `slots` frames; create it in the process that outlives
    writer and readers.

    Raises OSError without room in shared memory. Reserves the memory, as otherwise SIGBUS could
    kill the writer.
    """

    def __init__(self, slots: int, height_px: int, width_px: int, dtype: str = "uint8") -> None:
        self.address = FrameAddress("", slots, height_px, width_px, dtype)
        size_bytes = _ALIGN_BYTES + slots * _slot_bytes(self.address)
        self._memory = SharedMemory(create=True, size=size_bytes)
        self.address = FrameAddress(self._memory.name, slots, height_px, width_px, dtype)
        try:
            _reserve_memory(self._memory.name, size_bytes)
        except OSError as error:
            self.close()
            raise OSError(
                error.errno,
                f"no shared memory for {slots} camera frames ({size_bytes / 1e6:.0f} MB): "
                f"enlarge {_SHARED_MEMORY_FOLDER} or use a smaller [optics.camera]",
            ) from error

    @classmethod
    def for_optics(cls, optics: OpticsConfig, kept_cycles: int = 1) -> FrameRing:
        """Make a ring that keeps a full cycle (2 x (N sinusoids + 4 Gray) + white + black) and one
        frame more.

        Parameters
        ----------
        optics : OpticsConfig
            Camera and pattern.
        kept_cycles : int
            Cycles of fringes to keep, if that is more.
        """
        camera = optics.camera
        slots = max(2 * (optics.pattern.steps + 4) + 2, kept_cycles * 2 * optics.pattern.steps) + 1
        return cls(
            slots, camera.height_px, camera.width_px, "uint8" if camera.bits == 8 else "uint16"
        )

    def close(self) -> None:
        """Free the memory; attached processes keep theirs."""
        self._memory.close()
        self._memory.unlink()


class FrameSlot:
    """A frame being taken: let the camera write into `pixels`, then call `commit`."""

    def __init__(self, writer: FrameWriter, pixels: Pixels) -> None:
        self._writer = writer
        self.pixels = pixels

    def commit(self, pattern: str, time_s: float, displacement_um: float, cycle: int) -> None:
        """Make the frame visible to readers.

        Parameters
        ----------
        pattern : str
            Name of the pattern that it shows.
        time_s : float
            Middle of its exposure.
        displacement_um : float
            Laser reading then; NaN without.
        cycle : int
            Number of the cycle that it belongs to.
        """
        self._writer._commit_frame(pattern, time_s, displacement_um, cycle)


class FrameWriter:
    """The only writer. A frame's pixels stay unchanged until `slots` more frames have begun."""

    def __init__(self, address: FrameAddress) -> None:
        self._memory = SharedMemory(address.name)
        self._slots = _FrameSlots(self._memory, address)
        self._next = self._slots.written()

    def begin(self) -> FrameSlot:
        """Return the oldest slot for overwriting; an uncommitted slot is reused."""
        self._slots.set_before(self._next)
        return FrameSlot(self, self._slots.pixels(self._next))

    def _commit_frame(
        self, pattern: str, time_s: float, displacement_um: float, cycle: int
    ) -> None:
        self._slots.set_head(FrameHead(self._next, pattern, time_s, displacement_um, cycle))
        self._slots.set_after(self._next)
        self._next += 1
        self._slots.set_written(self._next)

    def close(self) -> None:
        """Detach. Raises BufferError while the pixels of a slot are in use."""
        self._slots.release()
        self._memory.close()


class FrameReader:
    """One of any number of readers; the writer never waits for it."""

    def __init__(self, address: FrameAddress) -> None:
        self._memory = SharedMemory(address.name)
        self._slots = _FrameSlots(self._memory, address)
        self._count = address.slots

    def heads(self) -> list[FrameHead]:
        """Heads of all whole frames in the ring, oldest first."""
        written = self._slots.written()
        heads = (self._slots.head(index) for index in range(max(0, written - self._count), written))
        return [head for head in heads if head is not None]

    def copy(self, head: FrameHead, step: int = 1) -> Pixels | None:
        """Copy the pixels of a frame.

        Parameters
        ----------
        head : FrameHead
            The frame.
        step : int
            Every `step`-th pixel in both directions.

        Returns
        -------
        (rows, columns) array or None
            None once the frame has been overwritten.
        """
        # The number behind the pixels before the copy, that before them afterwards: as in a ring
        slots = self._slots
        if slots.after(head.index) != head.index + 1:
            return None
        pixels = slots.pixels(head.index)[::step, ::step].copy()
        if slots.before(head.index) == head.index + 1:
            return pixels
        return None

    def close(self) -> None:
        """Detach."""
        self._slots.release()
        self._memory.close()


class _FrameSlots:
    """The layout: write counter; for each slot a head with the sequence number, the pixels, the
    number again.
    """

    def __init__(self, memory: SharedMemory, address: FrameAddress) -> None:
        assert memory.buf is not None  # None only after close()
        self._buffer = memory.buf
        # each assignment is one store (`membrane_ctrl.processes.ring`)
        self._words = memory.buf.cast("Q")
        self._stride = _slot_bytes(address)
        shape = (address.height_px, address.width_px)
        # frombuffer holds the memory, so that closing it under a live view raises;
        # ndarray(buffer=...) would let it be unmapped, and the next access to a pixel would crash
        # the process
        self._pixels: list[Pixels] = [
            np.frombuffer(
                memory.buf, address.dtype, prod(shape), _ALIGN_BYTES * 2 + k * self._stride
            ).reshape(shape)
            for k in range(address.slots)
        ]

    def pixels(self, index: int) -> Pixels:
        return self._pixels[index % len(self._pixels)]

    def head(self, index: int) -> FrameHead | None:
        fields = _HEAD.unpack_from(self._buffer, self._slot_offset(index))
        sequence, time_s, displacement_um, cycle, pattern = fields
        if not sequence == self.after(index) == self.before(index) == index + 1:
            return None
        return FrameHead(
            index, pattern.rstrip(b"\0").decode("ascii"), time_s, displacement_um, cycle
        )

    def set_head(self, head: FrameHead) -> None:
        pattern = head.pattern.encode("ascii")
        fields = (head.index + 1, head.time_s, head.displacement_um, head.cycle, pattern)
        _HEAD.pack_into(self._buffer, self._slot_offset(head.index), *fields)

    def before(self, index: int) -> int:
        return self._words[self._slot_offset(index) // 8]

    def set_before(self, index: int) -> None:
        self._words[self._slot_offset(index) // 8] = index + 1

    def after(self, index: int) -> int:
        return self._words[(self._slot_offset(index) + self._stride) // 8 - 1]

    def set_after(self, index: int) -> None:
        self._words[(self._slot_offset(index) + self._stride) // 8 - 1] = index + 1

    def written(self) -> int:
        return self._words[0]

    def set_written(self, count: int) -> None:
        self._words[0] = count

    def release(self) -> None:
        self._pixels.clear()
        self._words.release()

    def _slot_offset(self, index: int) -> int:
        return _ALIGN_BYTES + (index % len(self._pixels)) * self._stride


def _slot_bytes(address: FrameAddress) -> int:
    pixel_bytes = prod((address.height_px, address.width_px, np.dtype(address.dtype).itemsize))
    return _ALIGN_BYTES + (pixel_bytes + 8 + _ALIGN_BYTES - 1) // _ALIGN_BYTES * _ALIGN_BYTES


def _reserve_memory(name: str, size_bytes: int) -> None:
    path = _SHARED_MEMORY_FOLDER / name.lstrip("/")
    if not path.exists():  # not Linux: shared memory is not a folder there
        return
    handle = os.open(path, os.O_RDWR)
    try:
        os.posix_fallocate(handle, 0, size_bytes)
    finally:
        os.close(handle)
