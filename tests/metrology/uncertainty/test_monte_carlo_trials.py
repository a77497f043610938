"""Cheap trials against whole measurements with new noise, and with another geometry."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.figure.bin_figure import BinFigure, bin_figure
from membrane_ctrl.metrology.frame_checks.checked_set import Checked
from membrane_ctrl.metrology.frame_checks.set_check import check_set
from membrane_ctrl.metrology.phase.frame_stack import FrameStack
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.metrology.uncertainty.geometry_spread import (
    PAPER_SPREAD,
    GeometrySpread,
    change_geometry,
)
from membrane_ctrl.metrology.uncertainty.height_map import HeightMap
from membrane_ctrl.metrology.uncertainty.linear_covariance import (
    geometry_covariance,
    geometry_jacobian,
    linear_covariance,
    noise_covariance,
)
from membrane_ctrl.metrology.uncertainty.monte_carlo import run_trials, trial_covariance
from membrane_ctrl.metrology.uncertainty.trial_bench import TrialBench
from membrane_ctrl.sim.optics.camera import OpticsRenderer
from tests.support.rendered_sets import FILM, bench, patterns, stack_of

OPTICS = bench()
MAP = HeightMap.over_disc(475.0, 500.0, 41)
NO_SPREAD = GeometrySpread((), np.zeros((0, 0)))


@cache
def _renderer() -> OpticsRenderer:
    return OpticsRenderer(OPTICS, FILM, seed=4)


def _stack(displacement_um: float = 0.0, frames: str = "full") -> FrameStack:
    """A set as the camera sees it, with noise that is new each time."""
    shown = [p for p in patterns(OPTICS) if frames == "full" or p.role == "sin"]
    pictures = np.stack([_renderer().render_picture(p, displacement_um) for p in shown])
    return stack_of(pictures, shown, np.full(len(shown), displacement_um))


@cache
def _first() -> tuple[Checked, BinFigure]:
    checked = check_set(_stack(), OPTICS)
    return checked, bin_figure(OPTICS, checked)


def _bench(displacement_um: float = 0.0) -> TrialBench:
    checked, figure = _first()
    if displacement_um:
        checked = check_set(_stack(displacement_um, "fringes"), _anchored(), checked.make_anchor())
        figure = bin_figure(_anchored(), checked)
    return TrialBench.from_set(OPTICS, checked, figure)


def _anchored() -> OpticsConfig:
    return OPTICS.model_copy(
        update={"geometry": OPTICS.geometry.model_copy(update={"reference_displacement_um": 0.0})}
    )


def test_figure_of_the_bins_is_the_film() -> None:
    x, y = np.meshgrid(MAP.axis_mm, MAP.axis_mm)
    error_um = 1e3 * (
        MAP.matrix @ _first()[1].fit.surface.parameters - FILM.height_mm(x, y, 0.0)[MAP.inside]
    )
    assert (
        np.sqrt(np.mean(error_um**2)) < 0.06
    )  # three times the noise of 1/64 of the real sensor's pixels


def test_figure_of_a_moving_film() -> None:
    """5 µm at 0.3 Hz over the 8 frames, with the laser's readings."""
    shown = [p for p in patterns(OPTICS) if p.role == "sin"]
    where_um = 5 * np.sin(2 * np.pi * 0.3 * 0.1 * np.arange(8))
    frames = np.stack(
        [_renderer().render_picture(p, float(d)) for p, d in zip(shown, where_um, strict=True)]
    )
    x, y = np.meshgrid(MAP.axis_mm, MAP.axis_mm)
    errors = {}
    for laser in (True, False):
        stack = stack_of(frames, shown, where_um if laser else None)
        figure = bin_figure(_anchored(), check_set(stack, _anchored(), _first()[0].make_anchor()))
        truth = FILM.height_mm(x, y, float(where_um.mean()))[MAP.inside]
        errors[laser] = np.sqrt(
            np.mean(np.square(1e3 * (MAP.matrix @ figure.fit.surface.parameters - truth)))
        )
    assert errors[True] < 0.1
    assert errors[False] > 3 * errors[True]


@pytest.mark.campaign
def test_noise_is_that_of_whole_measurements() -> None:
    """Variances of the 36 parameters over 24 sets with new pixel noise, against those of 600
    trials.
    """
    anchor = _first()[0].make_anchor()
    whole = []
    for _ in range(24):
        checked = check_set(_stack(frames="fringes"), OPTICS, anchor)
        whole.append(bin_figure(OPTICS, checked).fit.surface.parameters)
    cheap = run_trials([_bench()], NO_SPREAD, 3, range(600))[:, 0]
    ratio = np.var(whole, axis=0, ddof=1) / np.var(cheap, axis=0, ddof=1)
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.2)
    rmse = [MAP.sigma(trial_covariance(np.array(p))).mean() for p in (whole, cheap)]
    assert rmse[0] == pytest.approx(rmse[1], rel=0.15)
    assert (
        1e6 * rmse[0] / 8 <= 10
    )  # nm: repeatability with the real sensor's 64 times as many pixels


def test_thinned_points_have_the_noise_of_all() -> None:
    checked, figure = _first()
    sigmas = [
        MAP.sigma(noise_covariance(TrialBench.from_set(OPTICS, checked, figure, count))).mean()
        for count in (1500, 10**9)
    ]
    assert sigmas[0] == pytest.approx(sigmas[1], rel=0.05)


def test_geometry_is_that_of_a_whole_measurement() -> None:
    """The same frames measured under another geometry: the trial with that geometry finds the same
    change.
    """
    change = np.array([2.0, -2.0, 0.3])
    other = OPTICS.model_copy(
        update={"geometry": change_geometry(OPTICS.geometry, PAPER_SPREAD.names, change)}
    )
    checked, figure = _first()
    there = (
        bin_figure(other, check_set(checked.stack, other)).fit.surface.parameters
        - figure.fit.surface.parameters
    )
    trial = _bench()
    cheap = trial.solve(trial.geometry(PAPER_SPREAD.names, change)) - trial.surface.parameters
    assert np.abs(MAP.matrix @ there).max() > 0.03
    # the analysis radius cuts other pixels off: 1 % of the change
    assert np.abs(MAP.matrix @ (there - cheap)).max() < 0.01 * np.abs(MAP.matrix @ there).max()


def test_trials_repeat_whatever_the_batches() -> None:
    trial = _bench()
    whole = run_trials([trial, trial], PAPER_SPREAD, 5, range(6), first_set=7)
    parts = [run_trials([trial], PAPER_SPREAD, 5, [t], first_set=8)[0, 0] for t in (5, 0, 3)]
    assert np.abs(whole[[5, 0, 3], 1] - parts).max() < 1e-12  # mm: the rounding of sums
    assert np.abs(whole[:, 0] - whole[:, 1]).max() > 1e-6  # noise differs from set to set
    assert (
        np.abs(whole - run_trials([trial, trial], PAPER_SPREAD, 6, range(6), first_set=7)).max()
        > 1e-4
    )


@pytest.mark.parametrize(
    ("count", "within"), [(150, 0.3), pytest.param(1500, 0.1, marks=pytest.mark.campaign)]
)
def test_linear_covariance_is_that_of_the_monte_carlo(count: int, within: float) -> None:
    trial = _bench()
    sampled = MAP.sigma(trial_covariance(run_trials([trial], PAPER_SPREAD, 1, range(count))[:, 0]))
    linear = MAP.sigma(linear_covariance([trial], PAPER_SPREAD))
    seen = sampled > 1e-6  # all but the vertex
    assert np.abs(linear[seen] / sampled[seen] - 1).max() < within
    noise = MAP.sigma(trial_covariance(run_trials([trial], NO_SPREAD, 1, range(count))[:, 0]))
    assert np.abs(MAP.sigma(noise_covariance(trial))[seen] / noise[seen] - 1).max() < within


@pytest.mark.campaign
def test_the_papers_figures() -> None:
    """Absolute: the largest is the paper's 50 µm, the mean half of its 24.8. Pairs: geometry
    cancels (docs).
    """
    sets = [_bench(), _bench(20.0)]
    trials = run_trials(sets, PAPER_SPREAD, 1, range(1000))
    absolute_um = 1e3 * MAP.sigma(trial_covariance(trials[:, 0]))
    pair_um = 1e3 * MAP.sigma(trial_covariance(trials[:, 1] - trials[:, 0]))
    assert absolute_um.mean() == pytest.approx(12.5, rel=0.1)
    assert absolute_um.max() == pytest.approx(46, rel=0.1)
    assert pair_um.mean() < 0.05
    linear_um = 1e3 * MAP.sigma(linear_covariance(sets, PAPER_SPREAD))
    assert linear_um.mean() == pytest.approx(pair_um.mean(), rel=0.1)


def test_what_a_wrong_geometry_does_to_a_change_is_in_proportion_to_it() -> None:
    """300 µm deeper: without noise the geometry alone is some 1e-3 of the change."""
    sets = [_bench(), _bench(300.0)]
    jacobian = geometry_jacobian(sets[1], PAPER_SPREAD) - geometry_jacobian(sets[0], PAPER_SPREAD)
    pair_um = 1e3 * MAP.sigma(geometry_covariance(jacobian, PAPER_SPREAD))
    assert 0.05 < pair_um.max() < 1.0


def test_a_map_of_the_covariance_is_the_spread_of_the_heights() -> None:
    parameters = run_trials([_bench()], PAPER_SPREAD, 2, range(20))[:, 0]
    heights = np.stack([Surface.from_parameters(p, 500.0).height(*_inside()) for p in parameters])
    assert MAP.sigma(trial_covariance(parameters)) == pytest.approx(
        heights.std(axis=0, ddof=1), abs=1e-10
    )
    picture = MAP.picture(heights[0])
    assert np.isnan(picture[0, 0])
    assert picture[20, 20] == pytest.approx(0, abs=1e-12)  # the vertex


def _inside() -> tuple[np.ndarray, np.ndarray]:
    x, y = np.meshgrid(MAP.axis_mm, MAP.axis_mm)
    return x[MAP.inside], y[MAP.inside]


def test_a_spread_too_wide() -> None:
    with pytest.raises(ArithmeticError, match="too wide"):
        run_trials([_bench()], GeometrySpread.from_sigmas({"alpha_deg": 60.0}), 1, range(20))
