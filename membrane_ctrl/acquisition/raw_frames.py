"""Whole frames on disk: of every n-th cycle, and of the last cycles before a fault, as capture sets to measure again.

`raw/cycle-000017/` in the run's folder is a set like any other (docs/interfaces.md section 3). A set of fringes only
refers to the full cycle that anchors it, so that the newest accepted full cycle is kept too, until the next one
replaces it or something refers to it.
"""

from __future__ import annotations

import shutil
import struct
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import tomli_w

from firmware_iface.roles import Pattern
from membrane_ctrl.acquisition.cycle import CyclePlan
from membrane_ctrl.acquisition.frame_address import FrameAddress
from membrane_ctrl.acquisition.frames import FrameHead, FrameReader, Pixels
from membrane_ctrl.config import OpticsConfig, RecordingConfig
from membrane_ctrl.estimate import ShapeEstimate
from membrane_ctrl.ipc.ring import RingAddress, RingReader
from membrane_ctrl.telemetry import FIELDS

_ROW = struct.Struct(f"<{len(FIELDS)}d")
_FAULT = FIELDS.index("fault")
# A disk that is slower than the cycles: what would wait longer than for these sets is left out
_WAITING_SETS = 3
_FASTEST = [cv2.IMWRITE_PNG_COMPRESSION, 1]  # a noisy frame hardly shrinks any further


@dataclass(frozen=True, slots=True)
class _Set:
    kind: str
    heads: tuple[FrameHead, ...]
    pixels: tuple[Pixels, ...]


class RawFrames:
    """Keeps frames.

    Parameters
    ----------
    folder : Path
        `raw` of the run's folder; made when the first set is kept.
    optics : OpticsConfig
        For the sets' description.
    plan : CyclePlan
        The patterns of both kinds of cycle.
    recording : RecordingConfig
        How many to keep, and how much disk to leave.
    frames : FrameAddress
        The ring of frames.
    telemetry : RingAddress
        Where a fault is seen.

    Attributes
    ----------
    left_out : int
        Sets that were not kept for want of time or disk.
    """

    def __init__(
        self,
        folder: Path,
        optics: OpticsConfig,
        plan: CyclePlan,
        recording: RecordingConfig,
        frames: FrameAddress,
        telemetry: RingAddress,
    ) -> None:
        self._folder, self._optics, self._plan, self._recording = folder, optics, plan, recording
        self._patterns = {pattern.name: pattern for pattern in plan.full}
        self._frames = FrameReader(frames)
        self._telemetry = RingReader(telemetry)
        self._writer = ThreadPoolExecutor(1, "raw frames")
        self._writing: list[Future[None]] = []
        self._in_fault = False
        self._kept: dict[int, Path] = {}
        self._reference: Path | None = None
        self._reference_needed = False
        self.left_out = 0

    def after(self, estimate: ShapeEstimate) -> None:
        """Look at a cycle that is done: is it one to keep?"""
        self.look_for_fault()
        if not (self._recording.raw_every_cycles or self._recording.raw_before_fault_cycles):
            return
        due = self._recording.raw_every_cycles and estimate.cycle % self._recording.raw_every_cycles == 0
        anchors = estimate.kind == "full" and estimate.verdict != "rejected"
        if not (due or anchors):
            return
        kept = self._keep(estimate.cycle)
        if anchors and kept is not None:
            if self._reference is not None and not self._reference_needed:
                self._writer.submit(shutil.rmtree, self._reference, ignore_errors=True)
            self._reference, self._reference_needed = kept, bool(due)

    def capture(self, estimate: ShapeEstimate) -> Path:
        """Have a cycle's frames written and wait for it; returns the set's folder. Raises OSError."""
        kept = self._keep(estimate.cycle)
        wait(self._writing)
        if kept is None or not (kept / "capture.toml").exists():
            raise OSError("the set could not be written whole: is the disk full, or slower than the cycles?")
        if kept == self._reference:
            self._reference_needed = True  # it is somebody's now
        return kept

    def look_for_fault(self) -> None:
        """Keep the last cycles if a fault has come up since the last call."""
        message = self._telemetry.latest()
        fault = message is not None and _ROW.unpack(message)[_FAULT] > 0
        if fault and not self._in_fault and self._recording.raw_before_fault_cycles:
            cycles = sorted({head.cycle for head in self._frames.heads()})
            for cycle in cycles[-self._recording.raw_before_fault_cycles :]:
                self._keep(cycle)
        self._in_fault = fault

    def close(self) -> None:
        """Look once more, write what waits, detach."""
        self.look_for_fault()
        self._writer.shutdown()
        self._frames.close()
        self._telemetry.close()

    def _keep(self, cycle: int) -> Path | None:
        """Copy a cycle's frames and have them written; None if that cannot be."""
        if cycle in self._kept:
            return self._kept[cycle]
        self._writing = [write for write in self._writing if not write.done()]
        found = self._copy(cycle)
        if found is None or len(self._writing) >= _WAITING_SETS or not self._room():
            self.left_out += 1
            return None
        path = self._kept[cycle] = self._unused(cycle)
        reference = None
        if found.kind == "fringes" and self._reference is not None:
            self._reference_needed, reference = True, f"../{self._reference.name}"
        table = _description(found, self._optics, self._patterns, reference)
        self._writing.append(self._writer.submit(_write, path, table, found))
        return path

    def _unused(self, cycle: int) -> Path:
        """A name for the set; an acquisition that was replaced counts its cycles from 1 again."""
        path, again = self._folder / f"cycle-{cycle:06d}", 1
        while path.exists():
            again += 1
            path = path.with_name(f"cycle-{cycle:06d}-{again}")
        return path

    def _copy(self, cycle: int) -> _Set | None:
        heads = [head for head in self._frames.heads() if head.cycle == cycle]
        copies = [self._frames.copy(head) for head in heads]
        names = {head.pattern for head, pixels in zip(heads, copies, strict=True) if pixels is not None}
        for kind, wanted in (("full", self._plan.full), ("fringes", self._plan.fringes)):
            if names == {pattern.name for pattern in wanted} and len(heads) == len(wanted):
                return _Set(kind, tuple(heads), tuple(pixels for pixels in copies if pixels is not None))
        return None  # a cycle that was stopped, or is partly written over

    def _room(self) -> bool:
        free_mb = shutil.disk_usage(self._folder.parent).free / 1e6
        return free_mb > self._recording.min_free_mb


def _write(folder: Path, table: dict[str, Any], content: _Set) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for head, pixels in zip(content.heads, content.pixels, strict=True):
        if not cv2.imwrite(str(folder / f"{head.pattern}.png"), pixels, _FASTEST):
            raise OSError(f"{folder / head.pattern}.png: cannot be written")
    (folder / "capture.toml").write_text(
        tomli_w.dumps(table), encoding="utf-8"
    )  # last: a set is whole when it is there


def _description(
    content: _Set, optics: OpticsConfig, patterns: dict[str, Pattern], reference: str | None
) -> dict[str, Any]:
    table: dict[str, Any] = {"schema": "membrane-capture/1", "kind": content.kind}
    if reference is not None:
        table["reference"] = reference
    table |= optics.model_dump(mode="json", exclude_none=True)
    table["frames"] = list(_rows(content.heads, patterns))
    return table


def _rows(heads: Iterable[FrameHead], patterns: dict[str, Pattern]) -> Iterable[dict[str, Any]]:
    for head in heads:
        pattern = patterns[head.pattern]
        row: dict[str, Any] = {"file": f"{head.pattern}.png", "role": pattern.role}
        if pattern.axis:
            row |= {"axis": pattern.axis, "index": pattern.index}
        row["time_s"] = head.time_s
        if head.displacement_um == head.displacement_um:  # not NaN
            row["displacement_um"] = head.displacement_um
        yield row
