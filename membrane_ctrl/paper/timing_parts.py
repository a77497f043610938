"""Parts: how long each step takes, and what became of the paper's limitations."""

import time
from collections.abc import Callable

import numpy as np

from membrane_ctrl.metrology.cycle.live_reconstructor import LiveReconstructor
from membrane_ctrl.metrology.figure.pixel_figure import measure_pixels, reconstruct_full
from membrane_ctrl.metrology.frame_checks.set_check import check_set
from membrane_ctrl.metrology.phase import pattern_sequence
from membrane_ctrl.paper.bench import MeasuredBench
from membrane_ctrl.paper.comparison import Agreement, PaperStatement, PartResult

_FULL_CYCLE_S = 8.0
_SEQUENTIAL_CYCLE_S = 20.0
_FRINGES_CYCLE_S = 4.0


def compare_timings(bench: MeasuredBench) -> PartResult:
    """Seconds of the paper's steps here, each also in copies of the set's frames."""
    stack = bench.stack
    # The unit that makes machines comparable: the time to copy the frames of a set.
    copy_s = min(_measure_time(stack.frames.copy) for _ in range(3))

    # The steps of `measure` alone: checks, phases, surface.
    check_s = _measure_time(lambda: check_set(stack, bench.optics, None))
    pixels_s = _measure_time(lambda: measure_pixels(bench.optics, bench.checked))
    solve_s = _measure_time(lambda: reconstruct_full(bench.optics, bench.checked, bench.pixels))

    # The same in a hold: a full cycle first, then fringes-only cycles that begin at its figure.
    live = LiveReconstructor(bench.optics)
    readings_um = np.zeros(len(stack.frames))
    time_s = np.arange(len(stack.frames), dtype=float)
    frames = list(stack.frames)
    live_full_s = _measure_time(lambda: live.measure_full(frames, time_s, readings_um))
    slots = pattern_sequence.FullSlots(bench.optics.pattern.steps)
    fringes = [frames[index] for part in slots.sinusoids for index in range(*part.indices(99))]
    count = len(fringes)
    live_fringes_s = min(
        _measure_time(lambda: live.measure_fringes(fringes, time_s[:count], readings_um[:count]))
        for _ in range(3)
    )

    # What the paper states of each step, and the seconds here.
    rows = {
        "frame checks and phases of the bins": ("", check_s),
        "phases of all pixels": ("", pixels_s),
        "surface from all pixels": ("some minutes (10 s for one solution)", solve_s),
        "full live cycle, 18 frames to the figure": ("", live_full_s),
        "fringes-only live cycle, 8 frames to the figure": ("some minutes", live_fringes_s),
    }
    comparisons = [
        PaperStatement(
            f"{step}, s",
            paper,
            f"{seconds:.2f} ({seconds / copy_s:.0f} copies of the frames)",
            Agreement.UNSTATED if not paper else Agreement.DIFFERS,
            "faster" if paper else "",
        )
        for step, (paper, seconds) in rows.items()
    ]
    comparisons.append(
        PaperStatement(
            "acquisition of a full set and of a fringes set, s",
            f"{_FULL_CYCLE_S:g} ({_SEQUENTIAL_CYCLE_S:g} in sequence) and {_FRINGES_CYCLE_S:g}",
            "set by the screen's settling time: the next cycle's frames are taken while one is "
            "computed",
            Agreement.UNSTATED,
            "a hold states its rate of figures",
        )
    )
    timing_s = {step: seconds for step, (_, seconds) in rows.items()}
    return PartResult(comparisons, {}, {}, timing_s | {"copy of the frames": copy_s})


def compare_limitations(_: MeasuredBench) -> PartResult:
    """What the paper names as limitations and plans, and what answers them."""
    rows = (
        (
            "geometry calibrated by hand",
            "meticulous manual calibration of a, b and alpha",
            "`membrane-ctrl calibrate` finds camera, screen and lens from sets at several depths",
            "docs/how-to/calibration.md",
        ),
        (
            "latency",
            "several minutes a measurement, 4 s of frames",
            "the live cycle computes each figure while the next frames are taken",
            "docs/explanation/metrology.md",
        ),
        (
            "real-time shape",
            "machine learning planned",
            '`[shape] mode = "track"`: one frame of crossed fringes a figure',
            "docs/explanation/tracking.md",
        ),
        (
            "control by the vertex alone",
            "laser displacement sensor, PID",
            "the estimator combines laser, gauge, barometer and figures",
            "docs/explanation/estimator.md",
        ),
    )
    comparisons = [
        PaperStatement(name, paper, ours, Agreement.UNSTATED, where)
        for name, paper, ours, where in rows
    ]
    return PartResult(comparisons, {}, {})


def _measure_time(run: Callable[[], object]) -> float:
    """Seconds of one run, by the clock."""
    begin_s = time.perf_counter()
    run()
    return time.perf_counter() - begin_s
