"""What a report finds in a run of some minutes: planted faults, or that it cannot judge."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from membrane_ctrl.model.telemetry import State, unpack_rows
from membrane_ctrl.review import open_run
from membrane_ctrl.review.events import flow_steps, trim_drifts
from membrane_ctrl.review.events.found import LEVEL_COLUMNS, find_events, list_unjudged
from membrane_ctrl.review.events.found_event import FoundEvent, Level
from tests.support.scenario import CheckedScenario, play
from tests.worlds.nights import write_run


def played(folder: Path, duration_s: float, *at: dict[str, Any]) -> Level:
    """The 1 s level of a hold on the twin, with what happens in it."""
    about = {
        "title": "short",
        "duration_s": duration_s,
        "config": {"loop": {"rate_hz": 10.0}},
        "at": list(at),
        "expect": {},
    }
    ticks = play(CheckedScenario.model_validate(about)).ticks
    write_run(folder, iter([(unpack_rows([tick.row.pack() for tick in ticks]), [])]))
    return open_run(folder).level(1.0, names=LEVEL_COLUMNS)


def find(level: Level, folder: Path) -> list[FoundEvent]:
    return find_events(level, open_run(folder).shapes(), 2.0)


def test_a_leak_that_doubles_is_found_in_three_minutes(tmp_path: Path) -> None:
    folder = tmp_path / "20261121T180000Z-leak"
    level = played(folder, 180.0, {"time_s": 90.0, "event": "leak", "value": 2.0})
    (step,) = [each for each in find(level, folder) if each.kind == "flow step"]
    assert step.time_s == pytest.approx(90.0, abs=10.0)
    assert step.size == pytest.approx(100.0, abs=25.0)
    assert step.confidence > 0.99


def test_a_quiet_run_of_three_minutes_has_none_and_states_what_it_cannot_show(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "20261121T180000Z-quiet"
    level = played(folder, 180.0)
    assert find(level, folder) == []
    unjudged = " ".join(list_unjudged(level))
    assert "flow step below 50 % (needs 11 min of hold)" in unjudged
    assert "noise change (needs 21 min of hold)" in unjudged


def level_of(minutes: int, **columns: np.ndarray) -> Level:
    """A level of seconds in hold with given columns."""
    count = 60 * minutes
    quiet = {
        "mean_flow_um_per_s": np.full(count, 1.2),
        "mean_feedforward_um_per_s": np.zeros(count),
        "mean_trim_um": np.zeros(count),
    }
    return {
        "time_s": np.arange(count, dtype=float),
        "rows": np.full(count, 50.0),
        "state": np.full(count, float(State.HOLD)),
        **quiet,
        **columns,
    }


@pytest.mark.parametrize("seed", range(20))
def test_noise_and_a_slow_wander_of_the_flow_are_no_step(seed: int) -> None:
    random = np.random.default_rng(seed)
    wander = np.cumsum(random.normal(0.0, 0.02, 240)) + random.normal(0.0, 0.3, 240)
    level = level_of(4, mean_flow_um_per_s=1.2 + wander)
    assert flow_steps.find_flow_steps(level) == []


def test_a_drift_of_the_mount_is_found_in_the_trim() -> None:
    random = np.random.default_rng(1)
    ramp_um = np.clip(np.arange(900) - 200.0, 0.0, 600.0) * 2.0 / 60.0
    level = level_of(15, mean_trim_um=ramp_um + random.normal(0.0, 0.2, 900))
    (drift,) = trim_drifts.find_trim_drifts(level)
    assert drift.size == pytest.approx(20.0, abs=0.5)
    assert drift.time_s == pytest.approx(500.0, abs=60.0)


@pytest.mark.parametrize("seed", range(10))
def test_a_trim_that_wanders_is_no_drift(seed: int) -> None:
    random = np.random.default_rng(seed)
    walk_um = np.repeat(np.cumsum(random.normal(0.0, 0.8, 60)), 60)
    assert trim_drifts.find_trim_drifts(level_of(60, mean_trim_um=walk_um)) == []


def test_less_than_five_minutes_are_no_drift() -> None:
    level = level_of(4, mean_trim_um=np.linspace(0.0, 30.0, 240))
    assert trim_drifts.find_trim_drifts(level) == []
