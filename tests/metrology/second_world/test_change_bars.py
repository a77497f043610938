"""Bars of changes and of light effects that were wider than the error, in the second world."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from tests.studies.second_world_budget import BY_DESCRIPTION, QUIET, STILL, compare
from tests.studies.second_world_errors import MeasuredSurface, measure_surface
from tests.worlds.second_optics import Bench, Mirror, Panel, Sensor, Stated, World

EIGHTH = 0.125
FINE = Stated(sigma_share=0.01)


def measured_set(
    folder: Path, panel: Panel, laser: bool = True, sensor: Sensor = QUIET, seed: int = 0
) -> MeasuredSurface:
    """A set of a still film, on a bench that is known to a hundredth."""
    effects = replace(STILL, panel=panel, laser=laser, sensor=sensor)
    World(Mirror(), Bench.paper(EIGHTH), effects, FINE, seed).write_set(folder, 0.0)
    return measure_surface(folder)


def row_um(found: MeasuredSurface, name: str) -> float:
    """Height of a row of the budget, RMS."""
    return float(next(row["height_rms_um"] for row in found.rows if row["name"] == name))


def test_slopes_of_patches_that_look_like_motion_cancel_in_a_change(tmp_path: Path) -> None:
    """A gamma leaves the same slopes in two sets. They hide 3 µm of motion from x to y in each set
    but not the change between the two.
    """
    panel = Panel(gamma=1.6)
    noisy = Sensor(read_adu=0.4)
    first = measured_set(tmp_path / "first", panel, laser=False, sensor=noisy, seed=1)
    second = measured_set(tmp_path / "second", panel, laser=False, sensor=noisy, seed=2)
    before = {source.name: source for source in first.budget.sources}
    own = next(source for source in second.budget.sources if source.name == "film_patches_um")
    effects_mm = np.concatenate(own.list_change_effects(before["film_patches_um"]), axis=1)
    change_um = second.budget.compute_sigmas_um(effects_mm @ effects_mm.T)["height_rms_um"]
    assert row_um(second, "film_patches_um") > 0.2
    assert change_um < 0.25 * row_um(second, "film_patches_um")


def test_less_contrast_at_the_edge_hides_no_second_image_and_no_previous_picture(
    tmp_path: Path,
) -> None:
    """The contrast varies slowly over the mirror: the frames' own pattern explains it."""
    found = measured_set(tmp_path, Panel(contrast_falloff=0.12))
    assert row_um(found, "second_image") < 0.04
    assert row_um(found, "image_lag_share") < 0.04


def test_motion_that_a_bench_by_hand_corrects_is_off_by_its_row() -> None:
    plant = BY_DESCRIPTION["film 50 µm deeper in y, with laser, benches off at random"]
    found = compare(replace(plant, trials=3), EIGHTH)
    assert found.caused_um > 0.3
    assert 1 / 2 < found.ratio < 2  # three trials
