"""What overlaps in a cycle, and that a lost frame is retaken with its own pattern on the screen."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing

import numpy as np
import pytest
from acquisition_fakes import (
    FRINGES,
    HEIGHT_PX,
    WIDTH_PX,
    FakeCamera,
    FakeLaser,
    FakeScreen,
    VirtualClock,
)

from firmware_iface.optical_roles import Frame, FrameLostError, Pattern, Pixels
from membrane_ctrl.acquisition.exposures import Exposures, StageError
from membrane_ctrl.processes.frames import FrameReader, FrameRing, FrameWriter

SETTLE_S, EXPOSE_S, TRANSFER_S = 0.1, 0.01, 0.04


class SettlingScreen:
    """Lit `SETTLE_S` after `begin`."""

    def __init__(self, clock: VirtualClock) -> None:
        self.clock, self.shown, self._begun_s = clock, [], 0.0  # type: ignore[var-annotated]

    def begin(self, pattern: Pattern) -> None:
        self.shown.append(pattern.name)
        self._begun_s = self.clock.now()

    def wait(self) -> None:
        self.clock.now_s = max(self.clock.now_s, self._begun_s + SETTLE_S)

    @property
    def settled(self) -> bool:
        return self.clock.now() >= self._begun_s + SETTLE_S - 1e-9

    def show(self, pattern: Pattern) -> None:
        self.begin(pattern)
        self.wait()

    def close(self) -> None:
        pass


class SplitCamera:
    """Sees what is on the screen while it exposes; its transfer takes `TRANSFER_S` beside
    everything else.
    """

    def __init__(self, clock: VirtualClock, screen: SettlingScreen) -> None:
        self.clock, self.screen = clock, screen
        self.lose: set[int] = set()
        self.exposures = 0
        self.seen: list[str] = []

    def expose(self, out: Pixels | None = None) -> None:
        assert self.screen.settled
        self.exposures += 1
        self._time_s, self._out, self._name = self.clock.now(), out, self.screen.shown[-1]
        self.clock.sleep(EXPOSE_S)
        self._arrives_s = self.clock.now() + TRANSFER_S

    def fetch(self) -> Frame:
        self.clock.now_s = max(self.clock.now_s, self._arrives_s)
        if self.exposures in self.lose:
            raise FrameLostError("camera: frame not whole")
        self.seen.append(self._name)
        assert self._out is not None
        self._out[...] = len(self.seen)
        return Frame(self._out, self._time_s)

    def grab(self, out: Pixels | None = None) -> Frame:
        self.expose(out)
        return self.fetch()


@pytest.fixture
def frames() -> Iterator[tuple[FrameWriter, FrameReader]]:
    ring = FrameRing(19, HEIGHT_PX, WIDTH_PX)
    with (
        closing(ring),
        closing(FrameWriter(ring.address)) as writer,
        closing(FrameReader(ring.address)) as reader,
    ):
        yield writer, reader


def split(
    writer: FrameWriter, clock: VirtualClock, interval_s: float = 0.0
) -> tuple[Exposures, SplitCamera]:
    screen = SettlingScreen(clock)
    camera = SplitCamera(clock, screen)
    return Exposures(camera, screen, writer, clock, FakeLaser(), interval_s), camera


def test_transfer_costs_nothing_while_the_next_pattern_settles(
    frames: tuple[FrameWriter, FrameReader],
) -> None:
    clock = VirtualClock()
    exposures, camera = split(frames[0], clock)
    taken = exposures.expose_patterns(FRINGES, 1, lambda: False)
    assert taken is not None
    assert clock.now_s == pytest.approx(8 * (SETTLE_S + EXPOSE_S) + TRANSFER_S)
    assert camera.seen == [pattern.name for pattern in FRINGES]
    assert [int(frame.pixels[0, 0]) for frame in taken] == list(range(1, 9))
    assert [head.pattern for head in frames[1].heads()] == camera.seen
    assert [head.time_s for head in frames[1].heads()] == [frame.time_s for frame in taken]


def test_the_next_cycle_finds_its_first_pattern_settling(
    frames: tuple[FrameWriter, FrameReader],
) -> None:
    clock = VirtualClock()
    exposures, camera = split(frames[0], clock)
    exposures.expose_patterns(FRINGES, 1, lambda: False)
    assert camera.screen.shown[-1] == FRINGES[0].name


def test_the_interval_between_exposures_is_kept(frames: tuple[FrameWriter, FrameReader]) -> None:
    exposures, _ = split(frames[0], VirtualClock(), interval_s=0.3)
    taken = exposures.expose_patterns(FRINGES, 1, lambda: False)
    assert taken is not None
    assert np.diff([frame.time_s for frame in taken]) == pytest.approx(0.3)


@pytest.mark.parametrize("lost", [{1}, {3}, {8}, {3, 4}])
def test_a_lost_frame_is_taken_again_with_its_own_pattern(
    frames: tuple[FrameWriter, FrameReader], lost: set[int]
) -> None:
    exposures, camera = split(frames[0], VirtualClock())
    camera.lose = lost
    taken = exposures.expose_patterns(FRINGES, 1, lambda: False)
    assert taken is not None
    assert camera.seen == [pattern.name for pattern in FRINGES]
    assert camera.exposures == 8 + len(lost)
    assert camera.screen.shown[-1] == FRINGES[0].name


def test_three_in_a_row_are_a_failure_of_the_camera(
    frames: tuple[FrameWriter, FrameReader],
) -> None:
    exposures, camera = split(frames[0], VirtualClock())
    camera.lose = {3, 4, 5}
    with pytest.raises(StageError, match="not whole") as failed:
        exposures.expose_patterns(FRINGES, 1, lambda: False)
    assert failed.value.stage == "camera"
    # they keep the pixels of a slot alive
    failed.value.__traceback__ = failed.value.__cause__ = None
    del failed


def test_stopping_is_asked_before_every_exposure(frames: tuple[FrameWriter, FrameReader]) -> None:
    exposures, camera = split(frames[0], VirtualClock())
    assert exposures.expose_patterns(FRINGES, 1, lambda: camera.exposures == 3) is None
    assert camera.exposures == 3


def test_plain_roles_are_used_step_by_step(frames: tuple[FrameWriter, FrameReader]) -> None:
    clock = VirtualClock()
    screen, camera = FakeScreen(), FakeCamera(clock)
    taken = Exposures(camera, screen, frames[0], clock, FakeLaser(), 0.0).expose_patterns(
        FRINGES, 1, lambda: False
    )
    assert taken is not None
    assert screen.shown == [pattern.name for pattern in FRINGES]
    assert [int(frame.pixels[0, 0]) for frame in taken] == list(range(8))


@pytest.mark.parametrize("plain", [True, False])
def test_a_stopped_cycle_holds_no_pixels(plain: bool) -> None:
    ring = FrameRing(19, HEIGHT_PX, WIDTH_PX)
    clock = VirtualClock()
    with (
        closing(ring),
        closing(FrameWriter(ring.address)) as writer,
    ):  # which raises while someone holds pixels
        if plain:
            camera = FakeCamera(clock)
            exposures = Exposures(camera, FakeScreen(), writer, clock, FakeLaser(), 0.0)
            assert exposures.expose_patterns(FRINGES, 1, lambda: camera.frames == 3) is None
        else:
            exposures, split_camera = split(writer, clock)
            assert (
                exposures.expose_patterns(FRINGES, 1, lambda: split_camera.exposures == 3) is None
            )
            split_camera._out = None  # like a closed camera
