"""Minutes of the twin's climate at its steepest: what is held stays, by code that shares
nothing with the product; and the hold itself stays, with default limits.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from firmware_iface.roles import BenchReading
from membrane_ctrl.config.schema import Config, LoopConfig, TwinConfig
from membrane_ctrl.controller.command import Command
from membrane_ctrl.hold.virtual_run import VirtualRun
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.events import Fault
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.virtual_bench import VirtualBench
from tests.studies.climate_day import run_climate_day

HOURS, RATE_HZ = 0.2, 2.0


def _hide_climate(now_s: float, reading: BenchReading) -> BenchReading:
    """A bench without sensors of the climate."""
    return replace(
        reading,
        film_temperature_c=math.nan,
        ring_temperature_c=math.nan,
        humidity_percent=math.nan,
    )


def _hold_until_fault(climate: str, seconds: float, has_sensors: bool, seed: int = 1) -> list[str]:
    """Hold by the laser with default limits; returns the faults."""
    loop = LoopConfig(rate_hz=RATE_HZ, measurement_filter_s=1 / RATE_HZ)
    twin = {"scenario": "quiet", "climate": climate, "seed": seed, "laser_noise_um": 1.0}
    config = Config(twin=TwinConfig.model_validate(twin), loop=loop)
    bench = VirtualBench(Plant(config.twin, config.pump))
    alter = None if has_sensors else _hide_climate
    run = VirtualRun(config, bench, zernike_projection(), alter=alter)
    commands: tuple[Command, ...] = (Command("hold", "a test"),)
    faults: list[str] = []
    while run.now_s < seconds and not faults:
        tick = run.run_tick(commands)
        commands = ()
        assert tick is not None
        faults += [event.name for event in tick.events if isinstance(event, Fault)]
    return faults


def test_a_hold_stays_through_an_air_conditioner_by_its_climate_sensors() -> None:
    assert _hold_until_fault("hvac", 480.0, has_sensors=True) == []


def test_without_climate_sensors_an_air_conditioner_ends_a_hold_with_default_limits() -> None:
    assert _hold_until_fault("hvac", 480.0, has_sensors=False) == ["laser_gauge_apart"]


@pytest.mark.campaign
@pytest.mark.parametrize(("climate", "hours"), [("hvac", 3.0), ("day", 12.0)])
def test_a_hold_stays_for_hours_of_a_changing_room(climate: str, hours: float) -> None:
    assert _hold_until_fault(climate, 3600 * hours, has_sensors=True) == []


def test_the_focus_stays_in_a_changing_climate() -> None:
    """The film's excess strain changes by 7e-6: some 60 µm of focus at a constant vertex."""
    day = run_climate_day("focus", HOURS, RATE_HZ)
    assert not day.faults
    assert np.ptp(day.excess_ppm) > 6.0
    assert np.abs(day.focus_um).max() < 20.0
    # One actuator leaves the spherical aberration, and nothing else is added
    assert day.figure_um.max() < 1.1 * day.least_um.max()
