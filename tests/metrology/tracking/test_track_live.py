"""Tracking in a hold: the anchor, the steps of the pattern, and what follows when the mirror is
lost.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from firmware_iface.optical_roles import Pattern
from membrane_ctrl.config.schema import CameraConfig, Config, OpticsConfig
from membrane_ctrl.metrology.cycle.live_reconstructor import LiveReconstructor
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.metrology.phase import pattern_sequence
from membrane_ctrl.metrology.tracking.live_tracker import (
    COVARIANCE_S,
    LOST_S,
    REJECTED_S,
    LiveTracker,
    _make_estimate,
)
from membrane_ctrl.metrology.tracking.tracked_frame import rejected_frame
from membrane_ctrl.metrology.vibrations.mode_follower import VibrationFollower
from membrane_ctrl.model.acquisition_events import Vibrations
from membrane_ctrl.model.shape_estimate import ShapeEstimate, pack_estimate, unpack_estimate
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from membrane_ctrl.sim.optics.camera import OpticsRenderer
from membrane_ctrl.sim.optics.drum_modes import drum_modes
from membrane_ctrl.sim.optics.film_shape import typical_film
from membrane_ctrl.sim.optics.pattern_levels import Light
from membrane_ctrl.sim.plant import Plant
from tests.worlds.virtual_record import run_virtual

SHRINK = 8
OPTICS = OpticsConfig(
    camera=CameraConfig(width_px=2448 // SHRINK, height_px=2048 // SHRINK, pixel_um=3.45 * SHRINK)
)
FILM = typical_film(37.1, 500.0, seed=1)
RATE_HZ, STEP_S = 4.0, 1.0


class Bench:
    """A tracker, and the twin's frames for it at a rate; `stains` multiply their light."""

    def __init__(self, gamma: float = 1.0) -> None:
        self.tracker = LiveTracker(
            OPTICS, LiveReconstructor(OPTICS, 1), 32, STEP_S, exposure_s=0.02
        )
        self.renderer = OpticsRenderer(OPTICS, FILM, Light(gamma=gamma), seed=3)
        self.time_s, self.rate_hz = 0.0, RATE_HZ
        self.shown: list[Pattern] = []
        self.stains: NDArray[np.float64] | float = 1.0
        self.picture: NDArray[np.uint8] = np.zeros(0, np.uint8)

    def full(self, moved_um: float = 0.0) -> ShapeEstimate:
        frames = [
            self.stain(self.renderer.render_picture(p, moved_um))
            for p in pattern_sequence.full_sequence(OPTICS.pattern)
        ]
        self.time_s += 2.0
        return self.tracker.measure_full(
            frames, self.time_s + 0.1 * np.arange(18), np.full(18, moved_um)
        )

    def frame(
        self, moved_um: float = 0.0, reading_um: float = math.nan, gain: float = 1.0
    ) -> ShapeEstimate:
        picture = self.renderer.render_picture(self.tracker.pattern, moved_um, gain=gain)
        self.picture = self.stain(picture)
        return self.again(reading_um)

    def stain(self, picture: NDArray[Any]) -> NDArray[np.uint8]:
        return np.rint(picture * self.stains).clip(0, 255).astype(np.uint8)

    def again(self, reading_um: float = math.nan) -> ShapeEstimate:
        """The last picture as the next frame."""
        self.time_s += 1 / self.rate_hz
        self.shown.append(self.tracker.pattern)
        return self.tracker.measure_fringes(
            [self.picture], np.array([self.time_s]), np.array([reading_um])
        )

    def frames(self, count: int, moved_um: float = 0.0, **given: float) -> list[ShapeEstimate]:
        return [self.frame(moved_um, **given) for _ in range(count)]


@pytest.fixture(scope="module")
def anchored() -> Bench:
    bench = Bench()
    assert bench.full().verdict == "ok"
    return bench


@pytest.fixture
def bench(anchored: Bench) -> Bench:
    """A bench that follows the mirror at rest."""
    assert anchored.full().verdict == "ok"
    anchored.stains, anchored.shown, anchored.rate_hz = 1.0, [], RATE_HZ
    return anchored


def test_every_frame_follows_the_film(bench: Bench) -> None:
    truth_um = [0.5 * math.sin(k) for k in range(12)]
    found = [bench.frame(um, um) for um in truth_um]
    assert {(e.kind, e.verdict, e.tracking_lost) for e in found} == {("track", "ok", False)}, [
        e.reason for e in found
    ]
    error_um = np.array(
        [e.sag_um - 1e3 * FILM.sag_at_mm(um) for e, um in zip(found, truth_um, strict=True)]
    )
    assert np.std(error_um) < 2 * found[-1].sag_change_sigma_um
    assert [e.displacement_um for e in found] == pytest.approx(truth_um, abs=6e-4)
    assert found[0].time_s == pytest.approx(
        bench.time_s - 11 / RATE_HZ + 0.01
    )  # the middle of the exposure
    assert (
        unpack_estimate(pack_estimate(found[0])).coeffs_um.tolist() == found[0].coeffs_um.tolist()
    )
    counts = 1e3 * found[0].coeffs_um
    assert np.allclose(counts, np.rint(counts), atol=1e-6)  # whole nanometres
    assert 0.9 < found[-1].valid_fraction <= 1
    later = bench.frames(round(COVARIANCE_S * RATE_HZ))
    matrices = [id(e.covariance_um2) for e in (*found, *later)]
    assert len(set(matrices)) == 2  # the recorder stores a matrix once
    assert matrices.count(matrices[0]) == COVARIANCE_S * RATE_HZ


def test_a_rounded_term_is_no_minus_zero() -> None:
    """It is no whole number of nanometres to the recorder, which then stores all bits of every
    term.
    """
    frame = replace(
        rejected_frame(1.0, ""),
        coeffs_um=np.full(ZERNIKE_TERMS, -1e-4),
        hencky_um=0.0,
        sag_um=0.0,
        sag_change_sigma_um=0.0,
    )
    assert not np.signbit(_make_estimate(frame, math.nan, False, 1.0).coeffs_um).any()


def test_the_pattern_steps_at_first_and_then_now_and_then(bench: Bench) -> None:
    bench.frames(5 + round(2.6 * STEP_S * RATE_HZ))
    first = bench.shown[:5]
    assert len(set(first)) == 5
    assert {(p.role, p.index) for p in bench.shown} == {("crossed", 32)}
    changes = [k for k in range(6, len(bench.shown)) if bench.shown[k] != bench.shown[k - 1]]
    assert np.diff([5, *changes]).tolist() == pytest.approx([STEP_S * RATE_HZ] * 2, abs=1)
    turns = np.array([[p.shift_rad, p.shift_y_rad] for p in first]) * 5 / (2 * math.pi)
    assert turns.tolist() == [[0, 0], [1, 2], [2, 4], [3, 1], [4, 3]]


def test_a_camera_that_freezes_while_the_pattern_steps_is_frozen_and_no_knock(bench: Bench) -> None:
    """Where five steps renewed the light, the frozen frame fitted as
    a tilt by a fifth of a period.
    """
    steps = 0
    while steps < 10:
        assert bench.frame().verdict == "ok"
        steps += bench.tracker.pattern != bench.shown[-1]
    found = [bench.again(), bench.again(), bench.frame()]
    assert [(e.verdict, e.reason.split(":")[0]) for e in found] == [("rejected", "frozen")] * 2 + [
        ("ok", "")
    ]


def test_a_bent_response_of_the_panel_turns_no_tilt() -> None:
    """The reference's own harmonic stands where crossed fringes are four times finer: steps turned
    it into tilts.
    """
    bench = Bench(gamma=1.8)
    assert bench.full().verdict == "ok"
    found = bench.frames(5)
    assert "rejected" not in {e.verdict for e in found}, [e.reason for e in found]
    tilts_um = np.array([e.coeffs_um[1:3] for e in found])
    assert np.ptp(tilts_um, axis=0).max() < 0.15


@pytest.mark.campaign
def test_stains_that_come_while_tracking_move_no_figure_that_is_used(bench: Bench) -> None:
    """Stains of 65 mm bend the figure by 0.14 µm: their frames are not used until a full cycle."""
    rows, columns = np.mgrid[: OPTICS.camera.height_px, : OPTICS.camera.width_px]
    bench.frames(6)
    still = np.mean([e.coeffs_um for e in bench.frames(20)], axis=0)
    bench.stains = 1 + 0.04 * np.sin(rows / 2.4) * np.sin(columns / 2.6)
    stained = bench.frames(20)
    assert {e.verdict for e in stained} == {"degraded"}
    assert {e.reason.partition(":")[0] for e in stained} == {"stained"}
    assert stained[-1].tracking_lost  # a full cycle is asked for
    full = bench.full()
    assert full.verdict == "ok"
    followed = bench.frames(20)
    assert {e.verdict for e in followed} == {"ok"}
    moved_um = (np.mean([e.coeffs_um for e in followed], axis=0) - still)[1:]
    assert float(np.linalg.norm(moved_um)) < 0.07


def test_a_lost_order_is_reported_and_a_full_cycle_finds_it_again(bench: Bench) -> None:
    bench.frames(6)
    lost = bench.frames(round(LOST_S * RATE_HZ) + 1, 900.0)
    assert {e.verdict for e in lost} == {"rejected"}
    assert all(e.reason.startswith("order lost") for e in lost), lost[0].reason
    assert lost[-1].tracking_lost
    assert not any(e.tracking_lost for e in lost[:-2])
    full = bench.full(900.0)
    assert full.verdict == "ok"
    again = bench.frame(900.0)
    assert again.verdict == "ok"
    assert again.sag_um == pytest.approx(full.sag_um, abs=0.2)


def test_after_a_short_jump_the_frames_are_followed_again(bench: Bench) -> None:
    bench.frames(6)
    bench.frames(5, 900.0)
    found = bench.frames(round(LOST_S * RATE_HZ) + 5)
    assert {(e.verdict, e.tracking_lost) for e in found} == {("ok", False)}


def test_dark_frames_require_a_full_cycle_only_after_a_while(bench: Bench) -> None:
    assert {e.verdict for e in bench.frames(6)} == {"ok"}
    dark = bench.frames(round(REJECTED_S * RATE_HZ) + 1, gain=0.05)
    assert {e.reason.split(":")[0] for e in dark} == {"dark"}
    assert dark[-1].tracking_lost
    assert not any(e.tracking_lost for e in dark[:-2])


def held_um(seconds: float) -> NDArray[np.float64]:
    """Displacement of a held mirror at 50 Hz, once it has settled."""
    config = Config()
    plant = Plant(config.twin, config.pump)
    ticks = run_virtual(config, plant, 240.0 + seconds, zernike_projection())
    moved_um = np.array([plant.truth().displacement_um for _ in ticks])
    return moved_um[round(240.0 * config.loop.rate_hz) :] - moved_um[-1]


@pytest.mark.campaign
def test_a_hold_finds_the_films_vibrations_and_no_others() -> None:
    """Two minutes of the twin's film, as a hold moves it, vibrating by 20 nm at each of a drum's
    frequencies.
    """
    optics = OPTICS.model_copy(
        update={"camera": OPTICS.camera.model_copy(update={"bits": 12, "noise_adu": 1.0})}
    )
    tracker = LiveTracker(optics, LiveReconstructor(optics, 1), 32, step_s=10.0)
    modes = drum_modes(20.0)
    renderer = OpticsRenderer(optics, FILM, seed=3, modes=modes)
    film_um, listener, events = held_um(126.0), VibrationFollower(), []
    still = [
        renderer.render_picture(p, float(film_um[0]))
        for p in pattern_sequence.full_sequence(optics.pattern)
    ]
    assert tracker.measure_full(still, 0.1 * np.arange(18), np.full(18, math.nan)).verdict == "ok"
    time_s = 2.0
    while time_s < 125.0:
        picture = renderer.render_picture(
            tracker.pattern, float(film_um[round(50 * time_s)]), time_s=time_s
        )
        events += listener.add_estimate(
            tracker.measure_fringes([picture], np.array([time_s]), np.array([math.nan]))
        )
        time_s += tracker.interval_factor / 20
    assert len(events) == 2
    for heard in events:
        assert isinstance(heard, Vibrations)
        assert sorted(filter(None, heard.frequency_hz)) == pytest.approx([27, 48, 57, 61], abs=0.02)
        assert [nm for nm in heard.amplitude_nm if nm] == pytest.approx([20.0] * 4, rel=0.15)


def test_without_an_anchor_a_frame_is_rejected() -> None:
    found = Bench().frame()
    assert (found.kind, found.verdict, found.tracking_lost) == ("track", "rejected", True)


def test_a_pattern_too_fine_for_the_camera_is_reported() -> None:
    bench = Bench()
    bench.tracker = LiveTracker(OPTICS, LiveReconstructor(OPTICS, 1), 200, STEP_S)
    found = bench.full()
    assert (found.kind, found.verdict) == ("full", "rejected")
    assert "pixels a fringe" in found.reason
