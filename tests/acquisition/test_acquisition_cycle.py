"""What a cycle shows, takes, passes on, and does after a failure."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from acquisition_fakes import (
    FRINGES,
    FULL,
    HEIGHT_PX,
    PLAN,
    WIDTH_PX,
    FakeCamera,
    FakeLaser,
    FakeReconstructor,
    FakeScreen,
)
from acquisition_fakes import VirtualClock as Clock

from firmware_iface.optical_roles import Pattern
from membrane_ctrl.acquisition.cycle import (
    DEGRADED_IN_A_ROW,
    REJECTED_IN_A_ROW,
    CycleDone,
    CycleFailed,
    ShapeCycle,
)
from membrane_ctrl.model.durations import pause_s
from membrane_ctrl.processes.frames import FrameReader, FrameRing, FrameWriter


class Bench:
    """A cycle over fakes, and the frames it stored."""

    def __init__(self, frames: FrameWriter, reader: FrameReader) -> None:
        self.clock = Clock()
        self.screen = FakeScreen()
        self.camera = FakeCamera(self.clock)
        self.reconstructor = FakeReconstructor(self.clock)
        self.reader = reader
        self.exposures_left = 10**6
        self.cycle = ShapeCycle(
            self.camera,
            self.screen,
            self.reconstructor,
            PLAN,
            frames,
            self.clock,
            FakeLaser(),
            self._stopping,
        )

    def done(self) -> CycleDone:
        result = self.cycle.run_cycle()
        assert isinstance(result, CycleDone)
        return result

    def failed(self) -> CycleFailed:
        result = self.cycle.run_cycle()
        assert isinstance(result, CycleFailed)
        return result

    def _stopping(self) -> bool:
        self.exposures_left -= 1
        return self.exposures_left < 0


@pytest.fixture
def bench() -> Iterator[Bench]:
    owner = FrameRing(len(FULL) + 1, HEIGHT_PX, WIDTH_PX)
    writer, reader = FrameWriter(owner.address), FrameReader(owner.address)
    yield Bench(writer, reader)
    reader.close()
    writer.close()
    owner.close()


def test_first_cycle_is_full_then_fringes_only(bench: Bench) -> None:
    assert [bench.done().estimate.kind for _ in range(3)] == ["full", "fringes", "fringes"]
    assert bench.screen.shown == [p.name for p in FULL + FRINGES + FRINGES]
    assert bench.reconstructor.calls[0].levels == list(range(18))
    assert bench.reconstructor.calls[2].levels == list(range(26, 34))


def test_frames_keep_their_distance_in_time(bench: Bench) -> None:
    bench.done()
    np.testing.assert_allclose(bench.reconstructor.calls[0].time_s, 0.1 * np.arange(18))


def test_slow_camera_is_not_slowed_further(bench: Bench) -> None:
    bench.camera.exposure_s = 0.25
    bench.done()
    np.testing.assert_allclose(bench.reconstructor.calls[0].time_s, 0.25 * np.arange(18))


def test_each_frame_gets_the_laser_reading_of_its_time(bench: Bench) -> None:
    bench.done()
    call = bench.reconstructor.calls[0]
    np.testing.assert_allclose(call.displacement_um, 10.0 * call.time_s)


def test_estimate_gets_its_cycle_and_latency(bench: Bench) -> None:
    assert [bench.done().estimate.cycle for _ in range(3)] == [1, 2, 3]
    assert bench.done().estimate.latency_s == pytest.approx(0.05)


def test_frames_are_stored_for_readers(bench: Bench) -> None:
    bench.done()
    bench.done()
    heads = [head for head in bench.reader.heads() if head.cycle == 2]
    assert [head.pattern for head in heads] == [p.name for p in FRINGES]
    assert all(head.displacement_um == pytest.approx(10.0 * head.time_s) for head in heads)
    last = bench.reader.copy(heads[-1])
    assert last is not None
    assert (last == 25).all()


def test_lost_tracking_makes_the_next_cycle_a_full_one(bench: Bench) -> None:
    bench.reconstructor.verdicts = [
        ("ok", ""),
        ("rejected", "tracking lost: moved by 5 mrad"),
        ("ok", ""),
    ]
    results = [bench.done() for _ in range(4)]
    assert [r.estimate.kind for r in results] == ["full", "fringes", "full", "fringes"]
    assert all(r.pause_s == 0 for r in results)


def test_fringes_rejected_for_another_reason_stay_fringes(bench: Bench) -> None:
    bench.reconstructor.verdicts = [("ok", ""), ("rejected", "modulation too low")]
    assert [bench.done().estimate.kind for _ in range(3)] == ["full", "fringes", "fringes"]


def test_full_cycles_go_on_until_one_is_accepted_and_back_off(bench: Bench) -> None:
    rejected = REJECTED_IN_A_ROW + 2
    bench.reconstructor.verdicts = [("rejected", "no mirror")] * rejected
    results = [bench.done() for _ in range(rejected + 2)]
    assert [r.estimate.kind for r in results] == ["full"] * (rejected + 1) + ["fringes"]
    assert [r.pause_s for r in results] == [0, 0, 1, 2, 4, 0, 0]


def test_a_full_cycle_that_was_spoiled_is_repeated(bench: Bench) -> None:
    """Else the fringes that follow it would stay degraded, although nothing is wrong any more."""
    bench.reconstructor.verdicts = [("degraded", "slopes of no surface"), ("ok", "")]
    kinds = [bench.done().estimate.kind for _ in range(4)]
    assert kinds == ["full", "full", "fringes", "fringes"]


def test_a_bench_on_which_full_cycles_stay_degraded_takes_fringes(bench: Bench) -> None:
    bench.reconstructor.verdicts = [("degraded", "slopes of no surface")] * 6
    kinds = [bench.done().estimate.kind for _ in range(6)]
    assert kinds == ["full"] * DEGRADED_IN_A_ROW + ["fringes"] * 3


def test_full_cycle_on_request(bench: Bench) -> None:
    bench.done()
    bench.cycle.want_full()
    assert [bench.done().estimate.kind for _ in range(2)] == ["full", "fringes"]


def test_broken_screen_is_an_event_and_is_tried_again_more_and_more_slowly(bench: Bench) -> None:
    bench.screen.broken = True
    failures = [bench.failed() for _ in range(3)]
    assert [(f.cycle, f.stage, f.pause_s) for f in failures] == [
        (1, "screen", 1),
        (2, "screen", 2),
        (3, "screen", 4),
    ]
    assert failures[0].message == "LinkError: screen: no display"
    bench.screen.broken = False
    assert bench.done().pause_s == 0
    bench.screen.broken = True
    assert bench.failed().pause_s == 1


def test_broken_camera_keeps_the_kind_of_the_cycle(bench: Bench) -> None:
    bench.done()
    bench.camera.broken = True
    assert bench.failed().stage == "camera"
    bench.camera.broken = False
    assert bench.done().estimate.kind == "fringes"


def test_numerics_that_raise_are_an_event(bench: Bench) -> None:
    bench.reconstructor.singular = True
    failure = bench.failed()
    assert (failure.stage, failure.message) == ("reconstruction", "LinAlgError: singular matrix")


def test_a_failure_before_a_cycle_is_reported_by_the_cycle(bench: Bench) -> None:
    bench.reconstructor.singular = True
    bench.cycle.prepare_next()
    assert bench.reconstructor.prepared == 1
    assert bench.failed().stage == "reconstruction"


def test_camera_with_pixels_of_its_own_is_copied(bench: Bench) -> None:
    bench.camera.own_pixels = np.zeros((HEIGHT_PX, WIDTH_PX), np.uint8)
    bench.done()
    assert bench.reconstructor.calls[0].levels == list(range(18))


def test_stopped_cycle_has_no_result_and_is_taken_again(bench: Bench) -> None:
    bench.exposures_left = 5
    assert bench.cycle.run_cycle() is None
    assert bench.camera.frames == 5
    assert bench.reconstructor.calls == []
    bench.exposures_left = 100
    assert bench.done().estimate.kind == "full"


def test_pauses_double_up_to_a_minute() -> None:
    assert [pause_s(n) for n in (-1, 0, 1, 2, 3)] == [0, 0, 1, 2, 4]
    assert pause_s(10**6) == 60.0


def test_a_standing_pattern_is_shown_once_and_again_after_a_failure(bench: Bench) -> None:
    steps = [Pattern("crossed", "", 32, 0.1 * k) for k in (0, 0, 0, 1)]
    bench.cycle._plan = replace(PLAN, standing=lambda: steps.pop(0))
    kinds = [bench.done().estimate.kind for _ in range(3)]
    assert kinds == ["full", "fringes", "fringes"]
    assert bench.screen.shown[len(FULL) :] == ["crossed"]
    bench.camera.broken = True
    bench.failed()
    bench.camera.broken = False
    bench.done()
    assert bench.screen.shown[len(FULL) :] == ["crossed", "crossed"]
    assert [len(call.levels) for call in bench.reconstructor.calls] == [18, 1, 1, 1]
