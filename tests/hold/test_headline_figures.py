"""Console, end of a run, `runs` and report state the same headline figures, to the digit."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from membrane_ctrl.cli import run as command
from membrane_ctrl.console.model import ConsoleModel
from membrane_ctrl.console.view import _format_held
from membrane_ctrl.hold import scenario_file, scenario_run, scenarios
from membrane_ctrl.model.telemetry import unpack_rows
from membrane_ctrl.run_files.held_error import HeldError, format_in_band

_BATCH = 7  # ticks that a console takes at a time


def read_from_console(name: str) -> str:
    """What a console states at the end of a scenario."""
    path = scenarios.find_scenario(name)
    played = scenario_file.load_scenario(path, scenario_file.Scenario)
    rows = unpack_rows(
        [
            tick.outputs.row.pack()
            for tick in scenario_run.ScenarioRun(played).ticks()
            if tick is not None
        ]
    )
    model = ConsoleModel(played.config)
    for first in range(0, len(rows), _BATCH):
        model.add_rows(rows[first : first + _BATCH])
    return _format_held(model.make_view(0.0).held).plain


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    "scenario",
    ["laser_loss", pytest.param("leak_doubled", marks=pytest.mark.campaign), "pump_failing"],
)
def test_four_places_agree(
    scenario: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command(["twin", "play", scenario, "--logs", str(tmp_path)])
    ended = capsys.readouterr().err
    found = re.search(r"^true centre, 1 s means: +(.+)\n1 s means .* band: +(.+)$", ended, re.M)
    assert found is not None, ended
    figures, in_band = found.groups()
    assert re.fullmatch(r"std \d+\.\d{3} µm, mean error [+-]\d+\.\d{3} µm", figures), figures
    if scenario == "pump_failing":  # the bowl is not deep enough: target minus centre is positive
        assert "FAULT " in ended
        assert "mean error +" in figures
    (run,) = tmp_path.iterdir()
    assert command(["runs", "show", str(run)]) == 0
    shown = capsys.readouterr().out
    assert f"true centre, 1 s means: {figures}; {in_band} in the band" in shown
    listed = figures.split()[1]
    assert f" {listed} " in shown
    command(["report", str(run)])
    sentence = capsys.readouterr().out
    assert f"{in_band} of its seconds within ±2 µm (true centre: {figures})" in sentence
    assert read_from_console(scenario) == f"true centre, 1 s means: {figures}"


def test_all_is_claimed_only_if_all_was() -> None:
    assert format_in_band(1.0) == "100 %"
    assert format_in_band(0.99999) == "99.99 %"
    assert format_in_band(0.5) == "50 %"
    assert format_in_band(float("nan")) == "–"


def test_figures_that_are_missing_are_dashes() -> None:
    held = HeldError.from_table({"of": "reading", "seconds": 1, "mean_um": 0.1, "std_um": None})
    assert held.figures_text == "std – µm, mean error +0.100 µm"
    assert HeldError.from_table({}).seconds == 0
