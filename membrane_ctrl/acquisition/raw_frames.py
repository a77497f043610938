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

from firmware_iface.optical_roles import Pattern, Pixels
from membrane_ctrl.acquisition.cycle_plan import CyclePlan
from membrane_ctrl.config.schema import OpticsConfig, RecordingConfig
from membrane_ctrl.model import acquisition_events, events, files, program, telemetry
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.processes.frame_address import FrameAddress
from membrane_ctrl.processes.frames import FrameHead, FrameReader
from membrane_ctrl.processes.ring import RingAddress, RingReader
from membrane_ctrl.run_files.detail_level import PICTURES_FROM

_WAITING_SETS = 3  # longest queue: if the disk is slower than the cycles, further sets are omitted
_FASTEST = [cv2.IMWRITE_PNG_COMPRESSION, 1]  # stronger compression hardly shrinks a noisy frame


@dataclass(frozen=True, slots=True)
class _Set:
    """The frames of one cycle, and their pixels."""

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
    """Keeps frames in the run's folder `raw`; finds faults in the telemetry.

    Parameters
    ----------
    folder : Path
        The folder, made for the first set.
    optics : OpticsConfig
        The bench that the sets state.
    plan : CyclePlan
        Patterns of the cycles.
    recording : RecordingConfig
        Which sets are kept.
    frames, telemetry : FrameAddress, RingAddress
        The rings that are read.
    send_event : callable
        Gets an event when the disk forces sets to be omitted: once for each reason, until a set is
        kept again.

    Attributes
    ----------
    left_out : int
        Number of sets omitted for lack of time or disk space.
    """

    def __init__(
        self,
        folder: Path,
        optics: OpticsConfig,
        plan: CyclePlan,
        recording: RecordingConfig,
        frames: FrameAddress,
        telemetry: RingAddress,
        send_event: Callable[[events.Event], None] = lambda event: None,
    ) -> None:
        self._folder = folder
        self._optics = optics
        self._plan = plan
        self._recording = recording
        self._patterns = {pattern.name: pattern for pattern in plan.full}
        self._frames = FrameReader(frames)
        self._telemetry = RingReader(telemetry)
        self._writer = ThreadPoolExecutor(1, "raw frames")
        self._writing: list[_Write] = []
        self._send_event = send_event
        self._reported = ""  # the reason of the last event
        self._in_fault = False
        self._kept: dict[int, Path] = {}  # folders by the number of the cycle
        self._removed: set[Path] = set()  # folders that are free once the writer comes to them
        self._reference: Path | None = None  # the newest accepted full cycle
        self._reference_needed = False  # a set refers to it, or a person requested it
        self.left_out = 0

    def keep_due_frames(self, estimate: ShapeEstimate) -> None:
        """Keep the frames of a finished cycle if they are due."""
        self._collect_writes()
        self.look_for_fault()
        if estimate.kind == "track":
            return
        if not (self._recording.raw_every_cycles or self._recording.raw_before_fault_cycles):
            return
        every = self._recording.raw_every_cycles
        is_due = bool(every and estimate.cycle % every == 0)
        is_reference = estimate.kind == "full" and estimate.verdict != "rejected"
        if not (is_due or is_reference):
            return
        kept = self._copy_and_queue(estimate.cycle)
        if is_reference and kept is not None:
            # It replaces the former reference, which is removed unless a set refers to it.
            if self._reference is not None and not self._reference_needed:
                self._remove_set(self._reference)
            self._reference = kept
            self._reference_needed = is_due

    def write_capture(self, estimate: ShapeEstimate, turned_deg: float | None = None) -> Path:
        """Write a cycle's frames and wait.

        Parameters
        ----------
        estimate : ShapeEstimate
            Of the cycle whose frames are written.
        turned_deg : float or None
            Angle of a mirror that was turned about its axis, which the set states.

        Returns
        -------
        path
            The set's folder.

        Raises
        ------
        OSError
        """
        kept = self._copy_and_queue(estimate.cycle)
        wait(write.done for write in self._writing)
        self._collect_writes()
        if kept is None or not (kept / "capture.toml").exists():
            raise OSError(
                "the set could not be written completely: is the disk full, or slower than "
                "the cycles?"
            )
        if turned_deg is not None:
            _state_turn(kept / "capture.toml", turned_deg)
        if kept == self._reference:
            self._reference_needed = True  # the set now belongs to the user
        return kept

    def look_for_fault(self) -> None:
        """Keep the last cycles if a fault has occurred since the last call."""
        message = self._telemetry.latest()
        has_fault = message is not None and telemetry.TelemetryRow.unpack(message).fault > 0
        before_fault = self._recording.raw_before_fault_cycles
        if has_fault and not self._in_fault and before_fault:
            heads = self._frames.heads()
            cycles = sorted({head.cycle for head in heads if head.pattern in self._patterns})
            for cycle in cycles[-before_fault:]:
                self._copy_and_queue(cycle)
        self._in_fault = has_fault

    def close(self) -> None:
        """Check for a fault once more, write pending sets, detach."""
        self.look_for_fault()
        self._writer.shutdown()
        self._collect_writes()
        self._frames.close()
        self._telemetry.close()

    def _copy_and_queue(self, cycle: int) -> Path | None:
        """Copy a cycle's frames and queue them for writing; None if impossible."""
        # A cycle is kept once.
        if cycle in self._kept:
            return self._kept[cycle]
        self._collect_writes()

        # Its frames, unless the ring has overwritten them, or there is no room.
        found = self._copy_frames(cycle)
        if found is None:
            self._leave_out("")
            return None
        objection = self._find_objection(found)
        if objection:
            self._leave_out(objection)
            return None

        # The set's table; fringes refer to the full set that has their orders.
        path = self._find_free_name(cycle)
        self._kept[cycle] = path
        reference = None
        if found.kind == "fringes" and self._reference is not None:
            reference = f"../{self._reference.name}"
            self._reference_needed = True
        table = _make_set_table(found, self._optics, self._patterns, reference)

        # Written by another thread.
        done = self._writer.submit(_write_set, path, table, found)
        self._writing.append(_Write(cycle, path, found.size_bytes, done))
        return path

    def _remove_set(self, folder: Path) -> None:
        """Remove a set to which no other refers; its cycle may be kept again."""
        self._writer.submit(shutil.rmtree, folder, ignore_errors=True)
        self._kept = {cycle: path for cycle, path in self._kept.items() if path != folder}
        self._removed.add(folder)

    def _find_objection(self, found: _Set) -> str:
        """Why a set cannot be written now; empty if it can."""
        if len(self._writing) >= _WAITING_SETS:
            return "the disk is slower than the cycles"
        try:
            free_bytes = shutil.disk_usage(self._folder.parent).free
        except OSError as error:
            return str(error)
        # After this set and those in the queue, the disk must have as much space as for thumbnails.
        queued_bytes = sum(write.size_bytes for write in self._writing)
        left_mb = (free_bytes - found.size_bytes - queued_bytes) / 1e6
        least_mb = PICTURES_FROM * self._recording.min_free_mb
        if left_mb > least_mb:
            return ""
        return f"less than {least_mb:g} MB would stay free"

    def _leave_out(self, reason: str) -> None:
        """Count an omitted set, and report a new reason; empty: there is nothing to report."""
        self.left_out += 1
        if reason and reason != self._reported:
            self._reported = reason
            text = f"frames are omitted: {reason}"
            self._send_event(acquisition_events.FramesLeftOut(self.left_out, text))

    def _collect_writes(self) -> None:
        """Collect finished writes; drop a failed set, to which no other may refer."""
        done = [write for write in self._writing if write.done.done()]
        self._writing = [write for write in self._writing if write not in done]
        for write in done:
            error = write.done.exception()
            if error is None:
                self._reported = ""
                continue
            self._kept.pop(write.cycle, None)
            if self._reference == write.folder:
                self._reference = None
            self._leave_out(str(error))

    def _find_free_name(self, cycle: int) -> Path:
        """A free name for the set; a replacement acquisition counts its cycles from 1 again."""
        path = self._folder / f"cycle-{cycle:06d}"
        number = 1
        while path.exists() and path not in self._removed:
            number += 1
            path = path.with_name(f"cycle-{cycle:06d}-{number}")
        self._removed.discard(path)
        return path

    def _copy_frames(self, cycle: int) -> _Set | None:
        """Copy a cycle's frames from the ring; None if it was stopped or is partly overwritten."""
        heads = [head for head in self._frames.heads() if head.cycle == cycle]
        copies = [self._frames.copy(head) for head in heads]
        pixels = tuple(copy for copy in copies if copy is not None)
        pairs = zip(heads, copies, strict=True)
        names = {head.pattern for head, copy in pairs if copy is not None}
        for kind, wanted in (("full", self._plan.full), ("fringes", self._plan.fringes)):
            is_complete = names == {pattern.name for pattern in wanted}
            if is_complete and len(heads) == len(wanted):
                return _Set(kind, tuple(heads), pixels)
        return None


def _write_set(folder: Path, table: dict[str, Any], content: _Set) -> None:
    """Write a set completely or not at all. Raises OSError, cv2.error."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if "reference" in table and not (folder / table["reference"] / "capture.toml").exists():
            raise OSError(f"{folder.name}: the full cycle it refers to is missing")
        for head, pixels in zip(content.heads, content.pixels, strict=True):
            # Written by Python, which reports a full disk; OpenCV does not.
            _, png = cv2.imencode(".png", pixels, _FASTEST)
            (folder / f"{head.pattern}.png").write_bytes(png.tobytes())
        # Last, because it marks a complete set.
        (folder / "capture.toml").write_text(tomli_w.dumps(table), encoding="utf-8")
    except Exception:
        shutil.rmtree(folder, ignore_errors=True)
        raise


def _state_turn(path: Path, turned_deg: float) -> None:
    """Add the mirror's turn to a set that may have been written before it was asked for."""
    turn = {"mirror_turned": {"angle_deg": turned_deg}}
    files.write_text_atomic(path, f"{path.read_text('utf-8')}\n{tomli_w.dumps(turn)}")


def _make_set_table(
    content: _Set, optics: OpticsConfig, patterns: dict[str, Pattern], reference: str | None
) -> dict[str, Any]:
    """The content of the set's `capture.toml`; `reference` is the folder of its full cycle."""
    table: dict[str, Any] = {**program.file_origin("membrane-capture/1"), "kind": content.kind}
    if reference is not None:
        table["reference"] = reference
    table |= optics.model_dump(mode="json", exclude_none=True)
    table["frames"] = list(_make_frame_rows(content.heads, patterns))
    return table


def _make_frame_rows(
    heads: Iterable[FrameHead], patterns: dict[str, Pattern]
) -> Iterable[dict[str, Any]]:
    """The rows `[[frames]]` of `capture.toml`."""
    for head in heads:
        pattern = patterns[head.pattern]
        row: dict[str, Any] = {"file": f"{head.pattern}.png", "role": pattern.role}
        if pattern.axis:
            row |= {"axis": pattern.axis, "index": pattern.index}
        row["time_s"] = head.time_s
        if head.displacement_um == head.displacement_um:  # not NaN
            row["displacement_um"] = head.displacement_um
        yield row
