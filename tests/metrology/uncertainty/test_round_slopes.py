"""The round part of residual slopes, beside waves that are a thousand times larger."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from membrane_ctrl.metrology.uncertainty.round_slopes import RoundSlopes

FloatArray = NDArray[np.float64]
REACH_MM = 475.0


def points(seed: int, count: int = 40_000) -> FloatArray:
    """Places on the disc, denser on one side, as a camera that looks at an angle has them."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-REACH_MM, REACH_MM, (2, 2 * count))
    inside = np.hypot(*places) < REACH_MM
    denser = rng.random(2 * count) < 0.8 + 0.2 * places[0] / REACH_MM
    return places[:, inside & denser]


def wave_slopes(places: FloatArray, amplitude_mm: float, lobes: int) -> FloatArray:
    """Slopes of amplitude Re((x + iy) / R)^lobes."""
    z = (places[0] + 1j * places[1]) / REACH_MM
    by_z = amplitude_mm * lobes / REACH_MM * z ** (lobes - 1)
    return np.stack([by_z.real, -by_z.imag])


def round_slopes(places: FloatArray) -> FloatArray:
    """A radial slope of 2 µrad at the rim, as (r / R)^9."""
    radius = np.hypot(*places)
    return np.asarray(2e-6 * (radius / REACH_MM) ** 9 * places / radius)


@pytest.mark.parametrize(("amplitude_mm", "lobes"), [(0.06, 12), (0.02, 25), (0.3, 5)])
def test_waves_cancel_in_a_ring(amplitude_mm: float, lobes: int) -> None:
    places = points(1)
    slopes = round_slopes(places) + wave_slopes(places, amplitude_mm, lobes)
    rings = RoundSlopes.from_points(places, np.ones(places.shape[1]), slopes, REACH_MM)
    middle = (rings.inner_mm + rings.outer_mm) / 2
    true = 2e-6 * (middle / REACH_MM) ** 9
    assert np.abs((rings.slope - true) / np.maximum(rings.sigma, 1e-8)).max() < 8.0
    # what a plain mean over the points leaves of the wave is far larger
    radius = np.hypot(*places)
    outer = radius > rings.inner_mm[-1]
    plain = np.mean(np.sum(slopes * places, axis=0)[outer] / radius[outer])
    assert abs(rings.slope[-1] - true[-1]) < 0.3 * abs(plain - true[-1])


def test_white_noise_is_stated() -> None:
    places, rng = points(2), np.random.default_rng(3)
    count = np.full(places.shape[1], 4.0)
    z = []
    for _ in range(20):
        slopes = 1e-5 / 2 * rng.standard_normal(places.shape)
        rings = RoundSlopes.from_points(places, count, slopes, REACH_MM)
        z.append(rings.slope / rings.sigma)
        assert np.sqrt(rings.share).mean() * 1e-5 == pytest.approx(rings.sigma.mean(), rel=0.4)
    assert np.sqrt(np.mean(np.square(z))) == pytest.approx(1.1, abs=0.25)


def test_a_wave_that_looks_round_in_every_fourth_sector_is_in_the_sigma() -> None:
    """18 lobes have the same phase in all sectors of a group."""
    places = points(4)
    radius, theta = np.hypot(*places), np.arctan2(places[1], places[0])
    slopes = 1e-4 * np.cos(18 * theta) * (radius / REACH_MM) ** 3 * places / radius
    rings = RoundSlopes.from_points(places, np.ones(places.shape[1]), slopes, REACH_MM)
    assert np.all(np.abs(rings.slope) < 4 * rings.sigma + 1e-9)


def test_rings_that_are_partly_hidden() -> None:
    places = points(5)
    hidden = (np.hypot(*places) > 400) & (np.abs(np.arctan2(places[1], places[0])) > 0.2)
    count = np.where(hidden, 0.0, 1.0)
    rings = RoundSlopes.from_points(places, count, round_slopes(places), REACH_MM)
    middle = (rings.inner_mm + rings.outer_mm) / 2
    assert rings.slope == pytest.approx(2e-6 * (middle / REACH_MM) ** 9, abs=3e-7)
    assert np.isfinite(rings.slope).all()
    assert np.isfinite(rings.sigma).all()
