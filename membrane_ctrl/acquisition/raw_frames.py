"""Keeps raw frames of every n-th cycle, and of the last cycles before a fault, as capture sets to
remeasure.

`raw/cycle-000017/` in the run's folder is a set like any other (docs/reference/interfaces.md
section 3). A set of fringes only refers to the full cycle that anchors it, so the newest accepted
full cycle is kept too, until the next one replaces it or a set refers to it.
"""

import shutil
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import tomli_w

from firmware_iface.roles import Pattern, Pixels
from membrane_ctrl.acquisition.cycle_plan import CyclePlan
from membrane_ctrl.config.schema import OpticsConfig, RecordingConfig
from membrane_ctrl.model import acquisition_events, events, program, telemetry
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.processes.frame_address import FrameAddress
from membrane_ctrl.processes.frames import FrameHead, FrameReader
from membrane_ctrl.processes.ring import RingAddress, RingReader
from membrane_ctrl.run_files.detail_level import PICTURES_FROM

# If the disk is slower than the cycles, sets beyond this queue are omitted
_WAITING_SETS = 3
_FASTEST = [cv2.IMWRITE_PNG_COMPRESSION, 1]  # stronger compression hardly shrinks a noisy frame


@dataclass(frozen=True, slots=True)
class _Set:
    kind: str
    heads: tuple[FrameHead, ...]
    pixels: tuple[Pixels, ...]

    @property
    def size_bytes(self) -> int:
        """Largest size on disk: noise does not compress."""
        return sum(pixels.nbytes for pixels in self.pixels)


@dataclass(frozen=True, slots=True)
class _Write:
    """A set being written."""

    cycle: int
    folder: Path
    size_bytes: int
    done: Future[None]


class RawFrames:
    """Keeps frames in the run's folder `raw`, made for the first set; sees faults in the telemetry.

    `tell` gets an event of kind "raw_frames" when the disk forces sets to be omitted: once per
    reason, until one is kept again. `left_out` counts the sets omitted for lack of time or disk.
    """

    def __init__(
        self,
        folder: Path,
        optics: OpticsConfig,
        plan: CyclePlan,
        recording: RecordingConfig,
        frames: FrameAddress,
        telemetry: RingAddress,
        tell: Callable[[events.Event], None] = lambda event: None,
    ) -> None:
        self._folder, self._optics, self._plan, self._recording = folder, optics, plan, recording
        self._patterns = {pattern.name: pattern for pattern in plan.full}
        self._frames = FrameReader(frames)
        self._telemetry = RingReader(telemetry)
        self._writer = ThreadPoolExecutor(1, "raw frames")
        self._writing: list[_Write] = []
        self._tell = tell
        self._told = ""
        self._in_fault = False
        self._kept: dict[int, Path] = {}
        self._reference: Path | None = None
        self._reference_needed = False
        self.left_out = 0

    def keep_due_frames(self, estimate: ShapeEstimate) -> None:
        """Keep the frames of a finished cycle if they are due."""
        self._collect_writes()
        self.look_for_fault()
        if estimate.kind == "track":
            return
        if not (self._recording.raw_every_cycles or self._recording.raw_before_fault_cycles):
            return
        due = (
            self._recording.raw_every_cycles
            and estimate.cycle % self._recording.raw_every_cycles == 0
        )
        anchors = estimate.kind == "full" and estimate.verdict != "rejected"
        if not (due or anchors):
            return
        kept = self._copy_and_queue(estimate.cycle)
        if anchors and kept is not None:
            if self._reference is not None and not self._reference_needed:
                self._writer.submit(shutil.rmtree, self._reference, ignore_errors=True)
            self._reference, self._reference_needed = kept, bool(due)

    def write_capture(self, estimate: ShapeEstimate) -> Path:
        """Write a cycle's frames and wait; returns the set's folder. Raises OSError."""
        kept = self._copy_and_queue(estimate.cycle)
        wait(write.done for write in self._writing)
        self._collect_writes()
        if kept is None or not (kept / "capture.toml").exists():
            raise OSError(
                "the set could not be written completely: is the disk full, or slower than "
                "the cycles?"
            )
        if kept == self._reference:
            self._reference_needed = True  # the set now belongs to the user
        return kept

    def look_for_fault(self) -> None:
        """Keep the last cycles if a fault has occurred since the last call."""
        message = self._telemetry.latest()
        fault = message is not None and telemetry.TelemetryRow.unpack(message).fault > 0
        if fault and not self._in_fault and self._recording.raw_before_fault_cycles:
            cycles = sorted(
                {head.cycle for head in self._frames.heads() if head.pattern in self._patterns}
            )
            for cycle in cycles[-self._recording.raw_before_fault_cycles :]:
                self._copy_and_queue(cycle)
        self._in_fault = fault

    def close(self) -> None:
        """Check for a fault once more, write pending sets, detach."""
        self.look_for_fault()
        self._writer.shutdown()
        self._collect_writes()
        self._frames.close()
        self._telemetry.close()

    def _copy_and_queue(self, cycle: int) -> Path | None:
        """Copy a cycle's frames and queue them for writing; None if impossible."""
        if cycle in self._kept:
            return self._kept[cycle]
        self._collect_writes()
        found = self._copy_frames(cycle)
        against = self._find_objection(found) if found is not None else ""
        if found is None or against:
            self._leave_out(against)
            return None
        path = self._kept[cycle] = self._find_free_name(cycle)
        reference = None
        if found.kind == "fringes" and self._reference is not None:
            self._reference_needed, reference = True, f"../{self._reference.name}"
        table = _make_set_table(found, self._optics, self._patterns, reference)
        done = self._writer.submit(_write_set, path, table, found)
        self._writing.append(_Write(cycle, path, found.size_bytes, done))
        return path

    def _find_objection(self, found: _Set) -> str:
        """Why a set cannot be written now; empty if it can."""
        if len(self._writing) >= _WAITING_SETS:
            return "the disk is slower than the cycles"
        try:
            free_bytes = shutil.disk_usage(self._folder.parent).free
        except OSError as error:
            return str(error)
        # count queued sets too: after writing them, the disk must still have room as for thumbnails
        left_mb = (
            free_bytes - found.size_bytes - sum(write.size_bytes for write in self._writing)
        ) / 1e6
        least_mb = PICTURES_FROM * self._recording.min_free_mb
        return "" if left_mb > least_mb else f"less than {least_mb:g} MB would stay free"

    def _leave_out(self, why: str) -> None:
        self.left_out += 1
        if why and why != self._told:
            self._told = why
            self._tell(
                acquisition_events.FramesLeftOut(self.left_out, f"frames are omitted: {why}")
            )

    def _collect_writes(self) -> None:
        """Collect finished writes; drop a failed set, to which no other may refer."""
        done = [write for write in self._writing if write.done.done()]
        self._writing = [write for write in self._writing if write not in done]
        for write in done:
            error = write.done.exception()
            if error is None:
                self._told = ""
                continue
            self._kept.pop(write.cycle, None)
            if self._reference == write.folder:
                self._reference = None
            self._leave_out(str(error))

    def _find_free_name(self, cycle: int) -> Path:
        """A free name for the set; a replacement acquisition counts its cycles from 1 again."""
        path, again = self._folder / f"cycle-{cycle:06d}", 1
        while path.exists():
            again += 1
            path = path.with_name(f"cycle-{cycle:06d}-{again}")
        return path

    def _copy_frames(self, cycle: int) -> _Set | None:
        heads = [head for head in self._frames.heads() if head.cycle == cycle]
        copies = [self._frames.copy(head) for head in heads]
        names = {
            head.pattern for head, pixels in zip(heads, copies, strict=True) if pixels is not None
        }
        for kind, wanted in (("full", self._plan.full), ("fringes", self._plan.fringes)):
            if names == {pattern.name for pattern in wanted} and len(heads) == len(wanted):
                return _Set(
                    kind, tuple(heads), tuple(pixels for pixels in copies if pixels is not None)
                )
        return None  # a stopped or partly overwritten cycle


def _write_set(folder: Path, table: dict[str, Any], content: _Set) -> None:
    """Write a set completely or not at all. Raises OSError, cv2.error."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if "reference" in table and not (folder / table["reference"] / "capture.toml").exists():
            raise OSError(f"{folder.name}: the full cycle it refers to is missing")
        for head, pixels in zip(content.heads, content.pixels, strict=True):
            _, png = cv2.imencode(".png", pixels, _FASTEST)
            (folder / f"{head.pattern}.png").write_bytes(
                png.tobytes()
            )  # unlike OpenCV, this reports a full disk
        # last, as it marks a complete set
        (folder / "capture.toml").write_text(tomli_w.dumps(table), encoding="utf-8")
    except Exception:
        shutil.rmtree(folder, ignore_errors=True)
        raise


def _make_set_table(
    content: _Set, optics: OpticsConfig, patterns: dict[str, Pattern], reference: str | None
) -> dict[str, Any]:
    table: dict[str, Any] = {**program.file_origin("membrane-capture/1"), "kind": content.kind}
    if reference is not None:
        table["reference"] = reference
    table |= optics.model_dump(mode="json", exclude_none=True)
    table["frames"] = list(_make_frame_rows(content.heads, patterns))
    return table


def _make_frame_rows(
    heads: Iterable[FrameHead], patterns: dict[str, Pattern]
) -> Iterable[dict[str, Any]]:
    for head in heads:
        pattern = patterns[head.pattern]
        row: dict[str, Any] = {"file": f"{head.pattern}.png", "role": pattern.role}
        if pattern.axis:
            row |= {"axis": pattern.axis, "index": pattern.index}
        row["time_s"] = head.time_s
        if head.displacement_um == head.displacement_um:  # not NaN
            row["displacement_um"] = head.displacement_um
        yield row
