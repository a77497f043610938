"""Sets of phases of a film of the second world on a bench that is off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.metrology.rays.bench_parameters import NAMES
from membrane_ctrl.metrology.rays.bench_poses import BenchGeometry, bench_at
from membrane_ctrl.metrology.rays.set_phases import SetPhases
from membrane_ctrl.metrology.rays.turned_mirror import TurnedMirror
from tests.support.calibration_truth import (
    NOMINAL_MM,
    PIXEL_SIGMA_MM,
    PIXELS,
    SAGS_MM,
    STATED,
    Truth,
)
from tests.worlds.second_optics import Mirror

FloatArray = NDArray[np.float64]
RADIUS_MM = 500.0


@dataclass(frozen=True)
class TurnedSet:
    """A mirror as it is seated, and what its set states of that."""

    mirror: Mirror
    stated: TurnedMirror | None


_REACH_MM = 475.0


def make_foreign_film(
    mirror: Mirror,
    values: FloatArray,
    seed: int,
    points: int = 600,
    sags_mm: tuple[float, ...] = SAGS_MM,
    turned: Sequence[TurnedSet] = (),
) -> Truth:
    """Sets with as few points as that and the information of all pixels. The bow must be 0.

    `turned` are sets of the mirror as it is seated there, at the sag of the middle set.
    """
    rng = np.random.default_rng(seed)
    sigma_mm = PIXEL_SIGMA_MM * np.sqrt(points / PIXELS)
    bench = bench_at(STATED, values)
    sets = []
    usual = [TurnedSet(mirror, None)] * len(sags_mm)
    seen_at_mm = [*sags_mm, *[sags_mm[len(sags_mm) // 2]] * len(turned)]
    for k, (sag_mm, seated) in enumerate(zip(seen_at_mm, [*usual, *turned], strict=True)):
        moved_um = 1e3 * (sag_mm - NOMINAL_MM)
        column, row = (rng.uniform(0, size, int(points / 0.43)) for size in (2447, 2047))
        seen, inside = _trace(bench, seated.mirror, moved_um, column, row)
        seen = seen + rng.normal(0, sigma_mm, seen.shape)
        reading_um = moved_um / (1 + values[NAMES.index("laser_relative")]) + rng.normal(0, 1.0)
        sigmas_mm = np.full(seen.shape[1], sigma_mm)
        place = column[inside], row[inside]
        phases = SetPhases(f"set{k}", *place, seen, sigmas_mm, reading_um, turned=seated.stated)
        sets.append(phases)
    return Truth(values, mirror, tuple(sets))


def _trace(
    bench: BenchGeometry, mirror: Mirror, moved_um: float, column: FloatArray, row: FloatArray
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Screen points (2, n) of the rays that meet the film inside 475 mm, and which those are."""
    geometry = bench.geometry
    rays = geometry.rays(column, row)
    start = geometry.pinhole_mm[:, None]
    t = (NOMINAL_MM - start[2]) / rays[2]
    reaches = np.flatnonzero(np.hypot(*(start + t * rays)[:2]) < RADIUS_MM)
    rays, t = rays[:, reaches], t[reaches]
    for _ in range(5):
        place = start + t * rays
        height_mm, normal = mirror.surface_mm(place[0], place[1], moved_um)
        t = t - (place[2] + 1e-3 * moved_um - height_mm) / np.sum(rays * normal, axis=0)
    place = start + t * rays
    _, normal = mirror.surface_mm(place[0], place[1], moved_um)
    leaves = rays - 2 * np.sum(rays * normal, axis=0) / np.sum(normal**2, axis=0) * normal
    axes = geometry.screen_axes
    from_screen = place - geometry.screen_origin_mm[:, None]
    reach = -(axes[2] @ from_screen) / (axes[2] @ leaves)
    met = np.hypot(place[0], place[1]) < _REACH_MM
    inside = np.zeros(column.size, bool)
    inside[reaches[met]] = True
    return (axes[:2] @ (from_screen + reach * leaves))[:, met] / bench.pitch, inside
