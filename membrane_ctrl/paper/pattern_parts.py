"""Parts: displayed patterns and captured frames, phases and fringe orders, the Gray-code table."""

import math
from collections.abc import Sequence

import numpy as np

from firmware_iface.display_patterns import ScreenRaster, compute_pattern_light
from firmware_iface.optical_roles import Pattern
from membrane_ctrl.metrology.phase.gray_code import absolute_phase, code_orders, gray_orders
from membrane_ctrl.metrology.phase.pattern_sequence import GRAY_BITS, FullSlots
from membrane_ctrl.metrology.phase.phase_steps import compute_phasors, equal_shifts
from membrane_ctrl.model.arrays import BoolArray, FloatArray, IntArray
from membrane_ctrl.paper import pictures
from membrane_ctrl.paper.bench import MeasuredBench, PaperBench
from membrane_ctrl.paper.comparison import Agreement, PaperStatement, PartResult

# The paper's screen (section 2.1).
_SCREEN_COLUMNS = 1366
_SCREEN_ROWS = 768
_STATED_PITCH_MM = 0.51
_DIAGONAL_MM = 32 * 25.4
# Shares of wrong orders up to this are rounded to none.
_WRONG_SHARE_MAX = 1e-6


def make_screen(bench: MeasuredBench) -> ScreenRaster:
    """The paper's LCD of 1366 x 768 pixels, with the pitch at which eight periods fit on it."""
    pattern = bench.optics.pattern
    pitch_mm = pattern.periods * pattern.period_mm / _SCREEN_ROWS
    # a rounding less would leave the pattern a rounding too large
    return ScreenRaster(
        _SCREEN_COLUMNS, _SCREEN_ROWS, pitch_mm * (1 + 1e-9), pattern.periods, pattern.period_mm
    )


def compare_patterns(bench: MeasuredBench) -> PartResult:
    """Displayed patterns of x, and the frames that show them."""
    # The patterns of x, as the paper's screen shows them and as the camera saw them.
    slots = FullSlots(bench.optics.pattern.steps)
    of_x = [*range(*slots.sinusoids[0].indices(99)), *range(*slots.gray[0].indices(99))]
    raster = make_screen(bench)
    shown = [compute_pattern_light(bench.patterns[index], raster) for index in of_x]
    frames = [bench.stack.frames[index] for index in of_x]
    names = [bench.patterns[index].name for index in of_x]
    count = len(bench.patterns)
    steps = bench.optics.pattern.steps
    comparisons = [
        PaperStatement(
            "patterns of a full set",
            "18: 4 sinusoids and 4 Gray codes an axis, white and black",
            f"{count}: {steps} sinusoids and {GRAY_BITS} Gray codes an axis, white and black",
            Agreement.REPRODUCED if count == 18 else Agreement.DIFFERS,
        ),
    ]

    # The stated pitch against the height that eight periods need, and against a screen of 16:9.
    side_mm = bench.optics.pattern.periods * bench.optics.pattern.period_mm
    pitch_mm = _DIAGONAL_MM / math.hypot(16, 9) * 9 / _SCREEN_ROWS
    comparisons.append(
        PaperStatement(
            "height of the screen and side of eight periods, mm",
            f"768 pixels of 0.51 mm: {_SCREEN_ROWS * _STATED_PITCH_MM:.1f}; 8 x 49.82: 398.6",
            f"{side_mm:.1f} at a pitch of {raster.pixel_mm:.4f} mm, 96 pixels a period",
            Agreement.DIFFERS,
            "with the stated pitch eight periods do not fit on the screen; 32 inches of 16:9 are "
            f"a pitch of {pitch_mm:.3f} mm, with which they fill its height",
        )
    )
    return PartResult(
        comparisons,
        {"patterns": [pattern.name for pattern in bench.patterns], "pitch_mm": raster.pixel_mm},
        {
            "displayed patterns of x": pictures.draw_frames(shown, names),
            "captured frames of x": pictures.draw_frames(frames, names),
        },
    )


def compare_phases(bench: PaperBench) -> PartResult:
    """Wrapped phase, both orders and absolute phase of every pixel, against the truth."""
    frames = bench.stack.frames
    pattern = bench.optics.pattern
    slots = FullSlots(pattern.steps)
    shifts_rad = equal_shifts(pattern.steps)
    white, black = (frames[index].astype(float) for index in (slots.white, slots.black))
    true_mm = np.stack([bench.truth.s_x_mm, bench.truth.s_y_mm]).reshape(2, *white.shape)
    seen = _sees_pattern(bench, white, black)

    # Axis by axis: equation 1 on the sinusoids, both orders of the Gray code, equation 2.
    wrong = {}
    error_rad = {}
    drawn: dict[str, bytes] = {}
    for axis, name in enumerate("xy"):
        phasor = compute_phasors(frames[slots.sinusoids[axis]].astype(float), shifts_rad)
        wrapped_rad = np.angle(phasor)
        k1, k2 = gray_orders(frames[slots.gray[axis]], white, black)
        phase_rad = absolute_phase(wrapped_rad, k1, k2)

        # The true phase, from -pi at the pattern's low edge; an order is wrong if it is half a
        # period off or more.
        half_mm = pattern.periods * pattern.period_mm / 2
        true_rad = 2 * math.pi * (true_mm[axis] + half_mm) / pattern.period_mm - math.pi
        difference_rad = (phase_rad - true_rad)[seen]
        is_wrong = np.abs(difference_rad) > math.pi
        wrong[name] = float(np.mean(is_wrong))
        error_rad[name] = float(np.sqrt(np.mean(difference_rad[~is_wrong] ** 2)))
        if name == "x":
            drawn = _draw_phases(wrapped_rad, k1, k2, phase_rad, seen)
    comparisons = [
        PaperStatement(
            f"wrong fringe orders of {name}, share of the pixels",
            "no discontinuity, also at the edge",
            f"{wrong[name]:.1e} of {int(seen.sum())}",
            Agreement.REPRODUCED if wrong[name] <= _WRONG_SHARE_MAX else Agreement.DIFFERS,
            f"against the truth of each pixel; RMS error of the phase {error_rad[name]:.2e} rad",
        )
        for name in "xy"
    ]
    numbers = {
        "pixels": int(seen.sum()),
        "wrong_share": wrong,
        "phase_error_rms_rad": error_rad,
    }
    return PartResult(comparisons, numbers, drawn)


def compare_gray_table(bench: MeasuredBench) -> PartResult:
    """The Gray-code table: bits, K1 and K2 of each half period, and one bit changes at a time."""
    # The code as it is displayed, and the orders that it decodes to.
    gray = FullSlots(bench.optics.pattern.steps).gray[0]
    bits = _displayed_bits(make_screen(bench), bench.patterns[gray])
    k1, k2 = code_orders(bits)

    # Bits that change from one half period to the next, and the reflected binary code itself.
    changed = np.sum(bits[:, 1:] != bits[:, :-1], axis=0)
    half_periods = np.arange(2**GRAY_BITS)
    code = half_periods ^ (half_periods >> 1)
    place = np.arange(GRAY_BITS)[::-1, None]
    same = bool(np.array_equal(bits, ((code >> place) & 1).astype(bool)))
    comparisons = [
        PaperStatement(
            "bits that change between neighbouring half periods",
            "single-bit transitions",
            f"{changed.min()} to {changed.max()}",
            Agreement.REPRODUCED if np.all(changed == 1) else Agreement.DIFFERS,
            "bits read from the middle of each displayed half period",
        ),
        PaperStatement(
            "displayed patterns against the reflected binary code",
            "",
            "the same" if same else "not the same",
            Agreement.UNSTATED,
        ),
        PaperStatement(
            "K1 (GC1 to GC3), K2 (GC1 to GC4)",
            "K1 jumps where the phase does, K2 half a period away",
            f"K1 {_join_integers(k1)}; K2 {_join_integers(k2)}",
            Agreement.REPRODUCED
            if np.array_equal(k1, half_periods // 2) and np.array_equal(k2, (half_periods + 1) // 2)
            else Agreement.DIFFERS,
        ),
    ]
    numbers = {
        "bits": bits.astype(int).T.tolist(),
        "k1": k1.tolist(),
        "k2": k2.tolist(),
        "displayed_as_table": same,
    }
    return PartResult(comparisons, numbers, {"Gray code": pictures.draw_gray_table(bits, k1, k2)})


def _displayed_bits(raster: ScreenRaster, patterns: Sequence[Pattern]) -> BoolArray:
    """Bits (patterns, half periods) of displayed codes of x, in the middle of each half period."""
    # The column of the screen in the middle of each half period, from the pattern's low edge.
    middle_mm = (np.arange(2**GRAY_BITS) + 0.5) * raster.period_mm / 2
    columns = np.searchsorted(raster.from_low_edge_mm("x"), middle_mm)
    row = raster.height_px // 2
    pictures_of_bits = [compute_pattern_light(pattern, raster) for pattern in patterns]
    return np.stack([picture[row, columns] > 0.5 for picture in pictures_of_bits])


def _sees_pattern(bench: PaperBench, white: FloatArray, black: FloatArray) -> BoolArray:
    """Pixels of the analysed disc that see the pattern."""
    reach_mm = bench.optics.mirror.analysis_radius_mm
    on_film = np.hypot(bench.truth.x_mm, bench.truth.y_mm).reshape(white.shape) <= reach_mm
    contrast = white - black
    bright = contrast > 0.2 * np.percentile(contrast, 95)
    return np.asarray(on_film & bright)


def _draw_phases(
    wrapped_rad: FloatArray, k1: IntArray, k2: IntArray, phase_rad: FloatArray, seen: BoolArray
) -> dict[str, bytes]:
    """Pictures of the phases of x; blank where the pattern is not seen."""
    maps = [np.where(seen, values, np.nan) for values in (wrapped_rad, k1, k2, phase_rad)]
    titles = ["wrapped phase, rad", "K1", "K2", "absolute phase, rad"]
    return {"phase of x": pictures.draw_images(maps, titles)}


def _join_integers(values: IntArray) -> str:
    return " ".join(str(int(value)) for value in values)
