"""The table of verdicts."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from membrane_ctrl.model.shape_estimate import Quality, judge_quality

GOOD = Quality(
    modulation_share=0.35,
    saturated_fraction=0.0,
    valid_fraction=0.99,
    residual_urad=3.0,
    converged=True,
)


def test_good_cycle() -> None:
    assert judge_quality(GOOD) == ("ok", "")


@pytest.mark.parametrize(
    ("change", "verdict", "reason"),
    [
        ({"modulation_share": 0.04}, "degraded", "modulation"),
        ({"modulation_share": 0.01}, "rejected", "modulation"),
        ({"saturated_fraction": 0.05}, "degraded", "saturated"),
        ({"saturated_fraction": 0.5}, "rejected", "saturated"),
        ({"valid_fraction": 0.8}, "degraded", "area"),
        ({"valid_fraction": 0.3}, "rejected", "area"),
        ({"residual_urad": 300.0}, "degraded", "residual"),
        ({"residual_urad": 3000.0}, "rejected", "residual"),
        ({"residual_urad": math.nan}, "rejected", "residual"),
        ({"modulation_share": math.nan}, "rejected", "modulation"),
        ({"converged": False}, "rejected", "converge"),
    ],
)
def test_each_limit(change: dict[str, float], verdict: str, reason: str) -> None:
    found, why = judge_quality(replace(GOOD, **change))
    assert found == verdict
    assert reason in why


def test_rejection_wins_over_degradation() -> None:
    assert judge_quality(replace(GOOD, valid_fraction=0.8, residual_urad=3000.0))[0] == "rejected"
