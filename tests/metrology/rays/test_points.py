"""Measured points: parts of them, and some of them alone."""

from __future__ import annotations

import numpy as np

from membrane_ctrl.metrology.rays.ray_tracing import Points


def make_points() -> Points:
    """Ten points whose arrays name their columns."""
    column = np.arange(10.0)
    return Points(
        rays=column + np.array([[0.0], [100.0], [200.0]]),
        screen_mm=column + np.array([[300.0], [400.0]]),
        weights=column + 500,
        t_mm=column + 600,
    )


def test_keep_leaves_the_points_of_a_subset() -> None:
    kept = np.array([1, 4, 9])
    subset = make_points().subset(kept)
    points = make_points()
    points.keep(kept)
    for name in ("rays", "screen_mm", "weights", "t_mm"):
        assert np.array_equal(getattr(points, name), getattr(subset, name))
        assert (getattr(subset, name)[..., 1] % 100 == 4).all()
        assert getattr(points, name).flags.c_contiguous


def test_parts_cover_all_points_in_their_order() -> None:
    points = make_points()
    found = np.concatenate([some.t_mm for _, some in points.parts(4)])
    assert np.array_equal(found, points.t_mm)
    assert [some.t_mm.size for _, some in points.parts(4)] == [4, 4, 2]
    for part, some in points.parts(4):
        assert np.array_equal(some.rays, points.rays[:, part])
        assert some.rays.flags.c_contiguous
