"""The drawn laboratories have the flaws that they state, and their table names the misses."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from firmware_iface.emulators.pump_board import BoardSample
from tests.studies.laboratory_notes import describe_causes
from tests.studies.laboratory_sessions import (
    ended_well,
    format_page,
    is_held,
    list_misses,
    open_hold,
)
from tests.worlds.drawn_laboratories import (
    ACTUATORS,
    DrawnPlant,
    LaserFlaws,
    Room,
    ThresholdPump,
    draw_laboratory,
)
from tests.worlds.foreign_plant import ForeignPump

CALM = Room(weather=0.1, gusts=False)


def read(room: Room, flaws: LaserFlaws, count: int = 2000) -> list[BoardSample]:
    """Samples of a plant whose pump balances its leak, every 50 ms."""
    plant = DrawnPlant(ForeignPump(), 3, room, flaws, 1.24, 0.1, True)
    samples = []
    for _ in range(count):
        plant.advance(0.05)
        samples.append(plant.sample())
    return samples


def test_a_laboratory_is_drawn_from_its_seed_and_every_kind_is_drawn() -> None:
    drawn = [draw_laboratory(seed) for seed in range(60)]
    assert drawn[7] == draw_laboratory(7)
    assert {each.actuator for each in drawn} == set(ACTUATORS)
    assert all(each.full_um_per_s / each.leak_um_per_s >= 1.29 for each in drawn)
    for flaw in ("lost samples", "gaps", "own pace", "1/f noise", "doors", "mount bends", "gusty"):
        assert 3 < sum(flaw in each.describe() for each in drawn) < 50, flaw


def test_a_laser_of_its_own_pace_repeats_its_samples() -> None:
    counters = [sample.sample_counter for sample in read(CALM, LaserFlaws(pace_s=0.1))]
    assert len(set(counters)) == pytest.approx(1000, abs=2)


def test_gaps_last_80_ms_and_single_samples_are_lost() -> None:
    gaps = read(CALM, LaserFlaws(gap_every_s=5.0))
    dark = np.isnan([sample.displacement_um for sample in gaps])
    edges = np.flatnonzero(np.diff(dark.astype(int)))
    lengths = edges[1::2] - edges[: edges[1::2].size * 2 : 2]
    assert 8 < lengths.size < 40
    assert set(lengths.tolist()) <= {2, 3}
    lost = np.isnan([sample.displacement_um for sample in read(CALM, LaserFlaws(lost_share=0.01))])
    assert 8 < lost.sum() < 40


def test_flicker_and_coarse_steps_are_in_the_reading_alone() -> None:
    plain, noisy, coarse = (
        np.array([sample.displacement_um for sample in read(CALM, flaws, 400)])
        for flaws in (LaserFlaws(), LaserFlaws(flicker_um=2.0), LaserFlaws(step_um=0.5))
    )
    assert np.std(noisy - plain) > 0.5
    assert np.allclose(coarse / 0.5, np.round(coarse / 0.5))
    assert np.abs(coarse - plain).max() <= 0.26


def test_doors_ring_in_the_pressure_and_a_warm_mount_bends() -> None:
    still, doors = (
        np.array([sample.ambient_pressure_pa for sample in read(room, LaserFlaws())])
        for room in (CALM, Room(0.1, False, doors_per_h=360.0, door_pa=10.0, door_hz=0.5))
    )
    assert np.abs(doors - still).max() > 4.0
    bent, straight = (
        np.array([sample.displacement_um for sample in read(room, LaserFlaws(), 4000)])
        for room in (
            Room(0.1, False, cycle_k=0.3, cycle_s=600.0, mount_um_per_k=50.0),
            Room(0.1, False, cycle_k=0.3, cycle_s=600.0),
        )
    )
    assert np.abs(bent - straight).max() > 0.2


def test_a_threshold_follows_the_room() -> None:
    pump = ThresholdPump("straight", start=0.2, stall=0.19, per_k=0.05, warms=0.0)
    flows = [pump.step(0.19) for _ in range(90_000)]
    assert min(flows) == 0.0
    assert max(flows) > 0.1


def make_row(**changes: Any) -> dict[str, Any]:
    """A laboratory without a miss."""
    row = {
        "seed": 5,
        "parts": ["defaults", "sessions"],
        "text": "fan",
        "obeyed": [],
        "by_laser_um": 0.2,
        "by_auto_um": 0.15,
        "by_auto_held": 1.0,
        "kept": True,
        "reason": "",
        "predicted_um": 0.16,
        "tuned_um": 0.15,
        "tuned_held": 1.0,
        "excursion_um": 6.0,
        "excursion_s": 400.0,
        "limit_um": 10.0,
        "minutes": 35.0,
    }
    return {**row, **changes}


@pytest.mark.parametrize(
    ("changes", "miss"),
    [
        ({"start_error": "the pump lifts nothing"}, "fan: start: the pump lifts nothing"),
        ({"by_auto_held": 0.9}, "held for 90%"),
        ({"by_auto_um": 0.23}, "estimate 1.15 times the PI"),
        ({"tuned_um": 0.25}, "predicted 0.64 of achieved"),
        ({"excursion_um": 12.0}, "12.0 µm from the setpoint"),
        ({"refused": "k is known to 12% only"}, "refused: k is known"),
        ({"kept": False, "reason": "less margin than designed"}, "rolled back: less margin"),
        ({"crashed": "ValueError: x"}, "crashed"),
    ],
)
def test_a_miss_is_named(changes: dict[str, Any], miss: str) -> None:
    row = make_row(**changes)
    (found,) = list_misses(row)
    assert miss in found
    page = format_page([make_row(), row])
    assert f"| 5 | {found} |" in page


def test_present_gains_that_are_as_good_are_no_miss() -> None:
    same = (
        "0.99 +- 0.03 of that of the previous gains: no better beyond the error of the comparison"
    )
    assert ended_well(make_row(kept=False, reason=same))
    assert list_misses(make_row()) == []
    assert is_held(make_row())
    assert not is_held({})
    assert math.isclose(make_row()["limit_um"], 10.0)


def test_a_session_has_the_gains_that_the_start_has_limited() -> None:
    """It went back to the stated ones of a quick pump, with which a slow one swings by 11 µm."""
    laboratory = draw_laboratory(5)
    stated = laboratory.config()
    link = open_hold(laboratory, stated, 1)
    assert link.config.loop.kp_per_s < 0.6 * stated.loop.kp_per_s
    assert link.config.loop.ti_s > stated.loop.ti_s
    assert link.config.model_copy(update={"loop": stated.loop, "pump": stated.pump}) == stated


def test_the_page_states_the_cause_of_each_miss_or_that_it_is_not_known() -> None:
    missed = [make_row(seed=seed, excursion_um=11.0, excursion_s=200.0) for seed in (8, 9)]
    page = format_page([make_row(seed=7), *missed])
    causes = page.split("## Misses")[1]
    assert "\n8: moves by" in causes
    assert "Not explained: 9." in causes
    assert describe_causes(set()) == []
