"""A hold with its page, fifty viewers and one that has stopped reading: neither ticks nor other viewers notice."""

from __future__ import annotations

import pytest

from benchmarks import viewers
from benchmarks.figures import show

pytestmark = [pytest.mark.real_time, pytest.mark.campaign, pytest.mark.timeout(600)]


def test_fifty_viewers_and_a_stalled_one() -> None:
    figures = viewers.run(cycles=2)
    show("viewers", figures)
    late, missed, *_, lost, kept, _, grown_mb = figures
    assert late.reference_value is not None
    assert late.value < max(2 * late.reference_value, 5.0)
    assert missed.value <= max(3 * (missed.reference_value or 0.0), 0.01 * 100 * viewers.PHASE_S)  # 1 % of the ticks
    assert lost.met
    assert kept.met
    assert grown_mb.met
