"""Tracking a crossed pattern: what a frame gives, and which frames are refused by name."""

from __future__ import annotations

import math
from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from firmware_iface.optical_roles import Pattern
from membrane_ctrl.config.schema import CameraConfig, OpticsConfig
from membrane_ctrl.measure.measurement import Figures, SetFigure
from membrane_ctrl.metrology.tracking.crossed_scene import CrossedScene
from membrane_ctrl.metrology.tracking.lost_orders import LostOrders
from membrane_ctrl.metrology.tracking.outlier_rejection import RobustFitter
from membrane_ctrl.metrology.tracking.scene_from_reference import make_scene
from membrane_ctrl.metrology.tracking.step_jumps import StepJumps
from membrane_ctrl.metrology.tracking.step_means import estimate_step_places
from membrane_ctrl.metrology.tracking.tracked_frame import TrackedFrame
from membrane_ctrl.metrology.tracking.tracker import Tracker
from membrane_ctrl.model.zernike_terms import NOLL_INDICES, ZERNIKE_TERMS
from membrane_ctrl.sim.optics.camera import OpticsRenderer
from membrane_ctrl.sim.optics.film_shape import FilmShape, typical_film
from membrane_ctrl.sim.optics.simulate import simulate_set
from membrane_ctrl.sim.optics.simulation_spec import SimulationSpec
from membrane_ctrl.sim.optics.zernike_polynomials import noll_orders

Frames = list[NDArray[np.uint8]]
SHRINK = 10
SIZE = (2048 // SHRINK, 2448 // SHRINK)
OPTICS = OpticsConfig(
    camera=CameraConfig(width_px=SIZE[1], height_px=SIZE[0], pixel_um=3.45 * SHRINK)
)
FILM = typical_film(37.1, 500.0, seed=1)
STEPS = np.array([(2 * math.pi * k / 5, 4 * math.pi * k / 5) for k in range(5)])
STILL = (0.0, 0.0)
LOST_TILT_UM = 548.3  # of this bench: it moves the reflected pattern by one period along x


@dataclass
class Bench:
    """A reference, and the frames that the twin's camera takes of a crossed pattern."""

    scene: CrossedScene
    prepared: Tracker
    taken: int = 0

    def frame(
        self,
        moved_um: float = 0.0,
        film: FilmShape = FILM,
        gain: float = 1.0,
        shifts: tuple[float, float] = STILL,
    ) -> NDArray[np.uint8]:
        self.taken += 1
        renderer = OpticsRenderer(OPTICS, film, seed=100 + self.taken)
        return np.asarray(
            renderer.render_picture(
                Pattern("crossed", "", 32, shifts[0], shift_y_rad=shifts[1]), moved_um, gain=gain
            ),
            np.uint8,
        )

    def tracker(self) -> Tracker:
        """A tracker that has seen nothing, or only the still mirror;
        its derivatives are made once.
        """
        return deepcopy(self.prepared)


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> SetFigure:
    folder = tmp_path_factory.mktemp("track") / "full"
    simulate_set(folder, SimulationSpec(OPTICS, FILM))
    return Figures().measure_folder(folder)


@pytest.mark.parametrize(
    ("periods", "why"),
    [(12, "only 8 fringes across the mirror"), (120, r"only \d\.\d pixels a fringe")],
)
def test_fringes_that_determine_nothing_are_refused(
    reference: SetFigure, periods: int, why: str
) -> None:
    with pytest.raises(ValueError, match=why):
        make_scene(reference.head.optics, reference.checked, reference.figure, 398.56 / periods)


@pytest.fixture(scope="module")
def prepared(reference: SetFigure) -> Bench:
    scene = make_scene(reference.head.optics, reference.checked, reference.figure, 12.455)
    return Bench(scene, Tracker(scene, SIZE, 255, OPTICS.camera.noise_adu))


@pytest.fixture
def bench(prepared: Bench) -> Bench:
    """Its pictures are the same in whatever order the tests run."""
    prepared.taken = 0
    return prepared


def test_no_bin_of_a_scene_counts_twice(bench: Bench) -> None:
    counted = bench.scene.index[bench.scene.edge > 0]
    assert np.unique(counted).size == counted.size < bench.scene.index.size


def with_terms(by_um: dict[int, float]) -> FilmShape:
    terms = np.zeros(ZERNIKE_TERMS)
    terms[: len(FILM.zernike_um)] = FILM.zernike_um
    for j, um in by_um.items():
        terms[j - 1] += um
    return replace(FILM, zernike_um=tuple(terms))


def test_every_frame_gives_the_figure_within_its_error_bar(bench: Bench) -> None:
    tracker = bench.tracker()
    stepped = [bench.frame(shifts=(float(x), float(y))) for x, y in STEPS]
    begun = tracker.measure_steps(stepped, STEPS, 0.1 * np.arange(-5, 0), np.full(5, math.nan))
    # of so few pixels a square of the mirror may show a fringe too few, and is then left out
    assert "rejected" not in {frame.verdict for frame in begun}
    moved = [0.0, 1.0, 3.0, 3.2, 40.0, -60.0]
    frames = [tracker.track_frame(bench.frame(um), STILL, 0.1 * k) for k, um in enumerate(moved)]
    assert [frame.verdict for frame in frames] == ["ok"] * len(moved), frames
    truth = np.array([FILM.sag_at_mm(um) for um in moved]) * 1e3
    error = np.array([frame.sag_um for frame in frames]) - truth
    sigma = frames[0].sag_change_sigma_um
    assert 0.01 < sigma < 0.15
    assert frames[0].sag_sigma_um > 3 * sigma  # motions along an axis, which no frame shows
    assert np.abs(error - error.mean()).max() < 4 * sigma  # the anchor's own error is common
    change_um = frames[3].coeffs_um - frames[0].coeffs_um  # a bowl deeper by 3.2 µm has only m = 0
    odd = [j for j in NOLL_INDICES[1:] if noll_orders(j)[1] != 0]
    ratio = np.abs(change_um / frames[0].change_sigma_um)
    assert (ratio[[j - 1 for j in odd]] < 5 * math.sqrt(2)).all()


@pytest.mark.parametrize(("noise_adu", "verdict"), [(0.1, "rejected"), (0.0, "ok")])
def test_a_frame_again_is_frozen_unless_the_camera_has_no_noise(
    bench: Bench, noise_adu: float, verdict: str
) -> None:
    """With a tenth of a count a pixel in nine differs; below 0.2 counts a frozen camera was called
    ok.
    """
    tracker, frame = Tracker(bench.scene, SIZE, 255, noise_adu), bench.frame()
    assert tracker.track_frame(frame, STILL, 0.0).verdict == "ok"
    assert tracker.track_frame(frame, STILL, 0.1).verdict == verdict


def test_without_steps_the_reference_gives_the_light(bench: Bench) -> None:
    tracker = bench.tracker()
    frames = [
        tracker.track_frame(bench.frame(um), STILL, 0.1 * k) for k, um in enumerate((0.0, 5.0))
    ]
    assert [frame.verdict for frame in frames] == ["ok", "ok"]
    assert frames[1].sag_um - frames[0].sag_um == pytest.approx(5.0, abs=0.15)


def test_a_drift_is_no_error_of_the_steps_and_errors_are_no_motion() -> None:
    """The first parameter drifts, the others only scatter: as their errors do, so that they stay on
    the drift.
    """
    random, step_s = np.random.default_rng(2), 10.0 * np.arange(5)
    drifted = np.outer(step_s, np.eye(ZERNIKE_TERMS)[0] * 2e-6)
    places = drifted + random.normal(0, 2e-5, (5, ZERNIKE_TERMS))
    variance = np.full((5, ZERNIKE_TERMS), 1.6e-9)  # twice the scatter: all of it is error
    found, left = estimate_step_places(places, variance, drifted)
    assert np.ptp(found[:, 0]) == pytest.approx(8e-5)
    assert np.ptp(found[:, 1]) == 0
    assert np.allclose(found.mean(axis=0), places.mean(axis=0))
    assert (left < variance).all()
    moved, _ = estimate_step_places(
        places, variance / 1e6, 0 * drifted
    )  # errors that explain nothing: it is motion
    assert np.allclose(moved, places, atol=1e-7)


def test_the_drift_is_that_of_the_mean_place_of_five_steps(bench: Bench) -> None:
    tracker, place = bench.tracker(), np.arange(float(ZERNIKE_TERMS))
    assert not tracker._drift_mm_per_s(60.0, place + 5).any()  # nothing is known yet
    tracker._mean_place = 10.0, place
    assert tracker._drift_mm_per_s(60.0, place + 5) == pytest.approx(np.full(ZERNIKE_TERMS, 0.1))


def test_a_hand_makes_the_error_bars_larger_while_it_is_there(bench: Bench) -> None:
    """They were those of the whole mirror, up to 16 times too small."""
    grown = []
    for _ in range(5):
        tracker = bench.tracker()
        pictures = [bench.frame(), bench.frame(), hand(bench.frame(), 46), bench.frame()]
        _, before, covered, after = [
            tracker.track_frame(one, STILL, 0.1 * k) for k, one in enumerate(pictures)
        ]
        assert covered.verdict == "degraded", covered.reason
        moved_um = (covered.coeffs_um - before.coeffs_um)[1:]
        assert np.abs(moved_um / covered.change_sigma_um[1:]).max() < 5
        terms = np.median(covered.change_sigma_um[1:] / before.change_sigma_um[1:])
        grown.append(
            [
                covered.sag_change_sigma_um / before.sag_change_sigma_um,
                terms,
                after.sag_change_sigma_um / before.sag_change_sigma_um,
            ]
        )
    sag, terms, back = np.mean(
        grown, axis=0
    )  # from picture to picture they scatter by 0.12, 0.06 and 0.08
    assert sag > 1.15
    assert terms > 1.05
    assert back == pytest.approx(1.0, abs=0.1)


def test_jumps_at_steps_of_the_pattern_are_distinguished_from_noise_and_motion() -> None:
    """The first parameter moves, the second jumps at steps, the others are noise."""
    random, jumps, expected = np.random.default_rng(1), StepJumps(), []
    for k in range(60):
        step, now = divmod(k, 10)[0], np.zeros(ZERNIKE_TERMS)
        now[:2] = 0.3 * math.sin(0.2 * k), 0.05 * (-1) ** step
        expected.append(
            jumps.add_frame((float(step), 0.0), now + random.normal(0, 0.001, ZERNIKE_TERMS))
        )
    assert np.flatnonzero(expected).tolist() == [10, 20, 30, 40, 50]
    sigma = np.sqrt(jumps.variance_mm2(np.zeros(ZERNIKE_TERMS)))
    assert sigma[1] == pytest.approx(0.1, rel=0.05)
    assert sigma[0] < 0.01
    assert np.median(sigma) < 0.002
    known = np.sqrt(
        jumps.variance_mm2(np.full(ZERNIKE_TERMS, 0.004**2))
    )  # of that much the place explains
    assert known[1] == pytest.approx(0.0998, rel=0.05)
    assert (known[2:] < sigma[2:].clip(1e-9)).all()
    jumps.forget_frames()  # what was before is no jump
    assert not jumps.add_frame((9.0, 0.0), np.ones(ZERNIKE_TERMS))


def test_what_the_next_frame_needs_may_be_made_ahead(bench: Bench) -> None:
    """The figures are the same, and no more is left to the frame that follows."""
    shifts = [(float(x), float(y)) for x, y in STEPS for _ in range(2)] + [STILL] * 2
    pictures = [bench.frame(shifts=one) for one in shifts]
    late, ahead = deepcopy(bench.prepared), deepcopy(bench.prepared)
    found = []
    for k, (picture, shown) in enumerate(zip(pictures, shifts, strict=True)):
        ahead.prepare(shown)
        scene = ahead._fitter.scene
        found.append([one.track_frame(picture, shown, 0.1 * k) for one in (late, ahead)])
        assert ahead._fitter.scene is scene
    for one, other in found:
        assert np.array_equal(one.coeffs_um, other.coeffs_um)
        assert one.sag_sigma_um == other.sag_sigma_um
    assert late._fitter.scene is not bench.scene


def hand(frame: NDArray[np.uint8], columns: int, light_adu: float = 9) -> NDArray[np.uint8]:
    out = frame.copy()
    out[60:140, 60 : 60 + columns] = round(light_adu)
    return out


def test_a_hand_in_one_of_the_first_five_steps_does_not_change_the_light_of_the_others(
    bench: Bench,
) -> None:
    """Its bins had no weight from then on: figures called ok were 13 sigma off."""
    tracker = bench.tracker()
    pictures = [bench.frame(shifts=(float(x), float(y))) for x, y in STEPS]
    pictures[2] = hand(pictures[2], 46)
    found = tracker.measure_steps(pictures, STEPS, 0.1 * np.arange(5), np.full(5, math.nan))
    assert [frame.verdict for frame in found] == ["ok", "ok", "degraded", "ok", "ok"]
    later = tracker.track_frame(bench.frame(), STILL, 0.6)
    assert later.verdict == "ok"
    assert np.all(tracker._fitter.scene.edge == bench.scene.edge)
    for frame in (found[0], found[1], found[3], found[4], later):
        assert abs(frame.sag_um - 1e3 * bench.scene.surface.sag_mm) < 4 * frame.sag_change_sigma_um


def dusty(frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """An eighth of the pixels darker by a fifth."""
    spots = np.random.default_rng(8).random(SIZE) < 0.12
    return np.where(spots, 0.8 * frame, frame).astype(np.uint8)


def test_a_fit_that_stays_lost_has_no_removed_bands(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A brighter frame may be lost and yet be accepted: bands that were forgotten then ended the
    acquisition.
    """
    tracker, rows = bench.tracker(), np.arange(SIZE[0])[:, None]
    assert tracker.track_frame(bench.frame(), STILL, 0.0).verdict == "ok"
    banded = (bench.frame() * (1 + 0.1 * np.cos(0.9 * rows))).astype(np.uint8)
    monkeypatch.setattr(RobustFitter, "has_failed", lambda self, fit: True)
    tracker.track_frame(banded, STILL, 0.1)
    assert not len(tracker._bands.waves)


def noisy_grey(light_adu: float) -> NDArray[np.uint8]:
    return np.random.default_rng(7).normal(light_adu, 1.0, SIZE).astype(np.uint8)


def judged(bench: Bench, name: str) -> tuple[TrackedFrame, TrackedFrame]:
    """The result of a faulty frame between good ones, and of the good one after it."""
    tracker = bench.tracker()
    good = bench.frame()
    assert tracker.track_frame(good, STILL, 0.0).verdict == "ok"
    faulty = {
        "frozen": lambda: good,
        "hand": lambda: hand(bench.frame(), 40),
        "grey hand": lambda: hand(bench.frame(), 36, float(np.median(bench.scene.light_adu[0]))),
        "large grey hand": lambda: hand(
            bench.frame(), 44, float(np.median(bench.scene.light_adu[0]))
        ),
        "body": lambda: hand(bench.frame(), 100),
        "dust": lambda: dusty(bench.frame()),
        "dark": lambda: bench.frame(gain=0.1),
        "bright": lambda: bench.frame(gain=2.5),
        "exposure": lambda: bench.frame(gain=0.85),
        "jump": lambda: bench.frame(700.0),
        "tilt by a period": lambda: bench.frame(film=with_terms({2: LOST_TILT_UM})),
        "tilt by half a period": lambda: bench.frame(film=with_terms({2: LOST_TILT_UM / 2})),
        "knock": lambda: bench.frame(film=with_terms({3: 20.0})),
        "blank": lambda: np.full(SIZE, 120, np.uint8),
        "stripes": lambda: (
            120 + 30 * np.cos(0.9 * np.arange(SIZE[0]))[:, None] + np.zeros(SIZE)
        ).astype(np.uint8),
        "blank screen": lambda: noisy_grey(float(np.median(bench.scene.light_adu[0]))),
    }
    found = tracker.track_frame(faulty[name](), STILL, 0.05)
    assert not len(tracker._bands.waves), "what a lost order leaves is no bands"
    return found, tracker.track_frame(bench.frame(2.0), STILL, 0.1)


@pytest.mark.parametrize(
    ("name", "verdict", "reason"),
    [
        ("frozen", "rejected", "frozen"),
        ("hand", "degraded", "covered"),
        ("grey hand", "degraded", "covered"),
        ("large grey hand", "rejected", "covered or order lost"),
        ("body", "rejected", "covered"),
        ("dust", "rejected", "covered or order lost"),
        ("dark", "rejected", "dark"),
        ("bright", "rejected", "saturated"),
        ("exposure", "degraded", "exposure changed"),
        ("jump", "rejected", "order lost"),
        ("tilt by a period", "rejected", "order lost"),
        ("tilt by half a period", "rejected", "order lost"),
        ("knock", "degraded", "knocked"),
        ("blank", "rejected", "no fringes"),
        ("blank screen", "rejected", "no fringes"),
        ("stripes", "rejected", "no fringes"),
    ],
)
def test_a_faulty_frame_is_reported_and_does_not_change_others(
    bench: Bench, name: str, verdict: str, reason: str
) -> None:
    faulty, after = judged(bench, name)
    assert (faulty.verdict, faulty.reason[: len(reason)]) == (verdict, reason), faulty.reason
    assert np.isnan(faulty.sag_um) == (verdict == "rejected")
    named = {"exposure": "exposure changed", "knock": "knocked"}.get(
        name, ""
    )  # light returns; a knock remains
    assert (after.verdict, after.reason[: len(named)]) == ("degraded" if named else "ok", named), (
        after.reason
    )
    assert after.sag_um - 1e3 * bench.scene.surface.sag_mm == pytest.approx(2.0, abs=0.2)


def test_fringes_of_which_a_lost_period_looks_like_a_film_are_refused(bench: Bench) -> None:
    orders = LostOrders(bench.prepared._fitter)
    orders.require_distinguishable()
    orders._lost_um = 0.02 * orders._lost_um  # as much finer
    with pytest.raises(ValueError, match="use a longer period"):
        orders.require_distinguishable()


def jumps(bench: Bench, count: int, seed: int) -> list[str]:
    """Random jumps of sag and tilt, each from the still mirror, whose frames were wrong and not
    refused.
    """
    generator, silent, good = np.random.default_rng(seed), [], bench.tracker()
    assert good.track_frame(bench.frame(), STILL, 0.0).verdict == "ok"
    for _ in range(count):
        sag_um, tilt_mrad, angle = generator.uniform((0, 0, 0), (1000, 10, 2 * math.pi))
        tilt_um = 250.0 * tilt_mrad  # RMS
        film = with_terms({2: tilt_um * math.cos(angle), 3: tilt_um * math.sin(angle)})
        found = deepcopy(good).track_frame(bench.frame(sag_um, film), STILL, 0.05)
        error_um = found.sag_um - 1e3 * bench.scene.surface.sag_mm - sag_um
        if found.verdict != "rejected" and not abs(error_um) < 1.0:
            silent.append(
                f"{sag_um:.0f} µm, {tilt_mrad:.2f} mrad: {found.verdict}, {error_um:.2f} µm off"
            )
    return silent


def test_jumps_lose_no_order_silently(bench: Bench) -> None:
    assert jumps(bench, 6, seed=5) == []


@pytest.mark.campaign
def test_a_thousand_jumps_lose_no_order_silently(bench: Bench) -> None:
    assert jumps(bench, 1000, seed=6) == []
