"""Full cycles state how well the geometry is known, as `measure` does of a set."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from membrane_ctrl.acquisition.geometry_watch import StatementWatch
from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.calibration.geometry_tables import general_form
from membrane_ctrl.metrology.cycle.live_reconstructor import LiveReconstructor
from membrane_ctrl.metrology.phase.pattern_sequence import fringe_sequence, full_sequence
from membrane_ctrl.metrology.rays.bench_parameters import NAMES
from membrane_ctrl.metrology.rays.bench_poses import bench_at
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.uncertainty.geometry_spread import (
    PAPER_SPREAD,
    GeometrySpread,
    KnownBy,
)
from membrane_ctrl.metrology.uncertainty.geometry_statement import GeometryState
from membrane_ctrl.model import acquisition_events
from membrane_ctrl.model.event_base import LogLevel
from membrane_ctrl.sim.optics.camera import OpticsRenderer
from membrane_ctrl.sim.optics.film_shape import FilmShape, Wrinkle, typical_film
from tests.support.metrology_truth import SMALL

TRUE = OpticsConfig(camera=SMALL)
FILM = typical_film(37.1, 500.0, seed=3)
Cycle = tuple[list[np.ndarray], np.ndarray, np.ndarray]


@cache
def cycles(film: FilmShape = FILM) -> tuple[Cycle, Cycle]:
    """Frames, times and readings of a full and a fringes-only cycle of the true bench."""
    renderer = OpticsRenderer(TRUE, film, seed=5)
    taken = []
    for patterns in (full_sequence(TRUE.pattern), fringe_sequence(TRUE.pattern)):
        frames = [renderer.render_picture(pattern, 0.0).copy() for pattern in patterns]
        taken.append((frames, 0.1 * np.arange(len(frames)), np.zeros(len(frames))))
    return taken[0], taken[1]


def misstated(name: str, amount: float) -> OpticsConfig:
    """The bench as it would be stated by somebody who got one number wrong."""
    values = amount * (np.array(NAMES) == name)
    there = bench_at(Geometry.from_config(TRUE), values).geometry
    return TRUE.model_copy(update={"geometry": general_form(there, TRUE)})


def test_a_bench_measured_by_hand_is_uncalibrated_and_ok() -> None:
    live = LiveReconstructor(TRUE, 1, spread=PAPER_SPREAD, known_by=KnownBy.STATED, source="rulers")
    assert live.geometry_statement is None
    full, fringes = cycles()
    assert live.measure_full(*full).verdict == "ok"
    statement = live.geometry_statement
    assert statement is not None
    assert statement.state is GeometryState.UNCALIBRATED
    assert statement.rim is not None
    assert abs(statement.rim.offset_mm) < 2.0
    assert statement.slopes.seen_urad < statement.slopes.explained_urad
    assert live.measure_fringes(*fringes).verdict == "ok"


def test_a_covariance_from_a_calibration_makes_it_calibrated() -> None:
    live = LiveReconstructor(TRUE, 1, spread=PAPER_SPREAD, known_by=KnownBy.CALIBRATION)
    live.measure_full(*cycles()[0])
    assert live.geometry_statement is not None
    assert live.geometry_statement.state is GeometryState.CALIBRATED


@pytest.mark.parametrize(
    ("name", "amount", "message"),
    [("camera_yaw_deg", 1.5, "the rim is"), ("camera_roll_deg", 2.0, "belong to no surface")],
)
def test_a_geometry_that_the_frames_contradict_degrades_both_kinds_of_cycle(
    name: str, amount: float, message: str
) -> None:
    tight = GeometrySpread(PAPER_SPREAD.names, 1e-2 * PAPER_SPREAD.covariance)
    live = LiveReconstructor(misstated(name, amount), 1, spread=tight, known_by=KnownBy.CALIBRATION)
    full, fringes = cycles()
    for estimate in (live.measure_full(*full), live.measure_fringes(*fringes)):
        assert estimate.verdict == "degraded"
        assert message in estimate.reason
    statement = live.geometry_statement
    assert statement is not None
    assert statement.state is GeometryState.CONTRADICTED
    event = StatementWatch().check_statement(statement)
    assert isinstance(event, acquisition_events.GeometryKnown)
    assert "the camera shifted along its axis by 10 µm" in event.assumed
    assert "the focal length changed by 1 ppm" in event.assumed
    assert event.level is LogLevel.WARNING
    assert event.why is not None


def test_wrinkles_of_the_film_do_not_contradict_the_geometry() -> None:
    """Their slopes are those of a surface."""
    wrinkled = replace(FILM, wrinkles=(Wrinkle(60.0, 12),))
    tight = GeometrySpread(PAPER_SPREAD.names, 1e-4 * PAPER_SPREAD.covariance)
    live = LiveReconstructor(TRUE, 1, spread=tight)
    live.measure_full(*cycles(wrinkled)[0])
    statement = live.geometry_statement
    assert statement is not None
    assert not statement.slopes.contradicts


def test_the_statement_is_reported_when_it_changes() -> None:
    live = LiveReconstructor(TRUE, 1, spread=PAPER_SPREAD, known_by=KnownBy.STATED, source="rulers")
    watch = StatementWatch()
    assert watch.check_statement(live.geometry_statement) is None
    live.measure_full(*cycles()[0])
    event = watch.check_statement(live.geometry_statement)
    assert isinstance(event, acquisition_events.GeometryKnown)
    assert (event.state, event.source, event.level) == ("uncalibrated", "rulers", LogLevel.INFO)
    assert watch.check_statement(live.geometry_statement) is None
