"""Every frame x every fault is named, on data new to the checker; good sets of all kinds raise no
alarm.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from membrane_ctrl.config.schema import OpticsConfig, PatternConfig
from membrane_ctrl.metrology.frame_checks.checked_set import RejectedSetError
from membrane_ctrl.metrology.frame_checks.film_image import FilmImage, ImageEvidence
from membrane_ctrl.metrology.frame_checks.frame_inspection import find_identical_frames
from membrane_ctrl.metrology.frame_checks.set_check import check_set
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.sim.optics.film_shape import Bump, FilmShape, Ripple, Wrinkle, typical_film
from membrane_ctrl.sim.optics.pattern_levels import Light
from tests.support.rendered_sets import FILM, bench, faulty_set, good_set, patterns

NAMES = [p.name for p in patterns(bench())]
SINUSOIDS = [name for name in NAMES if "sin" in name]
GRAY = [name for name in NAMES if "gray" in name]
# one of each kind, at the seams of the sequence; the campaign goes through all
FEW = ["x_sin_3", "x_gray_1", "y_sin_0", "white"]
EVERY = [name if name in FEW else pytest.param(name, marks=pytest.mark.campaign) for name in NAMES]
X, Y = np.meshgrid(*[np.linspace(-475, 475, 61)] * 2)
INSIDE = np.hypot(X, Y) <= 475


def error_um(surface: Surface, film: FilmShape = FILM, displacement_um: float = 0.0) -> float:
    """RMS over the analysis radius."""
    return float(
        np.std((surface.height(X, Y) - film.height_mm(X, Y, displacement_um))[INSIDE]) * 1e3
    )


def named(
    kind: str, frame: str, steps: int = 4, gamma: float = 1.0
) -> tuple[set[str], list[str], float | None]:
    """Frames flagged, reasons, and the figure's error in µm (None if rejected)."""
    stack = faulty_set(kind, frame, steps, gamma)
    try:
        checked = check_set(stack, bench(steps))
    except RejectedSetError as error:
        flags, wrong = error.flags, None
    else:
        flags, wrong = checked.flags, error_um(checked.state.surface)
    return {stack.patterns[f.frame].name for f in flags}, [f.reason for f in flags], wrong


@pytest.mark.fast_cases("repeated-x_sin_3", "repeated-white", "stale-x_gray_1", "stale-y_sin_0")
@pytest.mark.parametrize("frame", EVERY[1:])
@pytest.mark.parametrize("kind", ["repeated", "stale"])
def test_a_stale_frame_is_reported_and_left_out(kind: str, frame: str) -> None:
    flagged, reasons, wrong = named(kind, frame)
    assert flagged == {frame}
    assert "stale" in reasons[0]
    assert wrong is not None
    assert wrong < 0.05


@pytest.mark.parametrize(
    "kind", ["stale", pytest.param("flicker", marks=pytest.mark.campaign), "swapped"]
)
def test_a_flagged_frame_neither_hides_nor_makes_another_doubt(kind: str) -> None:
    checked = check_set(faulty_set(kind, "x_gray_1", 4, 1.0), bench())
    verdict, reason = checked.verdict
    assert verdict == "degraded"
    assert "flagged" in reason
    assert ";" not in reason.partition("; the figure excludes")[2]
    with_image = replace(checked, image=FilmImage(0.04, ImageEvidence.WHITE_AND_BLACK, 1, 2, 3, 4))
    verdict, reason = with_image.verdict
    assert verdict == "degraded"
    assert "flagged" in reason
    assert "a second reflection of the screen at x +1 mm" in reason


@pytest.mark.parametrize("frame", ["x_sin_2", pytest.param("y_sin_1", marks=pytest.mark.campaign)])
def test_a_twentieth_of_the_frame_before_is_seen(frame: str) -> None:
    stack = good_set(bench())
    place = NAMES.index(frame)
    before, own = stack.frames[place - 1 : place + 1].astype(float)
    stack.frames[place] = np.rint(0.95 * own + 0.05 * before)  # 4 µm of figure if nobody notices
    checked = check_set(stack, bench())
    assert [NAMES[flag.frame] for flag in checked.flags] == [frame]
    assert error_um(checked.state.surface) < 0.05


@pytest.mark.fast_cases(
    "dark-dark-x_sin_3", "dark-dark-white", "flicker-flicker-x_gray_1", "saturated--y_sin_0"
)
@pytest.mark.parametrize("frame", EVERY[:-1])
@pytest.mark.parametrize(
    ("kind", "word"), [("dark", "dark"), ("flicker", "flicker"), ("saturated", "")]
)
def test_a_wrong_exposure_is_reported(kind: str, word: str, frame: str) -> None:
    flagged, reasons, wrong = named(kind, frame)
    assert flagged == {frame}
    assert word in reasons[0]
    assert wrong is not None
    assert wrong < 0.05


@pytest.mark.parametrize("frame", EVERY[:-1])
def test_swapped_frames_are_both_reported_and_put_back(frame: str) -> None:
    flagged, _, wrong = named("swapped", frame)
    assert flagged == {frame, NAMES[NAMES.index(frame) + 1]}
    assert wrong is not None
    assert wrong < 0.05


@pytest.mark.parametrize(
    "frame", [p for p, name in zip(EVERY, NAMES, strict=True) if name in SINUSOIDS]
)
def test_a_film_that_moved_unnoticed_by_the_laser_is_reported(frame: str) -> None:
    flagged, reasons, wrong = named("moved", frame)
    assert flagged == {frame}
    assert reasons[0].startswith("moved")
    assert wrong is not None
    assert wrong < 0.05


@pytest.mark.parametrize("frame", [p for p, name in zip(EVERY, NAMES, strict=True) if name in GRAY])
def test_a_film_that_moved_during_a_gray_frame_does_no_harm(frame: str) -> None:
    _, _, wrong = named("moved", frame)
    assert wrong is not None
    assert wrong < 0.05


@pytest.mark.parametrize("frame", ["x_sin_1"])
@pytest.mark.parametrize(
    "kind",
    ["stale", "moved", *(pytest.param(k, marks=pytest.mark.campaign) for k in ("dark", "flicker"))],
)
def test_three_steps_have_nothing_to_spare(kind: str, frame: str) -> None:
    flagged, _, wrong = named(kind, frame, steps=3)
    assert frame in flagged
    assert wrong is None


@pytest.mark.fast_cases("x_sin_1")
@pytest.mark.parametrize(
    "frame",
    [
        "x_sin_1",
        "y_sin_0",
        *(pytest.param(f, marks=pytest.mark.campaign) for f in ("x_sin_0", "y_sin_1")),
    ],
)
def test_two_of_three_steps_that_were_swapped_are_put_back(frame: str) -> None:
    flagged, reasons, wrong = named("swapped", frame, steps=3)
    assert flagged == {frame, f"{frame[:-1]}{int(frame[-1]) + 1}"}
    assert all(reason.startswith("swapped") for reason in reasons)
    assert wrong is not None
    assert wrong < 0.05


@pytest.mark.parametrize("kind", ["stale", "swapped", "flicker", "moved"])
@pytest.mark.parametrize(
    ("steps", "gamma"),
    [(4, 2.2), *(pytest.param(*more, marks=pytest.mark.campaign) for more in ((5, 2.2), (8, 1.8)))],
)
def test_faults_are_found_in_spite_of_the_displays_gamma(
    kind: str, steps: int, gamma: float
) -> None:
    flagged, _, wrong = named(kind, "x_sin_1", steps, gamma)
    assert flagged == ({"x_sin_1", "x_sin_2"} if kind == "swapped" else {"x_sin_1"})
    assert wrong is not None


def _coarse(periods: int) -> OpticsConfig:
    """The pattern's size with fewer periods: its first Gray frames show one level all over."""
    pattern = PatternConfig(periods=periods, period_mm=398.56 / periods)
    return bench().model_copy(update={"pattern": pattern})


@pytest.mark.parametrize("periods", [1, 4])
def test_no_alarm_for_a_gray_frame_without_an_edge(periods: int) -> None:
    assert check_set(good_set(_coarse(periods)), _coarse(periods)).flags == ()


def test_a_wrong_picture_in_place_of_a_gray_frame_without_an_edge_is_reported() -> None:
    stack = good_set(_coarse(4))
    frame = NAMES.index("x_gray_1")
    stack.frames[frame] = stack.frames[frame - 1] + np.uint8(1)  # the same to the eye alone
    assert [flag.frame for flag in check_set(stack, _coarse(4)).flags] == [frame]


@pytest.mark.fast_cases("1.0-3", "1.0-5", "2.2-4", "2.2-8")
@pytest.mark.parametrize("steps", [3, 4, 5, 8])
@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_no_alarm_for_any_number_of_steps_and_gamma(steps: int, gamma: float) -> None:
    optics = bench(steps)
    assert check_set(good_set(optics, light=Light(gamma=gamma)), optics).flags == ()


@pytest.mark.parametrize(
    "light",
    [
        Light(vignetting=0.0),
        Light(vignetting=0.5),
        Light(white_fraction=0.25),
        Light(leak=0.3),
        Light(dark_fraction=0.1),
    ],
    ids=["even", "vignetted", "dim", "leaky", "dark level"],
)
def test_no_alarm_for_any_light(light: Light) -> None:
    optics = bench()
    assert check_set(good_set(optics, light=light), optics).flags == ()


@pytest.mark.fast_cases("12-4.0", "16-0.0", "16-100.0")
@pytest.mark.parametrize(("bits", "noise_adu"), [(8, 4.0), (12, 4.0), (16, 0.0), (16, 100.0)])
def test_no_alarm_for_any_depth_and_noise(bits: int, noise_adu: float) -> None:
    optics = bench(bits=bits, noise_adu=noise_adu)
    assert check_set(good_set(optics), optics).flags == ()


@pytest.mark.fast_cases("3-True", "4-False", "8-True")
@pytest.mark.parametrize("is_reported", [True, False])
@pytest.mark.parametrize("steps", [3, 4, 8])
def test_no_alarm_for_a_film_that_moves(steps: int, is_reported: bool) -> None:
    optics = bench(steps)
    stack = good_set(optics, motion_um=lambda t: 5 * math.sin(2 * math.pi * 0.3 * t))
    if not is_reported:
        stack = type(stack)(
            stack.frames, stack.patterns, np.full(len(stack.patterns), math.nan), {}
        )
    assert check_set(stack, optics).flags == ()


@pytest.mark.parametrize(
    "film",
    [
        FilmShape(
            37.1, 500.0, ripples=(Ripple(10.0, 60.0, 30.0),), bumps=(Bump(20.0, 100.0, 50.0, 15.0),)
        ),
        FilmShape(37.1, 500.0, wrinkles=(Wrinkle(20.0, 24),)),
        typical_film(50.0, 500.0, seed=4),
    ],
    ids=["ripple and bump", "wrinkled edge", "deep"],
)
def test_no_alarm_for_any_film(film: FilmShape) -> None:
    optics = bench()
    assert check_set(good_set(optics, film), optics).flags == ()


def test_no_alarm_for_dust_and_glints() -> None:
    optics, rng = bench(), np.random.default_rng(5)
    stack = good_set(optics)
    for row, column in zip(rng.integers(0, 250, 80), rng.integers(0, 300, 80), strict=True):
        stack.frames[:, row : row + 4, column : column + 4] //= 6
        stack.frames[:, row, column] = 255
    checked = check_set(stack, optics)
    assert checked.flags == ()
    assert error_um(checked.state.surface) < 0.05


def test_unequal_steps_are_no_fault() -> None:
    optics = bench(5)
    checked = check_set(good_set(optics, shifts_rad=(0.0, 1.0, 2.2, 3.9, 5.0)), optics)
    assert checked.flags == ()
    assert error_um(checked.state.surface) < 0.05


def test_two_bad_frames_of_one_axis_leave_too_few() -> None:
    stack = faulty_set("stale", "x_sin_1")
    stack.frames[2] = stack.frames[2] // 2
    with pytest.raises(RejectedSetError, match="phase steps are usable"):
        check_set(stack, bench())


def test_identical_frames_are_found_whichever_they_are() -> None:
    stack = good_set(bench())
    assert find_identical_frames(stack) == {}
    stack.frames[9] = stack.frames[2]
    assert find_identical_frames(stack) == {9: 2}


def test_a_geometry_without_the_mirror_in_view_is_rejected() -> None:
    optics = bench()
    blind = type(optics)(
        geometry=optics.geometry.model_copy(update={"alpha_deg": 20.0}),
        camera=optics.camera,
        pattern=optics.pattern,
    )
    stack = good_set(optics)
    stack.frames[:] = 7
    with pytest.raises(RejectedSetError):
        check_set(stack, blind)


def test_a_mirrored_picture_is_reported() -> None:
    stack = good_set(bench())
    stack.frames[:] = stack.frames[:, ::-1].copy()
    with pytest.raises(RejectedSetError, match="mirrored top to bottom"):
        check_set(stack, bench())
