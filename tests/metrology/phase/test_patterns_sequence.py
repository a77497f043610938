"""Order of the images of a cycle."""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.config.schema import PatternConfig
from membrane_ctrl.metrology.phase.pattern_sequence import FullSlots, fringe_sequence, full_sequence


def test_the_papers_18_images() -> None:
    names = [image.name for image in full_sequence(PatternConfig())]
    axis = [f"{{0}}_sin_{k}" for k in range(4)] + [f"{{0}}_gray_{k}" for k in range(1, 5)]
    assert names == [n.format("x") for n in axis] + [n.format("y") for n in axis] + [
        "white",
        "black",
    ]


@pytest.mark.parametrize("steps", [3, 4, 7])
def test_slots_are_where_the_sequence_puts_them(steps: int) -> None:
    images = full_sequence(PatternConfig(steps=steps))
    slots = FullSlots(steps)
    assert len(images) == slots.count == 2 * (steps + 4) + 2
    x, y = (images[s] for s in slots.sinusoids)
    assert x + y == fringe_sequence(PatternConfig(steps=steps))
    assert [image.axis for s in slots.gray for image in images[s]] == ["x"] * 4 + ["y"] * 4
    assert (images[slots.white].role, images[slots.black].role) == ("white", "black")
    assert [image.shift_rad for image in x] == pytest.approx(2 * np.pi * np.arange(steps) / steps)
