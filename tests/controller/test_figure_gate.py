"""Which figures of the mirror are used, and the reason for which the others are not."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from membrane_ctrl.config.schema import Config
from membrane_ctrl.controller.figure_gate import FigureDefect, FigureGate
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from tests.worlds.sound_figure import SOUND_FIGURE

CONFIG = Config()
SAG_UM = 1e3 * CONFIG.optics.mirror.sag_mm


def judge(figure: ShapeEstimate) -> FigureDefect | None:
    gate = FigureGate(CONFIG)
    gate.judge_figure(10.0, figure, laser_um=0.0)
    assert (gate.accepted is None) is (gate.memory.defect is not None)
    return gate.memory.defect


@pytest.mark.parametrize("factor", [0.51, 1.0, 1.99])
def test_a_sag_within_a_factor_of_two_of_the_configured_one_counts(factor: float) -> None:
    assert judge(replace(SOUND_FIGURE, sag_um=factor * SAG_UM)) is None


@pytest.mark.parametrize("factor", [-1.0, 0.0, 1e-3, 0.49, 2.01, 1e3])
def test_the_figure_of_another_mirror_or_in_another_unit_does_not_count(factor: float) -> None:
    assert judge(replace(SOUND_FIGURE, sag_um=factor * SAG_UM)) is FigureDefect.OTHER_MIRROR


@pytest.mark.parametrize("sag_um", [math.nan, math.inf, -math.inf])
def test_a_sag_that_is_no_number_does_not_count(sag_um: float) -> None:
    assert judge(replace(SOUND_FIGURE, sag_um=sag_um)) is FigureDefect.NOT_FINITE


@pytest.mark.parametrize("sigma_um", [math.nan, -1.0, 1.01 * CONFIG.limits.band_um, math.inf])
def test_a_figure_less_certain_than_the_band_does_not_count(sigma_um: float) -> None:
    assert judge(replace(SOUND_FIGURE, sag_change_sigma_um=sigma_um)) is FigureDefect.SIGMA


@pytest.mark.parametrize("time_s", [10.001, math.nan, math.inf])
def test_a_figure_of_the_future_does_not_count(time_s: float) -> None:
    assert judge(replace(SOUND_FIGURE, time_s=time_s)) is FigureDefect.TIME


def test_each_figure_counts_once() -> None:
    gate = FigureGate(CONFIG)
    gate.judge_figure(10.0, SOUND_FIGURE, laser_um=0.0)
    gate.judge_figure(10.1, SOUND_FIGURE, laser_um=0.0)
    assert gate.memory.defect is FigureDefect.TIME
    assert gate.accepted is None
