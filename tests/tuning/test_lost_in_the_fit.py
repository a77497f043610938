"""A fit to a record in which readings are lost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic import record

from tuning.identification.fit_quality import judge_fit
from tuning.identification.plant_fit import identify_plant
from tuning.identification.plant_model import PlantModel
from tuning.identification.record import Record

TRUE = PlantModel(1.0, 0.08, 0.15, 1.2)


def _lose_readings(whole: Record, share: float, ticks: int) -> Record:
    """Lose a share of the readings, in gaps of so many ticks."""
    rng = np.random.default_rng(7)
    read_um = whole.displacement_um.copy()
    gaps = round(share * len(whole) / ticks)
    for first in rng.choice(len(whole) - ticks, gaps, replace=False):
        read_um[first : first + ticks] = np.nan
    return replace(whole, displacement_um=read_um)


@pytest.mark.parametrize("ticks", [1, 4], ids=["single", "gaps of 80 ms"])
def test_a_few_lost_readings_hardly_move_the_fit(ticks: int) -> None:
    whole = record(TRUE, samples=2000)
    lossy = _lose_readings(whole, 0.04, ticks)
    full, found = identify_plant(whole), identify_plant(lossy)
    assert abs(found.model.gain - full.model.gain) < 0.6 * full.sigma.gain
    assert abs(found.model.delay_s - full.model.delay_s) < 0.6 * full.sigma.delay_s
    assert judge_fit(lossy, found).verdict == judge_fit(whole, full).verdict


def test_many_lost_readings_are_refused() -> None:
    lossy = _lose_readings(record(TRUE, samples=1000), 0.1, 1)
    judged = judge_fit(lossy, identify_plant(lossy))
    assert judged.verdict == "refused"
    assert "of the readings were lost" in judged.reasons[0]
