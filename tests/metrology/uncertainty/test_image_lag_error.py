"""The budget's row of the previous picture in a change between a full set and one of fringes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from membrane_ctrl.config.optics import OpticsConfig
from membrane_ctrl.metrology.phase.frame_stack import FrameStack
from membrane_ctrl.metrology.phase.pattern_sequence import (
    Pattern,
    fringe_sequence,
    full_sequence,
)
from membrane_ctrl.metrology.rays.surface import PARAMETERS
from membrane_ctrl.metrology.uncertainty.budget import Budget, Source
from membrane_ctrl.metrology.uncertainty.image_lag_error import _order_by_fringes

PATTERN = OpticsConfig().pattern


def make_stack(patterns: Sequence[Pattern]) -> FrameStack:
    frames = np.empty((len(patterns), 0, 0), np.uint8)
    return FrameStack(frames, tuple(patterns), np.zeros(len(patterns)), {})


def make_source(columns: np.ndarray) -> Source:
    effects_mm = np.zeros((PARAMETERS, columns.size))
    effects_mm[0] = columns
    return Source("image_lag_share", "the previous picture", 1.0, effects_mm, common=False)


def test_frames_of_fringes_have_the_same_place_with_and_without_gray_code() -> None:
    full, fringes = full_sequence(PATTERN), fringe_sequence(PATTERN)
    place = {pattern: float(number + 1) for number, pattern in enumerate(full)}
    ordered = []
    for patterns in (full, fringes):
        rise = np.array([place[pattern] for pattern in patterns])
        ordered.append(_order_by_fringes(np.concatenate([rise, -rise]), make_stack(patterns)))
    of_full, of_fringes = ordered
    assert of_full.size == 2 * len(full)
    np.testing.assert_array_equal(of_full[: of_fringes.size], of_fringes)


def test_only_frames_that_one_set_lacks_stay_in_the_change() -> None:
    full = Budget((make_source(np.array([3.0, 4.0, 5.0, 12.0])),), 1.0)
    fringes = Budget((make_source(np.array([3.0, 4.0])),), 1.0)
    for later, earlier in ((full, fringes), (fringes, full)):
        covariance_mm2 = later.steady_change_covariance(earlier)
        assert covariance_mm2[0, 0] == pytest.approx(5.0**2 + 12.0**2)
