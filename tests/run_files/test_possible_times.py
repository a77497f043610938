"""Times that no row of a file can have are left out, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.run_files.column_reader import possible_times


@pytest.mark.parametrize("wrong", [1e15, -1e9, np.inf, -np.inf, np.nan])
@pytest.mark.parametrize("place", [0, 7, 19])
def test_one_wrong_time_is_left_out(wrong: float, place: int) -> None:
    time_s = 3600.0 * 24 * 20 + np.arange(20) * 0.1
    time_s[place] = wrong
    assert np.flatnonzero(~possible_times(time_s)).tolist() == [place]


def test_six_hours_with_a_gap_are_possible() -> None:
    time_s = np.concatenate((np.arange(100.0), 6 * 3600 + np.arange(10.0)))
    assert possible_times(time_s).all()


def test_nothing_and_nothing_finite() -> None:
    assert possible_times(np.empty(0)).size == 0
    assert not possible_times(np.full(3, np.nan)).any()
