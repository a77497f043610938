"""The pump's curve on actuators that nobody told the product of: second world, defaults in the configuration."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from membrane_ctrl.control.gas import PumpCurve
from membrane_ctrl.model.errors import RejectedError
from membrane_ctrl.model.states import State
from membrane_ctrl.sessions.folder import create_session
from tests.support.second_world import CURVES, ForeignPlant, ForeignPump, foreign_bench, foreign_config
from tuning import session
from tuning.identification.pump_curve import Level, PumpRun, fit
from tuning.rig import HoldRig
from tuning.twin_hold import TwinHold

DT_S = 0.1


def measured_run(pump: ForeignPump, commands: list[tuple[float, float]], seed: int = 1, leak: float = 1.2) -> PumpRun:
    """What a mirror without weather shows of a series of (command, seconds); the pump held it before."""
    rng = np.random.default_rng(seed)
    pump.balance(leak)
    given = np.repeat([c for c, _ in commands], [round(s / DT_S) for _, s in commands])
    height, heights = 0.0, []
    for command in given:
        heights.append(height)
        height += sum(pump.step(command) - leak for _ in range(10)) * 0.01
    return PumpRun(
        DT_S, given, np.array(heights) + 0.3 * rng.standard_normal(given.size), np.full(given.size, math.nan)
    )


@pytest.mark.parametrize(("delay_s", "lag_s"), [(0.1, 0.1), (0.9, 0.4), (1.5, 0.5)])
def test_the_flow_at_each_command_behind_any_dead_time_and_lag(delay_s: float, lag_s: float) -> None:
    pump = ForeignPump("quadratic", 7.0, delay_s, lag_s)
    cycle = [(0.0, 5.0), (0.8, 1.5), (0.0, 4.0), (0.6, 3.0), (0.0, 3.0), (0.4, 4.0), (1.0, 1.0), (0.0, 4.0)]
    found = fit([measured_run(pump, 4 * cycle, seed) for seed in (1, 2)])
    for command in (0.4, 0.6, 0.8, 1.0):
        at = found.levels[Level(command)]
        assert at.flow_um_per_s == pytest.approx(pump.settled(command), abs=max(4 * at.sigma_um_per_s, 0.1))
        assert at.sigma_um_per_s < 0.15
    assert found.leak_um_per_s == pytest.approx(1.2, abs=0.1)
    assert found.delay_s + found.lag_s == pytest.approx(delay_s + lag_s, abs=0.1)


def test_a_level_reached_from_above_is_another_one() -> None:
    pump = ForeignPump("hysteretic", 6.0, play=0.05)
    cycle = [(0.0, 4.0), (0.5, 3.0), (0.0, 4.0), (0.8, 0.5), (0.5, 2.0)]
    found = fit([measured_run(pump, 6 * cycle)])
    more = found.levels[Level(0.5, False)].flow_um_per_s - found.levels[Level(0.5)].flow_um_per_s
    assert more == pytest.approx(pump.settled(0, 0.55) - pump.settled(0, 0.45), abs=0.2)


def test_runs_without_readings_are_refused() -> None:
    with pytest.raises(ValueError, match="without readings"):
        fit([PumpRun(DT_S, np.full(100, 0.3), np.full(100, math.nan), np.full(100, math.nan))])


def mapped(tmp_path: Path, plant: ForeignPlant) -> tuple[session.pump_survey.PumpMap, TwinHold]:
    """A session's pump map on a bench of the second world, in a hold with the default configuration."""
    link = TwinHold(foreign_config(rate_hz=20.0), bench=foreign_bench(plant))
    rig = HoldRig(link, "tester")
    folder = create_session(tmp_path, "foreign", "tester", link.name, link.config, rig.loop)
    return session.map_pump(folder, rig), link


def worst_share(found: session.pump_survey.PumpMap, pump: ForeignPump) -> float:
    """Largest error of the flow over the curve, from the start on, as a share of the full flow."""
    curve = PumpCurve(found.pump)
    low = max(found.pump.start_fraction, found.pump.curve_fraction[0])
    commands = np.linspace(low, found.pump.curve_fraction[-1], 100)
    return max(abs(curve._rising.flow(d) - pump.settled(d)) for d in commands) / pump.full_um_per_s


def test_a_late_quadratic_pump_is_mapped(tmp_path: Path) -> None:
    """It stopped both the relay's fit ("stalls at small flows") and the former map ("too tight, or no pump")."""
    pump = ForeignPump("quadratic", 7.0, 0.9, 0.3, start=0.2, stall=0.2)
    found, link = mapped(tmp_path, ForeignPlant(pump, laser_um=0.5, weather=0.5))
    assert worst_share(found, pump) < 0.03
    assert found.pump.curve_fraction[-1] == 1.0
    assert found.delay_s + found.lag_s == pytest.approx(1.2, abs=0.1)
    held = [row for row in link.rows if row.state in (State.HOLD, State.TUNE)]
    assert max(abs(row.truth_displacement_um) for row in held[2000:]) < 12.0
    assert (tmp_path / "tuning").exists()


@pytest.mark.campaign
@pytest.mark.parametrize("gusts", [False, True])
@pytest.mark.parametrize("shape", sorted(CURVES))
def test_every_actuator_is_mapped(tmp_path: Path, shape: str, gusts: bool) -> None:
    stiction = {"start": 0.22, "stall": 0.15} if shape == "straight" else {}
    pump = ForeignPump(shape, 6.0, 0.3, 0.2, play=0.04 if shape == "hysteretic" else 0.0, **stiction)
    found, _ = mapped(tmp_path, ForeignPlant(pump, gusts=gusts))
    assert worst_share(found, pump) < (0.05 if gusts else 0.03)
    assert bool(found.pump.curve_falling_um_per_s) == (shape == "hysteretic")


def test_a_stuck_pump_is_told(tmp_path: Path) -> None:
    """It goes on giving what holds the mirror, whatever it is told."""
    plant = ForeignPlant(ForeignPump("straight", 5.3), laser_um=0.5, weather=0.3)
    link = TwinHold(foreign_config(rate_hz=20.0), bench=foreign_bench(plant))
    rig = HoldRig(link, "tester")
    rig.hold(20.0)
    link.bench.wrong.pump_stuck_fraction = 0.31
    folder = create_session(tmp_path, "stuck", "tester", link.name, link.config, rig.loop)
    with pytest.raises(RejectedError, match="alike at every command"):
        session.map_pump(folder, rig)
