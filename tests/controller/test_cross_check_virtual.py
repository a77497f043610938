"""Random configurations, judged by the simulated mirror: those that the cross-check passes hold,
and end safely.

The judge's limits are its own, not the configuration's: seen from outside, by the true height and
the true pump.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import pytest

from membrane_ctrl.config.schema import Config
from membrane_ctrl.config.toml_file import parse_tables
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.cross_check import cross_check
from membrane_ctrl.hold.virtual_run import VirtualRun
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.errors import InputError
from membrane_ctrl.model.events import Fault
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.virtual_bench import VirtualBench

SENSITIVITY = zernike_projection()
# how a draw changes a default: times these, or one of these
FACTORS: dict[str, tuple[float, ...]] = {
    "loop.kp_per_s": (0.3, 0.5, 2.0, 5.0, 12.0),
    "loop.ti_s": (0.03, 0.2, 0.5, 3.0),
    "loop.measurement_filter_s": (0.5, 4.0, 20.0),
    "loop.barometer_gain_um_per_pa": (-1.0, 0.0, 0.5, 1.5, 10.0),
    "loop.temperature_gain_um_per_k": (-1.0, 0.0, 0.5, 1.5, 10.0),
    "loop.flow_rate_limit_um_per_s2": (0.01, 0.1, 0.3, 10.0),
    "loop.setpoint_ramp_um_per_s": (0.3, 3.0),
    "loop.flow_max_um_per_s": (0.02, 0.5, 0.8),
    "limits.stale_s": (0.05, 0.5, 3.0, 30.0),
    "limits.stuck_s": (0.005, 0.2, 4.0, 100.0),
    "limits.step_max_um": (0.02, 0.3, 3.0),
    "limits.following_error_max_um": (0.02, 0.5, 2.0),
    "limits.band_um": (0.5, 2.0, 20.0),
    "states.hold_flow_max_s": (0.2, 3.0, 50.0),
    "states.ramp_down_s": (0.2, 3.0, 50.0),
    "states.check_timeout_s": (0.1, 0.5, 4.0),
    "states.settle_timeout_s": (0.002, 0.2),
    "states.lower_timeout_s": (0.05, 0.5, 10.0),
    "states.inflate_pause_um": (0.05, 0.3, 3.0),
    "states.inflate_stall_s": (0.005, 0.02),
    "states.vented_pressure_pa": (0.0, 0.5, 4.0),
    "shape.trim_max_um": (0.1, 3.0, 8.0),
}
CHOICES: dict[str, tuple[Any, ...]] = {
    "loop.rate_hz": (1.0, 10.0, 20.0, 25.0),
    "loop.setpoint_um": (-50.0, 20.0, 480.0),
    "loop.bleed_fraction": (0.005, 0.3),
    "states.actuator_test": (False,),
    "devices.watchdog_s": (0.1, 1.0, 2.0, 10.0),
    "devices.timeout_s": (0.02, 0.1, 0.6),
}
EVENTS = ("no_light", "unreachable", "stalled", "laser_stuck", "silent")
SETTLED_S, AFTER_S = 45.0, 135.0  # HOLD_FLOW and RAMP_DOWN may last a minute each
# With the worst that passes, the pump gives its mean flow for a minute, or its full flow while it
# is ramped down
HIGHEST_UM = 5.3 * 60.0 / 2 + 30.0


def draw(chance: random.Random) -> Config | None:
    """A configuration with one to four changes; None where already the fields' own ranges refuse
    it.
    """
    tables: dict[str, Any] = {
        "twin": {"scenario": "calm", "seed": chance.randrange(100)},
        "shape": {"enabled": False},
    }
    tables["devices"] = {"board": "tcp://twin", "watchdog_s": 0.5}
    default = Config()
    for name in chance.sample(sorted({**FACTORS, **CHOICES}), chance.randint(1, 4)):
        section, key = name.split(".")
        if name in CHOICES:
            value = chance.choice(CHOICES[name])
        else:
            value = getattr(getattr(default, section), key) * chance.choice(FACTORS[name])
        tables.setdefault(section, {})[key] = value
    try:
        return parse_tables(tables, Config, "drawn")
    except InputError:
        return None


@dataclass
class Story:
    """What an observer saw."""

    held: bool = False
    faults_before: tuple[str, ...] = ()
    furthest_um: float = 0.0  # from the setpoint while it was held, before anything happened
    highest_um: float = -1e9  # above the setpoint, at any time
    pumping_at_the_end: bool = True


def run_hold(config: Config, event: str) -> Story:
    """Let it hold, let something happen, and check the mirror itself."""
    assert config.devices is not None
    bench = VirtualBench(Plant(config.twin, config.pump), config.devices.watchdog_s)
    run = VirtualRun(config, bench, SENSITIVITY)
    story = Story()
    commands: tuple[Command, ...] = (Command("hold", "onlooker"),)
    faults: list[str] = []
    last_state: float = State.STANDBY
    while run.now_s < SETTLED_S + AFTER_S:
        if run.now_s < SETTLED_S <= run.now_s + 1.0 / config.loop.rate_hz:
            story.held = last_state == State.HOLD
            story.faults_before = tuple(faults)
            if not story.held:
                return story
            setattr(bench.wrong, event, True)
        tick = run.run_tick(commands)
        commands = ()
        away_um = bench.truth.displacement_um - config.loop.setpoint_um
        story.highest_um = max(story.highest_um, away_um)
        if tick is not None:
            last_state = tick.row.state
            faults += [event.name for event in tick.events if isinstance(event, Fault)]
            if last_state == State.HOLD and run.now_s < SETTLED_S:
                story.furthest_um = max(story.furthest_um, abs(away_um))
        elif run.finished is not None and bench.board.pump_fraction == 0.0:
            break
    story.pumping_at_the_end = bench.board.pump_fraction > 0.0
    return story


def failures(config: Config, event: str) -> Iterator[str]:
    story = run_hold(config, event)
    if not story.held:
        yield f"never held: {story.faults_before}"
        return
    if story.furthest_um > 3.0 * config.limits.band_um + 3.0:
        yield f"wandered {story.furthest_um:.1f} µm while it said hold"
    if story.highest_um > HIGHEST_UM:
        yield f"{story.highest_um:.0f} µm above its setpoint after {event}"
    if story.pumping_at_the_end:
        yield f"still pumping {AFTER_S:g} s after {event}"


def judged(seeds: range, passing: bool = True) -> tuple[int, int, list[str]]:
    """Numbers of configurations drawn and passed (or refused), and the observer's findings."""
    drawn = looked_at = 0
    found = []
    for seed in seeds:
        chance = random.Random(seed)
        config = draw(chance)
        event = chance.choice(EVENTS)
        if config is None:
            continue
        drawn += 1
        if passing == any(finding.severity == "error" for finding in cross_check(config)):
            continue
        looked_at += 1
        changed = config.model_dump(exclude_defaults=True)
        found += [f"{seed}: {complaint}: {changed}" for complaint in failures(config, event)]
    return drawn, looked_at, found


def test_a_configuration_that_passes_holds_and_ends_safely() -> None:
    drawn, passed, found = judged(range(14))
    assert found == []
    assert 0.2 * drawn < passed < 0.8 * drawn  # it neither refuses nor accepts everything


def test_the_observer_of_the_virtual_runs_detects_violations() -> None:
    """Many refused ones only lack a guard that this story does not need; but not all."""
    _, refused, found = judged(range(16), passing=False)
    assert len({line.split(":")[0] for line in found}) >= refused // 5 >= 1


@pytest.mark.campaign
@pytest.mark.timeout(1200)
def test_configurations_of_five_hundred_that_pass_hold_and_end_safely() -> None:
    drawn, passed, found = judged(range(1000, 1500))
    print(f"{drawn} configurations drawn, {passed} let pass, {len(found)} failures")
    assert found == []
