"""A bench without a vent: its messages, and the time to lower its mirror."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from typing import Any

import pytest

from membrane_ctrl.config.schema import Config
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.cross_check import cross_check
from membrane_ctrl.hold.virtual_run import VirtualRun
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.events import Why
from membrane_ctrl.model.telemetry import SafeLevel, State
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.virtual_bench import VirtualBench
from tests.worlds.role_tables import roles, value


def config(vent: bool, **more: Any) -> Config:
    tables = roles(**({"vent": value("tcp://plc", 30)} if vent else {}))
    return Config.model_validate(
        {
            **tables,
            "loop": {"rate_hz": 20.0},
            "states": {"stay_after_trip": True},
            "twin": {"scenario": "quiet"},
            **more,
        }
    )


def reasons(bench: Config, *asked: str, seconds: float = 5.0) -> tuple[list[str], SafeLevel]:
    """Run a hold into a fault of safe level vent; returns the operator's lines after it, and the
    level.
    """
    without = not bench.vent_fitted
    excess_pa = [0.0]
    run = VirtualRun(
        bench,
        VirtualBench(Plant(bench.twin, bench.pump)),
        zernike_projection(),
        alter=lambda _, reading: replace(
            reading,
            gauge_pressure_pa=reading.gauge_pressure_pa + excess_pa[0],
            vent_fraction=math.nan if without else reading.vent_fraction,
        ),
    )
    tick = run.run_tick((Command("hold", "ann"),))
    while tick is not None and tick.row.state != State.HOLD:
        tick = run.run_tick()
    messages: list[str] = []
    commands = tuple(Command(kind, "ann") for kind in asked)  # type: ignore[arg-type]
    excess_pa[0] = 0.0 if asked else 400.0
    for number in range(round(seconds * 20)):
        tick = run.run_tick(commands if number == 0 else ())
        assert tick is not None
        messages += [event.why for event in tick.events if isinstance(event, Why)]
    return messages, SafeLevel(int(tick.row.safe_level))


def test_a_fault_of_the_level_vent_states_what_is_fitted() -> None:
    findings, level = reasons(config(vent=False))
    assert level == SafeLevel.VENT
    assert findings[-1] == "fault: pump off; no vent is fitted, the leak lowers the mirror"
    findings, level = reasons(config(vent=True))
    assert level == SafeLevel.VENT
    assert findings[-1] == "fault: vent"


def test_the_command_vent_states_that_only_the_leak_lowers_the_mirror() -> None:
    findings, _ = reasons(config(vent=False), "vent")
    assert re.fullmatch(r"no vent is fitted, the leak lowers the mirror: \d+ Pa left", findings[-1])
    findings, _ = reasons(config(vent=True), "vent")
    assert re.fullmatch(r"venting: \d+ Pa left", findings[-1])


def test_check_warns_of_a_missing_vent_with_the_time_to_lower() -> None:
    assert "devices.vent" not in {finding.field for finding in cross_check(config(vent=True))}
    assert "devices.vent" not in {finding.field for finding in cross_check(Config())}
    (finding,) = (
        found for found in cross_check(config(vent=False)) if found.field == "devices.vent"
    )
    assert finding.severity == "warning"
    assert "no vent is fitted" in finding.why
    assert "from 600 to 100 Pa in about 9.6 h" in finding.why
    assert "twin.leak_time_constant_s = 10000 s, which is a leak of 1.2 µm/s" in finding.why


def test_a_slack_film_needs_no_estimate() -> None:
    bench = config(vent=False, optics={"mirror": {"pressure_pa": 90.0}})
    (finding,) = (found for found in cross_check(bench) if found.field == "devices.vent")
    assert "about" not in finding.why


@pytest.mark.parametrize("leak_time_constant_s", [100.0, 200.0])
def test_the_estimate_is_that_of_the_twin(leak_time_constant_s: float) -> None:
    bench = config(
        vent=False, twin={"scenario": "calm", "leak_time_constant_s": leak_time_constant_s}
    )
    (finding,) = (found for found in cross_check(bench) if found.field == "devices.vent")
    match = re.search(r"in about ([\d.e+-]+) h", finding.why)
    assert match is not None
    plant = Plant(bench.twin, bench.pump)
    plant.actuate(0.0, 0.0)
    begin_s = end_s = math.nan
    while math.isnan(end_s):
        plant.advance(0.1)
        pressure_pa = plant.sample().gauge_pressure_pa
        if math.isnan(begin_s) and pressure_pa <= bench.optics.mirror.pressure_pa:
            begin_s = plant.time_s
        if pressure_pa <= bench.states.vented_pressure_pa:
            end_s = plant.time_s
    assert 3600.0 * float(match[1]) == pytest.approx(end_s - begin_s, rel=0.1)
