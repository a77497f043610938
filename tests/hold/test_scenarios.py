"""Every scenario file, and the loader's errors for invalid ones."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from membrane_ctrl.hold.scenario_file import load_scenario
from membrane_ctrl.hold.scenarios import list_scenario_files
from membrane_ctrl.model.errors import InputError
from tests.support.scenario import CheckedScenario, failures, play

FOLDER = Path(__file__).parents[1] / "scenarios"
LONGEST_S = 400.0  # each fault of a scenario has begun by then; the campaign plays them longer
CAMPAIGN_LONGEST_S = 1000.0
# The times of the rules are in seconds: fewer ticks show the same. The campaign plays each file at
# its own rate.
FASTEST_HZ = 10.0
# Of the sensors' power dip and of a laser that answers now and then, the ticks themselves are the
# point.
BY_TICKS = ("flaky_laser_and_runaway", "sensor_power_dip")
PATHS = [*list_scenario_files(), *sorted(FOLDER.glob("*.toml"))]


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_scenario(path: Path) -> None:
    fastest_hz = math.inf if path.stem in BY_TICKS else FASTEST_HZ
    play_as_expected(path, LONGEST_S, fastest_hz)


@pytest.mark.campaign
@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_a_scenario_at_its_own_rate(path: Path) -> None:
    play_as_expected(path, LONGEST_S)


@pytest.mark.campaign
@pytest.mark.parametrize("name", ["calm_night", "door", "mount_drift"])
def test_a_long_scenario(name: str) -> None:
    (path,) = (path for path in list_scenario_files() if path.stem == name)
    play_as_expected(path, CAMPAIGN_LONGEST_S)


def slow_scenario(whole: CheckedScenario, fastest_hz: float) -> CheckedScenario:
    """The scenario with a loop of this rate at most."""
    loop = whole.config.loop
    slower = loop.model_copy(update={"rate_hz": min(loop.rate_hz, fastest_hz)})
    return whole.model_copy(update={"config": whole.config.model_copy(update={"loop": slower})})


def cut_scenario(whole: CheckedScenario, duration_s: float) -> CheckedScenario:
    """The first part of a scenario; its bounds hold until the mirror is lowered at the end."""
    bounds = tuple(
        bound.model_copy(update={"to_s": min(bound.to_s, duration_s - 5.0)})
        for bound in whole.expect.bounds
    )
    changed = {
        "duration_s": duration_s,
        "at": tuple(at for at in whole.at if at.time_s < duration_s),
        "expect": whole.expect.model_copy(update={"bounds": bounds}),
    }
    return whole.model_copy(update=changed)


def play_as_expected(path: Path, longest_s: float, fastest_hz: float = math.inf) -> None:
    """Play a scenario, or its first part, and compare."""
    scenario = slow_scenario(load_scenario(path, CheckedScenario), fastest_hz)
    if scenario.duration_s > longest_s:
        scenario = cut_scenario(scenario, longest_s)
    outcome = play(scenario)
    assert not list(failures(scenario.expect, outcome))
    assert outcome.bench.board.pump_fraction == 0.0  # however it ended


GOOD = 'title = "x"\nduration_s = 20.0\n[config.loop]\nrate_hz = 10.0\n'


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('[[at]]\ntime_s = 1.0\nwrong = "gremlins"\n[expect]\n', ["at.0", "gremlins", "no_light"]),
        (
            '[[at]]\ntime_s = 1.0\nwrong = "pump_share"\nvalue = 1.5\n[expect]\n',
            ["at.0", "pump_share", "0 to 1"],
        ),
        (
            '[[at]]\ntime_s = 1.0\nwrong = "silent"\ncommand = "stop"\n[expect]\n',
            ["at.0", "exactly one"],
        ),
        ('[[at]]\ntime_s = 1.0\ncommand = "explode"\n[expect]\n', ["at.0", "explode", "lower"]),
        (
            '[[at]]\ntime_s = 1.0\nevent = "laser_dropout"\nfor_s = 9.0\n[expect]\n',
            ["at.0", "for_s", "over_s"],
        ),
        (
            '[[at]]\ntime_s = 1.0\nwrong = "silent"\nover_s = 9.0\n[expect]\n',
            ["at.0", "over_s", "for_s"],
        ),
        ('[[at]]\ntime_s = 20.0\nwrong = "silent"\n[expect]\n', ["at.0", "20", "duration_s"]),
        ('[[expect.bounds]]\nfield = "height"\nlow = 1.0\n', ["expect.bounds.0", "height"]),
        ('[[expect.bounds]]\nfield = "trim_um"\n', ["expect.bounds.0", "low, high"]),
        ('[expect]\nexit = "well"\n', ["expect.exit", "safety_trip"]),
        ("[expect]\nfault = []\n", ["expect.fault", "did you mean faults"]),
        ("", ["expect", "missing"]),
    ],
)
def test_a_bad_file_is_one_line(tmp_path: Path, text: str, words: list[str]) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(GOOD + text)
    with pytest.raises(InputError) as caught:
        load_scenario(path, CheckedScenario)
    message = str(caught.value)
    assert "\n" not in message
    assert str(path) in message
    assert all(word in message for word in words), message


def test_missing_expectations_are_reported(tmp_path: Path) -> None:
    path = tmp_path / "wrong.toml"
    bounds = '[[expect.bounds]]\nfield = "truth_displacement_um"\nhigh = -1e3\n'
    expect = '[expect]\nexit = "safety_trip"\nstates = []\nfaults = ["late"]\nevents = ["party"]\n'
    path.write_text(GOOD + expect + 'shape_reasons = ["bored"]\n' + bounds)
    scenario = load_scenario(path, CheckedScenario)
    found = "\n".join(failures(scenario.expect, play(scenario)))
    assert all(
        word in found
        for word in ("exit", "states", "faults", "party", "bored", "truth_displacement_um")
    )


def test_a_process_that_never_runs_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "stalled.toml"
    path.write_text(GOOD + '[[at]]\ntime_s = 0.0\nwrong = "stalled"\n[expect]\nexit = "done"\n')
    scenario = load_scenario(path, CheckedScenario)
    assert list(failures(scenario.expect, play(scenario))) == ["exit: none, not done"]
