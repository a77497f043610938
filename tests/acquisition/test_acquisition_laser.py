"""The displacement at a moment, from telemetry rows."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from membrane_ctrl.acquisition.laser_history import HALF_WINDOW_S, LaserHistory
from membrane_ctrl.model.telemetry import FIELDS, ROW_BYTES, TelemetryRow
from membrane_ctrl.processes.ring import RingAddress, RingWriter, open_ring

NOTHING = TelemetryRow(**dict.fromkeys(FIELDS, math.nan))


def row(mono_s: float, displacement_um: float, counter: float, quality: float = 0.0) -> bytes:
    return replace(
        NOTHING,
        mono_s=mono_s,
        displacement_um=displacement_um,
        sample_counter=counter,
        displacement_quality=quality,
    ).pack()


@pytest.fixture
def address() -> Iterator[RingAddress]:
    with open_ring(256, ROW_BYTES) as address:
        yield address


@pytest.fixture
def telemetry(address: RingAddress) -> Iterator[RingWriter]:
    writer = RingWriter(address)
    yield writer
    writer.close()


@pytest.fixture
def laser(address: RingAddress) -> Iterator[LaserHistory]:
    history = LaserHistory(address, 50.0)
    yield history
    history.close()


def test_mean_of_the_readings_around_a_moment(telemetry: RingWriter, laser: LaserHistory) -> None:
    for k in range(100):
        telemetry.put(row(k * 0.02, k * 0.02 * 3.0, k))  # 3 µm/s
    assert laser.at(1.01) == pytest.approx(3.03)  # a steady motion cancels in a symmetric window
    assert laser.at(0.51) == pytest.approx(1.53)  # and older moments are still available


@pytest.mark.parametrize("rate_hz", [1.0, 5.0, 10.0])
def test_a_slow_loop_has_readings_enough(
    telemetry: RingWriter, address: RingAddress, rate_hz: float
) -> None:
    with closing(LaserHistory(address, rate_hz)) as laser:
        for k in range(20):
            telemetry.put(row(k / rate_hz, 1.0, k))
        moments_s = (10.0 + np.linspace(0.0, 1.0, 7)) / rate_hz
        assert [laser.at(moment_s) for moment_s in moments_s] == [1.0] * 7


def test_nothing_is_known_before_the_first_row(laser: LaserHistory) -> None:
    assert math.isnan(laser.at(0.0))


def test_old_readings_are_not_fresh(telemetry: RingWriter, laser: LaserHistory) -> None:
    for k in range(20):
        telemetry.put(row(k * 0.02, 1.0, k))
    assert laser.at(0.3) == 1.0
    assert math.isnan(laser.at(0.38 + HALF_WINDOW_S + 0.01))


@pytest.mark.parametrize("bad", ["missing", "flagged", "repeated"])
def test_bad_readings_are_none(telemetry: RingWriter, laser: LaserHistory, bad: str) -> None:
    for k in range(20):
        telemetry.put(
            row(
                mono_s=k * 0.02,
                displacement_um=math.nan if bad == "missing" else 7.0,
                counter=1 if bad == "repeated" else k,
                quality=2.0 if bad == "flagged" else 0.0,
            )
        )
    assert math.isnan(laser.at(0.2))


def test_readings_older_than_a_minute_are_forgotten(
    telemetry: RingWriter, laser: LaserHistory
) -> None:
    for start_s in (0.0, 90.0):
        for k in range(20):
            telemetry.put(row(start_s + k * 0.02, 1.0, start_s + k))
    assert math.isnan(laser.at(0.2))
    assert laser.at(90.2) == 1.0
