"""Where a calibration may go, in which order, and how long it takes."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from live_bench import config

from membrane_ctrl.calibration.setpoints import (
    HeldMirror,
    Reach,
    plan_setpoints_um,
    ramp_s,
    setpoint_reach,
)
from membrane_ctrl.config.schema import Config
from membrane_ctrl.model.errors import InputError

HELD = HeldMirror(0.0, 37.1, 600.0, 1.2, 80.0, True)
WIDE = Reach(-5000.0, 5000.0, "low", "high")


def test_the_limits_less_what_a_lagging_mirror_may_be_off() -> None:
    reach = setpoint_reach(HELD, Config())
    assert (reach.low_um, reach.high_um) == (-1940.0, 440.0)


def test_a_pressure_that_would_trip_ends_the_reach_sooner() -> None:
    reach = setpoint_reach(HELD, config())
    sag_mm = HELD.sag_at_mm(reach.high_um)
    assert reach.high_why == "limits.gauge_pressure_max_pa"
    assert 600.0 * (sag_mm / 37.1) ** 3 == pytest.approx(0.95 * 750.0, rel=1e-3)


def test_without_a_gauge_the_displacement_counts_alone() -> None:
    assert setpoint_reach(replace(HELD, pressure_pa=math.nan), config()).high_um == 4440.0


def test_eight_millimetres_about_where_it_is_held() -> None:
    assert plan_setpoints_um(HELD, WIDE, None, 5) == (-4000.0, -2000.0, 0.0, 2000.0, 4000.0)


def test_the_range_is_moved_into_the_reach_and_the_nearer_end_comes_first() -> None:
    assert plan_setpoints_um(HELD, Reach(-3000.0, 500.0, "low", "high"), 3000.0, 3) == (
        500.0,
        -1000.0,
        -2500.0,
    )
    assert plan_setpoints_um(HELD, Reach(-500.0, 3000.0, "low", "high"), None, 2) == (
        -500.0,
        3000.0,
    )


@pytest.mark.parametrize(
    ("reach", "range_um", "message"),
    [
        (WIDE, 10_001.0, "low and high leave 10000 µm"),
        (WIDE, 999.0, "closer together than 1000 µm add nothing to one set"),
        (
            Reach(-300.0, 300.0, "low", "high"),
            None,
            "low and high leave 600 µm: sets closer together than 1000 µm",
        ),
        (Reach(300.0, -300.0, "low", "high"), None, "leave 0 µm"),
    ],
)
def test_no_room(reach: Reach, range_um: float | None, message: str) -> None:
    with pytest.raises(InputError, match=message):
        plan_setpoints_um(HELD, reach, range_um, 5)


def test_down_by_the_leak_up_by_what_the_pump_has_left() -> None:
    down_s, up_s = ramp_s(HELD, 0.0, -1000.0, Config()), ramp_s(HELD, 0.0, 1000.0, Config())
    assert down_s == pytest.approx(1000.0 / (0.8 * 1.2 * (36.6 / 37.1) ** 3), rel=1e-3)
    assert up_s == pytest.approx(1000.0 / (0.8 * (5.3 - 1.2 * (37.6 / 37.1) ** 3)), rel=1e-3)


def test_a_tight_mirror_does_not_come_down_and_a_leaky_one_not_up() -> None:
    assert math.isinf(ramp_s(replace(HELD, leak_um_per_s=0.0), 0.0, -10.0, Config()))
    assert math.isinf(ramp_s(replace(HELD, leak_um_per_s=5.4), 0.0, 10.0, Config()))
