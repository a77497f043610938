"""The real facet beside the golden result of its own tool (docs/measurements/real-facet.md explains
every figure).
"""

from itertools import product

import numpy as np
import pytest

from membrane_ctrl.measure import sofast_file
from membrane_ctrl.measure.sofast_file import SHIFTS_RAD, axis_series, lit_pixels
from membrane_ctrl.metrology.frame_checks.closure import (
    closure_with_level,
    closure_with_phase,
    compute_closure,
)
from membrane_ctrl.metrology.frame_checks.frequency_series import check_series
from membrane_ctrl.metrology.phase.phase_steps import compute_phasors
from membrane_ctrl.metrology.phase.temporal_unwrap import predict_phase, unwrap_in_time
from tests.support import sofast_facet
from tests.support.facet import measure_on, solve_facet
from tests.support.real_data import SOFAST, WHY_SKIPPED
from tests.support.sofast_facet import decode, sight, wrapped_phases

DATA = SOFAST
pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason=WHY_SKIPPED)

SCREENS = {
    "measured": ("display_distorted_2d", "expected_facet"),
    "rectangle": ("display_rectangular", "expected_facet_rectangular"),
}


@pytest.fixture(scope="module")
def measurement():
    return sofast_file.read_sofast_file(DATA / "measurement_facet.h5")


@pytest.fixture(scope="module")
def response():
    return sofast_facet.read_response(DATA / "image_calibration.h5")


@pytest.fixture(scope="module")
def camera():
    return sofast_facet.read_camera(DATA / "camera_sofast_downsampled.h5")


@pytest.fixture(scope="module", params=SCREENS)
def golden(request):
    """Screen as measured or as a rectangle, with the tool's result for it."""
    screen, result = SCREENS[request.param]
    return sofast_facet.read_screen(DATA / f"{screen}.h5"), sofast_facet.read_result(
        DATA / f"{result}.h5"
    )


@pytest.fixture(scope="module")
def seen(golden, measurement, response, camera):
    screen, result = golden
    return sight(decode(measurement, result.mask, response), result.mask, camera, screen)


@pytest.fixture(scope="module")
def mask():
    return sofast_facet.read_result(DATA / "expected_facet.h5").mask


def golden_focal_mm(result):
    return 250 / result.coefficients[2], 250 / result.coefficients[
        5
    ]  # h = x^2 / (4 f), coefficients in 1/m


def test_every_pixel_unwraps_to_the_same_place(golden, measurement, response):
    decoded = decode(measurement, golden[1].mask, response)
    assert decoded.consistent.all()
    assert max(np.abs(axis.step_periods).max() for axis in (decoded.x, decoded.y)) < 0.09
    np.testing.assert_allclose(
        decoded.screens, golden[1].screens, atol=1e-7
    )  # the golden phases are single precision


def test_rays_and_screen_points_are_the_golden_ones(golden, seen, camera):
    result = golden[1]
    geometry = result.geometry(camera)
    np.testing.assert_allclose(
        geometry.rays(seen.columns_px, seen.rows_px), result.rays, atol=1e-14
    )
    np.testing.assert_allclose(
        geometry.screen_points(seen.screen_mm), result.screen_points_mm, atol=1e-3
    )


def test_the_adopted_pose_has_the_measured_distance(golden, measurement, camera):
    origin_mm = golden[1].geometry(camera).screen_origin_mm
    assert np.linalg.norm(origin_mm) == pytest.approx(measurement.distance_mm, abs=1e-6)


def test_robust_fit_of_all_pixels_agrees(golden, seen, camera):
    result = golden[1]
    ours = solve_facet(result.geometry(camera), seen, "tukey")
    focal_x_mm, focal_y_mm = golden_focal_mm(result)
    assert ours.fit.surface.focal_x_mm == pytest.approx(focal_x_mm, rel=8e-4)
    assert ours.fit.surface.focal_y_mm == pytest.approx(focal_y_mm, rel=8e-4)
    assert ours.fit.surface.curvature_xy_per_mm == pytest.approx(
        result.coefficients[4] * 1e-3, rel=3e-3
    )
    difference = ours.slopes - result.slopes
    assert np.all(np.std(difference, axis=1) < 0.02e-6)  # in shape: 0.02 µrad
    assert np.abs(difference).max() < 0.8e-6  # with the tilt in which the two fits differ
    np.testing.assert_allclose(
        np.std(ours.slopes, axis=1), np.std(result.slopes, axis=1), rtol=1e-4
    )
    np.testing.assert_allclose(ours.points_mm, result.points_mm, atol=1e-3)
    spread = np.sqrt(np.mean(ours.fit.residual**2, axis=1))
    np.testing.assert_allclose(spread, golden_residual(result), rtol=2e-3)


def golden_residual(result):
    _, tilt_x, xx, tilt_y, xy, yy = result.coefficients
    x, y = result.points_mm[:2] / 1e3
    fitted = np.stack([tilt_x + 2 * xx * x + xy * y, tilt_y + xy * x + 2 * yy * y])
    return np.sqrt(np.mean((result.slopes - fitted) ** 2, axis=1))


@pytest.mark.parametrize("golden", ["measured"], indirect=True)
def test_plain_least_squares_of_every_tenth_pixel_gives_the_golden_figures(golden, seen, camera):
    thin = solve_facet(golden[1].geometry(camera), seen.every(10)).fit.surface
    assert thin.focal_x_mm == pytest.approx(115.50e3, rel=1e-4)
    assert thin.focal_y_mm == pytest.approx(104.82e3, rel=1e-4)
    full = solve_facet(golden[1].geometry(camera), seen).fit.surface
    assert full.focal_x_mm == pytest.approx(115.95e3, rel=1e-4)  # what thinning had changed
    assert full.focal_y_mm == pytest.approx(105.03e3, rel=1e-4)


def test_slopes_hardly_depend_on_the_surface_that_places_the_points(golden, seen, camera):
    geometry = golden[1].geometry(camera)
    robust = solve_facet(geometry, seen, "tukey")
    plain = solve_facet(geometry, seen).fit.surface
    _, slopes = measure_on(plain, robust.geometry, seen)
    assert np.abs(slopes - robust.slopes).max() < 5e-6


def test_the_response_calibration_does_not_fit_these_frames(measurement, response, mask):
    black, white = measurement.black[mask], measurement.white[mask]
    for frames in (*measurement.frames_x, *measurement.frames_y):
        as_seen = compute_closure(frames[..., mask], SHIFTS_RAD).rms_adu / np.median(white)
        as_shown = (
            compute_closure(
                response.shown_levels(frames[..., mask], black, white), SHIFTS_RAD
            ).rms_adu
            / 255
        )
        assert as_shown > 2.5 * as_seen
    with_it, without = (decode(measurement, mask, choice) for choice in (response, None))
    for corrected, raw in ((with_it.x, without.x), (with_it.y, without.y)):
        assert np.all(
            np.std(corrected.step_periods, axis=1) > 1.15 * np.std(raw.step_periods, axis=1)
        )


def frame_series(measurement, mask, axis):
    """Frames (F, 4, N) as seen, and the periods."""
    frames, periods = (
        getattr(measurement, f"frames_{axis}"),
        getattr(measurement, f"periods_{axis}"),
    )
    return frames[..., mask].copy(), periods


def named(frames, periods, index):
    """The suspect of one frequency: by level against the next frequency for the coarsest, else by
    phase.
    """
    if index == 0:
        neighbour = frames[1]
        level = neighbour.mean(axis=0), np.abs(compute_phasors(neighbour, SHIFTS_RAD))
        return closure_with_level(frames[0], SHIFTS_RAD, *level)
    wrapped = np.angle(np.stack([compute_phasors(steps, SHIFTS_RAD) for steps in frames]))
    return closure_with_phase(frames[index], SHIFTS_RAD, predict_phase(wrapped, periods, index))


@pytest.mark.parametrize("axis", ["x", "y"])
def test_no_frame_of_this_set_is_stale(measurement, mask, axis):
    frames, periods = frame_series(measurement, mask, axis)
    for index, steps in enumerate(frames):
        assert compute_closure(steps, SHIFTS_RAD).rms_adu < 2.5
        assert named(frames, periods, index).residual_ratio < 1.2


@pytest.mark.parametrize("axis", ["x", "y"])
@pytest.mark.parametrize("index", [0, 1, 2, 3])
@pytest.mark.parametrize("step", [1, 2, 3])
def test_a_planted_stale_frame_is_reported(measurement, mask, axis, index, step):
    frames, periods = frame_series(measurement, mask, axis)
    frames[index, step] = frames[index, step - 1]
    assert compute_closure(frames[index], SHIFTS_RAD).rms_adu > 20
    found = named(frames, periods, index)
    assert found.suspect_frame == step
    assert found.residual_ratio > 5


def test_unwrapping_alone_does_not_notice_a_stale_frame_of_the_finest_fringe(measurement, mask):
    good, _ = wrapped_phases(measurement, mask, None)
    frames, periods = frame_series(measurement, mask, "x")
    frames[3, 1] = frames[3, 0]
    stale = good.copy()
    stale[3] = np.angle(compute_phasors(frames[3], SHIFTS_RAD))
    position = unwrap_in_time(stale, periods)
    assert position.consistent.all()
    error_mm = 8727 * (position.screens - unwrap_in_time(good, periods).screens)
    assert np.sqrt(np.mean(error_mm**2)) > 5


def series(measurement, change=None):
    """The check of the measured frames, one of them changed, at pixels chosen without the golden
    result.
    """
    pixels = lit_pixels(measurement)
    axes = axis_series(measurement, pixels)
    if change is not None:
        change(axes)
    return check_series(axes, measurement.black[pixels], measurement.white[pixels])


def test_the_untouched_frames_raise_no_alarm(measurement, mask):
    found = series(measurement)
    assert (found.verdict, found.flags) == ("ok", ())
    assert lit_pixels(measurement)[mask].all()  # all that the tool used, found without it


def test_the_check_reports_every_stale_frame(measurement):
    noise = np.random.default_rng(2).normal(0, 1.0, int(lit_pixels(measurement).sum()))
    for axis, index, step in product(range(2), range(4), range(1, 4)):

        def stale(axes, axis=axis, index=index, step=step):
            # y byte for byte, x a new exposure of the old picture
            axes[axis].frames[index, step] = axes[axis].frames[index, step - 1] + axis * noise

        found = series(measurement, stale)
        assert found.verdict == "degraded"
        assert [(flag.axis, flag.index, flag.step) for flag in found.flags] == [
            ("yx"[axis], index, step)
        ]
        assert found.flags[0].reason.startswith("stale")


def test_the_check_reports_exchanged_frames(measurement):
    seen = 0
    for axis, index, (a, b) in product(range(2), (1, 3), ((0, 1), (0, 2), (1, 3))):

        def exchange(axes, axis=axis, index=index, a=a, b=b):
            axes[axis].frames[index, [a, b]] = axes[axis].frames[index, [b, a]]

        found = series(measurement, exchange)
        seen += {(flag.index, flag.step) for flag in found.flags} == {(index, a), (index, b)}
    assert seen == 12


def test_a_known_stale_frame_of_the_finest_fringe_does_not_change_the_result(measurement):
    good = series(measurement).axes[1]

    def stale(axes):
        axes[1].frames[3, 1] = axes[1].frames[3, 0]

    mended = series(measurement, stale).axes[1]
    position, truth = (
        unwrap_in_time(axis.phases_rad(), axis.periods).screens for axis in (mended, good)
    )
    # 5 mm and more when it is not noticed (see above); the second harmonic, which three steps
    # alias, is what is left
    assert 8727 * np.sqrt(np.mean((position - truth) ** 2)) < 0.5
