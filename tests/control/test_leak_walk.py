"""The learned walk of the leak, beside a plain observer of a leak that stands or walks."""

import math

import numpy as np
import pytest

from membrane_ctrl.control.leak_walk import LeakWalk

CONFIGURED = 0.001  # µm/s per root s
CENTRE_WALK = 0.01
NOISE_UM = 0.3
DT_S = 0.1
GAINS = 0.15, -0.05  # of the observer, on centre and leak


def _learn(true_walk: float, seconds: float, step_at_s: float = math.inf) -> LeakWalk:
    """Learn from an observer of fixed gains; `step_at_s`: the leak doubles, which is known."""
    rng, learned = np.random.default_rng(3), LeakWalk()
    centre_um, leak = 0.0, 1.0
    seen_um, seen_leak = 0.0, 1.0
    for k in range(round(seconds / DT_S)):
        kick = rng.standard_normal(3).tolist()
        leak += true_walk * math.sqrt(DT_S) * kick[0]
        if DT_S * k <= step_at_s < DT_S * (k + 1):
            leak += 1.0
            seen_leak += 1.0
            learned.pause()
        centre_um += (1.0 - leak) * DT_S + CENTRE_WALK * math.sqrt(DT_S) * kick[1]
        seen_um += (1.0 - seen_leak) * DT_S
        learned.predict(DT_S, CENTRE_WALK**2, CONFIGURED**2)
        innovation_um = centre_um + NOISE_UM * kick[2] - seen_um
        seen_um += GAINS[0] * innovation_um
        seen_leak += GAINS[1] * innovation_um
        learned.learn(innovation_um, NOISE_UM**2, GAINS, DT_S)
    return learned


@pytest.mark.parametrize(
    ("true_walk", "least", "most"),
    [(0.0, 1.0, 2.0), (0.005, 2.5, 8.0), (0.03, 15.0, 25.0)],
    ids=["a steady leak", "a slow walk", "a fast walk"],
)
def test_the_walk_is_found_whatever_the_observer_assumes(
    true_walk: float, least: float, most: float
) -> None:
    assert least <= math.sqrt(_learn(true_walk, 600.0).factor) <= most


def test_a_detected_change_of_the_leak_is_no_walk() -> None:
    assert math.sqrt(_learn(0.0, 600.0, step_at_s=300.0).factor) < 2.0
