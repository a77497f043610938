"""What counts as a new reading, and when a jump is believed."""

from __future__ import annotations

import math

from firmware_iface.roles import BenchReading
from membrane_ctrl.config import LimitsConfig
from membrane_ctrl.observer import Observer
from membrane_ctrl.safety import Observation
from membrane_ctrl.tick import TickInputs


def look(observer: Observer, tick: int, displacement_um: float, counter: int, device_time_s: float) -> Observation:
    reading = BenchReading(
        displacement_um, 0, 600.0, 101325.0, 23.0, 23.0, 0.0, 0.0, counter, device_time_s, False, 0
    )
    inputs = TickInputs(now_s=0.02 * tick, dt_s=0.02, reading=reading, link_up=True)
    return observer.observe(inputs, math.nan, "", "", "", "")


def test_a_sample_is_new_only_when_counter_and_time_have_both_advanced() -> None:
    observer = Observer(LimitsConfig())
    stamps = [(1, 0.1), (2, 0.1), (1, 0.2), (2, 0.2)]
    valid = [look(observer, tick, 0.1 * tick, *stamp).displacement_valid for tick, stamp in enumerate(stamps, 1)]
    assert valid == [True, False, False, True]


def test_a_jump_is_believed_after_ten_refusals() -> None:
    observer = Observer(LimitsConfig())
    look(observer, 1, 0.0, 1, 0.02)
    valid = [look(observer, tick, 200.0, tick, 0.02 * tick).displacement_valid for tick in range(2, 14)]
    assert valid == [False] * 10 + [True] * 2
