"""Lines end where the record does."""

from __future__ import annotations

import numpy as np

from membrane_ctrl.review.report.figures import broken_at_gaps


def test_a_missing_hour_breaks_the_line_and_a_missing_second_does_not() -> None:
    time_s = np.concatenate(
        (np.arange(0.0, 100.0), np.arange(101.0, 200.0), np.arange(3800.0, 3900.0))
    )
    broken = broken_at_gaps(
        {"time_s": time_s, "error_um": np.ones(time_s.size), "both": np.ones((time_s.size, 2))}
    )
    (place,) = np.flatnonzero(np.isnan(broken["error_um"]))
    assert broken["time_s"][place] == (199.0 + 3800.0) / 2
    assert np.isnan(broken["both"][place]).all()
    assert broken["both"].shape == (time_s.size + 1, 2)
    assert (np.diff(broken["time_s"]) > 0).all()


def test_cycles_with_minutes_between_them_have_no_gap() -> None:
    for time_s in (np.empty(0), np.array([3.0]), np.arange(0.0, 3600.0, 60.0)):
        np.testing.assert_array_equal(broken_at_gaps({"time_s": time_s})["time_s"], time_s)
