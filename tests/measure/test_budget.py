"""The error bars hold the truth: sets with errors unknown to the model, rendered by the twin's ray
tracer.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from membrane_ctrl.config.optics import (
    CameraConfig,
    CameraPoseConfig,
    GeometryConfig,
    OpticsConfig,
    ScreenPoseConfig,
)
from membrane_ctrl.geometry.spread_file import geometry_spread
from membrane_ctrl.metrology.figure.pixel_figure import measure_pixels, reconstruct_full
from membrane_ctrl.metrology.frame_checks.set_check import check_set
from membrane_ctrl.metrology.phase.frame_stack import FrameStack
from membrane_ctrl.metrology.rays.bench_parameters import NAMES
from membrane_ctrl.metrology.rays.bench_poses import bench_at
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.ray_tracing import Points, Tracer, make_parabola
from membrane_ctrl.metrology.rays.rim_outline import find_outline
from membrane_ctrl.metrology.reconstruction.surface_fit import fit_surface
from membrane_ctrl.metrology.uncertainty.budget import Budget, Source
from membrane_ctrl.metrology.uncertainty.geometry_spread import GeometrySpread
from membrane_ctrl.metrology.uncertainty.height_map import height_matrix
from membrane_ctrl.metrology.uncertainty.set_budget import SetBudget, assemble_budget
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from membrane_ctrl.sim.optics.camera import OpticsRenderer
from membrane_ctrl.sim.optics.film_shape import Bump, FilmShape, Wrinkle, typical_film
from membrane_ctrl.sim.optics.pattern_levels import pattern_sequence
from tests.studies.resumable_answers import answers
from tests.worlds.misstated_bench import BentRays

SHRINK = 8
CAMERA = CameraConfig(width_px=2448 // SHRINK, height_px=2048 // SHRINK, pixel_um=3.45 * SHRINK)
STATED = OpticsConfig(
    geometry=GeometryConfig(
        a_mm=2672.0, b_mm=2871.0, alpha_deg=80.9, reference_displacement_um=0.0
    ),
    camera=CAMERA,
)
X, Y = np.meshgrid(*[np.linspace(-475, 475, 41)] * 2)
INSIDE = np.hypot(X, Y) <= 475


@dataclass(frozen=True)
class Outcome:
    """Errors in µm beside what was stated of them."""

    height_um: float
    sag_um: float
    examined: SetBudget

    @property
    def stated(self) -> dict[str, float]:
        """1 sigma."""
        return self.examined.budget.total()


def true_bench(**off: float) -> OpticsConfig:
    """The bench as it really is: the stated one off by these numbers."""
    there = bench_at(Geometry.from_config(STATED), np.array([off.get(name, 0.0) for name in NAMES]))
    geometry = there.geometry
    camera = CameraPoseConfig(
        position_mm=tuple(geometry.pinhole_mm),
        rotation=tuple(tuple(row) for row in geometry.rotation),
    )
    s_x, s_y = tuple(geometry.screen_s_x), tuple(geometry.screen_s_y)
    screen = ScreenPoseConfig(
        origin_mm=tuple(geometry.screen_origin_mm), s_x=s_x, s_y=s_y, bow_mm=off.get("bow_mm", 0.0)
    )
    lens = {
        "focal_mm": geometry.focal_px * CAMERA.pixel_um * 1e-3,
        "principal_px": geometry.principal_px,
    }
    return OpticsConfig(
        geometry=GeometryConfig(camera=camera, screen=screen, reference_displacement_um=0.0),
        camera=CAMERA.model_copy(update={**lens, "distortion": geometry.distortion}),
        pattern=STATED.pattern.model_copy(
            update={"period_mm": STATED.pattern.period_mm * there.pitch}
        ),
    )


def measured(
    optics: OpticsConfig,
    seed: int = 3,
    blur_px: float = 0.0,
    y_moved_um: float | None = None,
    film: FilmShape | None = None,
    sigma_share: float = 1.0,
) -> Outcome:
    """A set of a true bench, measured as the stated one, which is known to a share of the data
    sheets' sigmas. A motion of the film comes without a laser.
    """
    film, moved_um = film or typical_film(37.1, 500.0, seed), y_moved_um or 0.0
    renderer, shown = (
        OpticsRenderer(optics, film, seed=seed),
        pattern_sequence("full", STATED.pattern),
    )
    frames = np.stack(
        [renderer.render_picture(p, moved_um / 2 * (1 if p.axis == "y" else -1)) for p in shown]
    )
    if blur_px:
        frames = np.stack([cv2.GaussianBlur(frame, (0, 0), blur_px) for frame in frames])
    readings: NDArray[np.float64] = np.full(len(shown), np.nan if y_moved_um is not None else 0.0)
    checked = check_set(FrameStack(frames, tuple(shown), readings, {}), STATED)
    full = reconstruct_full(STATED, checked, measure_pixels(STATED, checked))
    light = (
        checked.binned.means[[k for used in checked.view.used for k in used]]
        .mean(axis=0)
        .astype(float)
    )
    outline = find_outline(light, checked.tracer.geometry, 500.0, full.surface.sag_mm)
    error_um = 1e3 * (full.surface.height(X, Y) - film.height_mm(X, Y, 0.0))[INSIDE]
    angle = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    rim = 500 * np.cos(angle), 500 * np.sin(angle)
    sag_um = 1e3 * float(np.mean(full.surface.height(*rim) - film.height_mm(*rim, 0.0)))
    spread = geometry_spread(STATED, None)[0]
    spread = GeometrySpread(spread.names, sigma_share**2 * spread.covariance)
    examined = assemble_budget(STATED, checked, full, spread, 0.5, outline)
    return Outcome(float(np.sqrt(np.mean(error_um**2))), sag_um, examined)


@cache
def set_of_the_stated_bench() -> Outcome:
    return measured(STATED)


@pytest.mark.parametrize(
    ("off", "rim_sigmas"),
    [
        ({"principal_x_px": 20 / SHRINK}, 0.64),
        pytest.param({"camera_yaw_deg": 0.1}, 0.27, marks=pytest.mark.campaign),
        pytest.param({"focal_relative": 0.01}, 1.04, marks=pytest.mark.campaign),
        pytest.param({"screen_x_mm": 1.0}, 0.0, marks=pytest.mark.campaign),
        pytest.param({"pitch_relative": 1e-3}, 0.0, marks=pytest.mark.campaign),
    ],
    ids=["principal point", "yaw", "focal length", "screen", "pitch"],
)
def test_optics_that_are_off(off: dict[str, float], rim_sigmas: float) -> None:
    """Within their sigmas: the bars hold, and the set itself is sound."""
    found = measured(true_bench(**off))
    assert found.height_um < 2 * found.stated["height_rms_um"]
    assert abs(found.sag_um) < 2 * found.stated["sag_um"]
    assert found.height_um > 4  # or this test would say nothing
    assert found.examined.doubts == ()
    rim = found.examined.rim
    assert rim is not None
    assert rim.sigmas == pytest.approx(rim_sigmas, abs=0.1)
    assert not rim.contradicts
    assert not found.examined.slopes.contradicts
    # the row of the input that was off has the size of the error that it made
    (row, *_) = [row for row in found.examined.budget.rows() if row["name"] in off]
    assert found.height_um == pytest.approx(row["height_rms_um"], rel=0.15)


@pytest.mark.fast_cases("roll", "small roll", "yaw")
@pytest.mark.parametrize(
    ("off", "by_data_sheets", "by_calibration"),
    [
        ({"camera_roll_deg": 2.0}, True, True),
        ({"camera_roll_deg": 0.3}, False, True),
        ({"alpha_deg": 2.0}, False, True),
        ({"camera_yaw_deg": 0.5}, False, False),  # the rim shows it
    ],
    ids=["roll", "small roll", "elevation", "yaw"],
)
def test_slopes_that_belong_to_no_surface_contradict_the_bench(
    off: dict[str, float], by_data_sheets: bool, by_calibration: bool
) -> None:
    there = true_bench(**off)
    assert measured(there).examined.slopes.contradicts == by_data_sheets
    assert measured(there, sigma_share=0.01).examined.slopes.contradicts == by_calibration


@pytest.mark.parametrize(
    "film",
    [
        FilmShape(37.1, 500.0, wrinkles=(Wrinkle(200.0, lobes=25),)),
        FilmShape(37.1, 500.0, wrinkles=(Wrinkle(60.0, lobes=12),)),
        FilmShape(37.1, 500.0, bumps=(Bump(200.0, 100.0, 50.0, 30.0),)),
    ],
    ids=["many wrinkles", "wrinkles", "dent"],
)
def test_slopes_of_a_film_of_any_shape_belong_to_a_surface(film: FilmShape) -> None:
    slopes = measured(STATED, film=film, sigma_share=0.01).examined.slopes
    assert slopes.seen_urad < 8.0
    assert not slopes.contradicts


@pytest.mark.parametrize(
    ("prestrain", "poisson"), [(1e-3, 0.4), pytest.param(2e-4, 0.36, marks=pytest.mark.campaign)]
)
def test_a_film_that_is_not_henckys(prestrain: float, poisson: float) -> None:
    """Its row is the error of the sag, since nothing else is wrong here; of Hencky's film it is
    noise.

    A stretched film's slopes are finite and bend its profile beyond the shapes that the row knows:
    0.28 µm for 0.17.
    """
    found = measured(STATED, film=typical_film(37.1, 500.0, 3, prestrain, poisson))
    row, none = (
        next(row for row in one.examined.budget.rows() if row["name"] == "film_law")
        for one in (found, set_of_the_stated_bench())
    )
    assert abs(found.sag_um) == pytest.approx(row["sag_um"], rel=0.7)
    assert row["sag_um"] > 0.08 > 4 * none["sag_um"]


def test_wrinkles_at_the_rim_are_no_film_of_another_law() -> None:
    """Round slopes beside wrinkles of 60 µm: their row was 14 µm of sag, for an error of 2."""
    film = FilmShape(37.1, 500.0, wrinkles=(Wrinkle(60.0, lobes=12),))
    found = measured(STATED, film=film, sigma_share=0.01)
    row = next(row for row in found.examined.budget.rows() if row["name"] == "film_law")
    assert row["sag_um"] < 3.0
    own = next(row for row in found.examined.budget.rows() if row["name"] == "slope_urad")
    assert abs(found.sag_um) < 3 * np.hypot(row["sag_um"], own["sag_um"]) < 30.0


@pytest.mark.parametrize(
    "name", ["air_k_per_m", "glass_mm", pytest.param("temperature_k", marks=pytest.mark.campaign)]
)
def test_what_bends_the_rays_or_moves_the_bench(name: str) -> None:
    """Rays traced through Snell's glass, along parabolas in warm air, on a grown frame: the row is
    what they do.
    """
    film, times = typical_film(37.1, 500.0, 3), 20.0
    grown = 1 + times * 2.0 * 12e-6 * (name == "temperature_k")
    bent = (
        {name: times * {"air_k_per_m": 0.5, "glass_mm": 1.0}[name]}
        if name != "temperature_k"
        else {}
    )
    geometry = STATED.geometry.model_copy(update={"a_mm": 2672.0 * grown, "b_mm": 2871.0 * grown})
    exact = Tracer(Geometry.from_config(STATED), 500.0)
    surfaces = []
    for renderer in (
        BentRays(STATED, film),
        BentRays(STATED.model_copy(update={"geometry": geometry}), film, **bent),
    ):
        seen = renderer.trace_pixels(0.0)
        inside = np.flatnonzero(seen.x_mm**2 + seen.y_mm**2 < 475**2)[::7]
        rows, columns = np.divmod(inside, CAMERA.width_px)
        points = Points.from_rays(
            exact.geometry.rays(columns, rows), np.stack([seen.s_x_mm, seen.s_y_mm])[:, inside]
        )
        surfaces.append(fit_surface(exact, points, make_parabola(37.0, 500.0)).surface.parameters)
    budget = set_of_the_stated_bench().examined.budget
    row = next(source for source in budget.sources if source.name == name)
    heights = height_matrix(X[INSIDE], Y[INSIDE], 500.0)
    true_um, said_um = (
        1e3 * heights @ (surfaces[1] - surfaces[0]) / times,
        1e3 * heights @ row.effects_mm[:, 0],
    )
    assert np.sqrt(np.mean(said_um**2)) > 0.1  # or this test would say nothing
    said_um *= np.sign(said_um @ true_um)  # which way the input is off, nobody knows
    np.testing.assert_allclose(said_um, true_um, atol=0.03 * float(np.abs(true_um).max()))


@pytest.mark.parametrize(
    ("film", "at_most_um"),
    [
        (FilmShape(37.1, 500.0, wrinkles=(Wrinkle(60.0, lobes=12),)), 6.0),
        (FilmShape(37.1, 500.0, wrinkles=(Wrinkle(200.0, lobes=25),)), 2.0),
    ],
    ids=["12 wrinkles", "25 wrinkles"],
)
def test_wrinkles_that_the_fit_leaves_out_do_not_widen_its_bar(
    film: FilmShape, at_most_um: float
) -> None:
    """Their slopes counted in full, beside a matrix without them, made the sag's bar 3 mm."""
    found = measured(STATED, film=film, sigma_share=0.01)
    row = next(row for row in found.examined.budget.rows() if row["name"] == "slope_urad")
    assert row["sag_um"] < at_most_um
    assert abs(found.sag_um) < 2 * found.stated["sag_um"]


def test_a_film_that_moved_between_x_and_y_without_a_laser() -> None:
    """Slopes of two bowls do not integrate: the fringes say how far apart the two are."""
    found = measured(STATED, y_moved_um=100.0)
    (doubt,) = found.examined.doubts
    assert doubt.startswith("the film moved by +")
    moved_um = float(doubt.split("+")[1].split()[0])
    assert moved_um == pytest.approx(100, abs=10)
    own = next(row for row in found.examined.budget.rows() if row["name"] == "film_x_to_y_um")
    assert found.height_um == pytest.approx(own["height_rms_um"], rel=0.15)
    assert found.height_um > 15


def test_a_change_counts_noise_that_has_its_own_row_once() -> None:
    """Two sets show the same slopes, each with its noise: nothing of their row is left in the
    change between them.
    """
    rng = np.random.default_rng(1)
    shown = 1e-4 * rng.standard_normal((ZERNIKE_TERMS, 400))

    def row(noise_mm: float, grown: float) -> Source:
        effects = grown * shown + noise_mm * rng.standard_normal(shown.shape)
        return Source(
            "slope_urad", "", 1.0, effects, common=False, noise_mm2=noise_mm**2 * shown.size
        )

    one, same, other = row(3e-5, 1.0), row(3e-5, 1.0), row(3e-5, 1.2)
    square = float(np.sum(shown**2))
    assert np.trace(one.covariance_mm2) == pytest.approx(square, rel=0.02)
    left, grown = (
        np.trace(Budget((later,), 0.95).change_covariance(Budget((one,), 0.95)))
        for later in (same, other)
    )
    assert left < 0.01 * square  # with its noise 0.18
    assert grown == pytest.approx(0.04 * square, rel=0.2)


def test_two_limits_of_one_unknown_cancel_in_a_change() -> None:
    """What may hide in the light is the same in both sets, whatever the limit of each."""
    effect_mm = 1e-3 * np.random.default_rng(2).standard_normal((ZERNIKE_TERMS, 1))

    def budget_of(limit: float, is_limit: bool) -> Budget:
        source = Source("second_image", "", limit, limit * effect_mm, is_limit=is_limit)
        return Budget((source,), 0.95)

    change_mm2 = budget_of(3.0, True).change_covariance(budget_of(1.0, True))
    assert np.trace(change_mm2) == pytest.approx(0.0, abs=1e-15)
    found_mm2 = budget_of(3.0, False).change_covariance(budget_of(1.0, True))
    assert np.trace(found_mm2) == pytest.approx(4 * float(np.sum(effect_mm**2)))


def _cube(seed: int) -> dict[str, int]:
    return {"seed": seed, "cube": seed**3}


def test_a_benchmark_on_two_processes_gives_the_answers_of_one(tmp_path: Path) -> None:
    one, two = tmp_path / "one.jsonl", tmp_path / "two.jsonl"
    answers(two, 2, _cube)
    assert answers(one, 5, _cube) == answers(two, 5, _cube, workers=2)
    assert one.read_text(encoding="utf-8") == two.read_text(encoding="utf-8")


def test_a_benchmark_that_was_killed_continues_where_it_was(tmp_path: Path) -> None:
    asked: list[int] = []

    def bench(seed: int) -> dict[str, int]:
        asked.append(seed)
        return {"seed": seed, "square": seed**2}

    path = tmp_path / "answers.jsonl"
    whole = answers(path, 5, bench)
    text = path.read_text(encoding="utf-8")
    path.write_text(
        text[: text.index('"square": 9') + 4], encoding="utf-8"
    )  # in the middle of the fourth line
    assert answers(path, 5, bench) == whole
    assert asked == [0, 1, 2, 3, 4, 3, 4]
    assert path.read_text(encoding="utf-8") == text


@pytest.mark.campaign
def test_a_blurred_picture() -> None:
    found = measured(STATED, blur_px=1.2)
    (doubt,) = found.examined.doubts
    assert doubt.startswith("the picture is blurred by 1.2 px")
    row = next(row for row in found.examined.budget.rows() if row["name"] == "blur_px")
    assert row["sigma"] == pytest.approx(1.2, abs=0.1)
    assert found.height_um == pytest.approx(row["height_rms_um"], rel=0.2)
    assert found.height_um > 1


@pytest.mark.campaign
def test_a_good_set_raises_no_doubt() -> None:
    found = measured(STATED, seed=5)
    assert found.examined.doubts == ()
    own = found.examined.budget.covariance(common=False)
    assert found.height_um < 2 * found.examined.budget.compute_sigmas_um(own)["height_rms_um"]
