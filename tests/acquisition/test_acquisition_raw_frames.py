"""Which frames are kept on disk, and that kept frames can be measured."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import cv2
import numpy as np
import pytest
from acquisition_fakes import FRINGES, FULL, PLAN, estimate

from membrane_ctrl.acquisition import raw_frames
from membrane_ctrl.acquisition.raw_frames import RawFrames
from membrane_ctrl.config.schema import CameraConfig, OpticsConfig, RecordingConfig
from membrane_ctrl.measure.capture_set import read_head
from membrane_ctrl.model.telemetry import FIELDS, ROW_BYTES, TelemetryRow
from membrane_ctrl.processes.frames import FrameRing, FrameWriter
from membrane_ctrl.processes.ring import RingWriter, open_ring

OPTICS = OpticsConfig(camera=CameraConfig(width_px=16, height_px=8))


class Keeping:
    """The ring of frames, the telemetry, and the keeper of frames."""

    def __init__(
        self, stack: ExitStack, folder: Path, ring_cycles: int = 2, **recording: int | float
    ) -> None:
        frames = FrameRing.for_optics(OPTICS, ring_cycles)
        stack.callback(frames.close)
        telemetry = stack.enter_context(open_ring(64, ROW_BYTES))
        self._frames = stack.enter_context(closing(FrameWriter(frames.address)))
        self._telemetry = stack.enter_context(closing(RingWriter(telemetry)))
        settings = RecordingConfig(min_free_mb=recording.pop("min_free_mb", 1), **recording)  # type: ignore[arg-type]
        self.reports: list[Any] = []
        raw = folder / "raw"
        self.raw = RawFrames(
            raw, OPTICS, PLAN, settings, frames.address, telemetry, self.reports.append
        )
        self.folder = folder / "raw"
        self.cycle = 0

    def take(self, kind: Literal["full", "fringes"] = "fringes", whole: bool = True) -> None:
        self.cycle += 1
        patterns = FULL if kind == "full" else FRINGES
        for number, pattern in enumerate(patterns if whole else patterns[:3]):
            slot = self._frames.begin()
            slot.pixels[...] = 10 * self.cycle + number
            slot.commit(pattern.name, 0.1 * number, 12.5, self.cycle)
        if whole:
            self.raw.keep_due_frames(estimate(kind, cycle=self.cycle))

    def capture(self, cycle: int) -> Path:
        return self.raw.write_capture(estimate("full", cycle=cycle))

    def capture_turned(self, cycle: int, turned_deg: float) -> Path:
        return self.raw.write_capture(estimate("full", cycle=cycle), turned_deg)

    def fault(self, code: int) -> None:
        nothing = TelemetryRow(**dict.fromkeys(FIELDS, 0.0))
        values = {**{name: getattr(nothing, name) for name in FIELDS}, "fault": float(code)}
        self._telemetry.put(TelemetryRow(**values).pack())

    def kept(self) -> list[str]:
        self.raw.close()
        return sorted(path.name for path in self.folder.iterdir()) if self.folder.exists() else []


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as opened:
        yield opened


def test_every_third_cycle_and_the_full_one_that_anchors_it(
    stack: ExitStack, tmp_path: Path
) -> None:
    keeping = Keeping(stack, tmp_path, raw_every_cycles=3)
    for kind in ("full", *["fringes"] * 6):
        keeping.take(kind)  # type: ignore[arg-type]
    assert keeping.kept() == ["cycle-000001", "cycle-000003", "cycle-000006"]
    head = read_head(keeping.folder / "cycle-000006")
    assert head.kind == "fringes"
    assert head.reference == (keeping.folder / "cycle-000001").resolve()
    assert [pattern.name for pattern in head.patterns] == [pattern.name for pattern in FRINGES]
    assert head.optics.camera.width_px == 16
    assert np.all(head.displacement_um == 12.5)
    pixels = cv2.imread(str(keeping.folder / "cycle-000006" / "x_sin_2.png"), cv2.IMREAD_UNCHANGED)
    assert pixels.shape == (8, 16)
    assert np.all(pixels == 62)
    assert read_head(keeping.folder / "cycle-000001").kind == "full"


def test_the_last_cycles_before_a_fault(stack: ExitStack, tmp_path: Path) -> None:
    keeping = Keeping(stack, tmp_path, raw_before_fault_cycles=2)
    keeping.take("full")
    for _ in range(4):
        keeping.take()
    keeping.fault(7)
    assert keeping.kept() == ["cycle-000001", "cycle-000004", "cycle-000005"]


def test_a_former_anchor_that_made_room_is_kept_before_a_fault(
    stack: ExitStack, tmp_path: Path
) -> None:
    keeping = Keeping(stack, tmp_path, ring_cycles=5, raw_before_fault_cycles=5)
    keeping.take("full")
    keeping.take("full")
    keeping.fault(7)
    assert keeping.kept() == ["cycle-000001", "cycle-000002"]


def test_a_fault_is_kept_once_and_a_new_one_again(stack: ExitStack, tmp_path: Path) -> None:
    keeping = Keeping(stack, tmp_path, raw_before_fault_cycles=1)
    keeping.take("full")
    keeping.take()
    for code in (7, 7, 0):
        keeping.fault(code)
        keeping.take()
    keeping.fault(9)
    keeping.take()
    assert keeping.kept() == ["cycle-000001", "cycle-000003", "cycle-000006"]


def test_an_anchor_that_nothing_refers_to_makes_room(stack: ExitStack, tmp_path: Path) -> None:
    keeping = Keeping(stack, tmp_path)
    for _ in range(3):
        keeping.take("full")
    assert keeping.kept() == ["cycle-000003"]


def test_a_set_that_was_asked_for_is_there_at_once_and_stays(
    stack: ExitStack, tmp_path: Path
) -> None:
    keeping = Keeping(stack, tmp_path)
    keeping.take("full")
    assert read_head(keeping.capture(1)).kind == "full"
    keeping.take("full")  # the next anchor
    assert keeping.kept() == ["cycle-000001", "cycle-000002"]


def test_a_set_that_was_asked_for_and_cannot_be_written_is_an_error(
    stack: ExitStack, tmp_path: Path
) -> None:
    keeping = Keeping(stack, tmp_path, min_free_mb=1e9)
    keeping.take("full")
    with pytest.raises(OSError, match="disk full"):
        keeping.capture(1)
    assert keeping.kept() == []


def test_half_a_cycle_is_no_set(stack: ExitStack, tmp_path: Path) -> None:
    keeping = Keeping(stack, tmp_path, raw_before_fault_cycles=2)
    keeping.take("full")
    keeping.take(whole=False)
    keeping.fault(3)
    assert keeping.kept() == ["cycle-000001"]
    assert keeping.raw.left_out == 1


def test_switched_off_and_without_room_nothing_is_written(stack: ExitStack, tmp_path: Path) -> None:
    off = Keeping(stack, tmp_path / "off", raw_before_fault_cycles=0)
    off.folder.parent.mkdir()
    off.take("full")
    off.fault(3)
    assert off.kept() == []
    full = Keeping(stack, tmp_path / "full", min_free_mb=1e9, raw_every_cycles=1)
    full.folder.parent.mkdir()
    full.take("full")
    assert full.kept() == []
    assert full.raw.left_out == 1


@pytest.mark.parametrize(("left_bytes", "kept"), [(-1, []), (1, ["cycle-000001"])])
def test_a_set_has_to_leave_the_disk_to_the_telemetry(
    stack: ExitStack,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    left_bytes: int,
    kept: list[str],
) -> None:
    free = 2 * 100_000_000 + len(FULL) * 16 * 8 + left_bytes
    monkeypatch.setattr(raw_frames.shutil, "disk_usage", lambda _: SimpleNamespace(free=free))
    keeping = Keeping(stack, tmp_path, min_free_mb=100)
    keeping.take("full")
    assert keeping.kept() == kept
    assert bool(keeping.reports) == (not kept)


def test_frames_that_the_disk_did_not_take_whole_are_removed_and_reported_once(
    stack: ExitStack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real_write = Path.write_bytes

    def full_at_the_third(path: Path, data: bytes) -> int:
        if path.stem == FULL[2].name:
            raise OSError(28, "No space left on device")
        return real_write(path, data)

    keeping = Keeping(stack, tmp_path, raw_before_fault_cycles=1)
    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", full_at_the_third)
        for cycle in (1, 2):
            keeping.take("full")
            with pytest.raises(OSError, match="could not be written"):
                keeping.capture(cycle)
    assert list(keeping.folder.iterdir()) == []
    assert ["No space left" in reports.message for reports in keeping.reports] == [True]
    keeping.take()
    keeping.fault(3)
    assert keeping.kept() == ["cycle-000003"]
    assert (
        "reference" not in (keeping.folder / "cycle-000003" / "capture.toml").read_text()
    )  # it is not there


@pytest.mark.parametrize("every", [0, 1])
def test_a_capture_of_a_turned_mirror_states_its_angle(
    stack: ExitStack, tmp_path: Path, every: int
) -> None:
    """Also where the cycle's frames were kept before anybody asked for them."""
    keeping = Keeping(stack, tmp_path, raw_every_cycles=every)
    keeping.take("full")
    turned = read_head(keeping.capture_turned(1, 120.0)).turned
    assert turned is not None
    assert turned.angle_deg == 120.0
    keeping.take("full")
    assert read_head(keeping.capture(2)).turned is None
    assert keeping.kept() == ["cycle-000001", "cycle-000002"]
