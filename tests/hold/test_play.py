"""A played scenario is a run like any other."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from membrane_ctrl import cli
from membrane_ctrl.config.schema import RecordingConfig
from membrane_ctrl.hold import play
from membrane_ctrl.hold.scenario_file import Scenario, load_scenario
from membrane_ctrl.hold.scenario_run import ScenarioRun
from membrane_ctrl.hold.scenarios import find_scenario, list_scenario_files
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.errors import Exit, InputError
from membrane_ctrl.run_files.run import open_run

DROPOUT = """
title = "A laser that is gone for a second"
duration_s = 30.0
shapes = true
[config.loop]
rate_hz = 10.0
[config.twin]
scenario = "calm"
start_error_um = -5.0
[config.recording]
logs_dir = "elsewhere"
keep_gb = 0.1
[[at]]
time_s = 22.0
wrong = "no_light"
for_s = 1.0
[[at]]
time_s = 25.0
command = "mark"
text = "light again"
"""


def test_a_played_scenario_is_a_run_for_every_reader(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("old-run").mkdir()
    Path("dropout.toml").write_text(DROPOUT)
    assert cli.run(["twin", "play", "dropout.toml"]) == Exit.DONE
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "loading the simulated bench"
    assert "A laser that is gone for a second" in lines[1]
    assert lines[-1] == "open it:    membrane-ctrl review last"
    (folder,) = (path for path in Path("logs").iterdir() if path.is_dir())
    assert folder.name.endswith("-dropout")
    run = open_run(folder)
    run.read_all_parts()
    assert run.notes == []
    assert (
        run.config.recording == RecordingConfig()
    )  # a file decides neither where runs are nor which are deleted
    assert not Path("elsewhere").exists()
    rows = run.ticks()
    assert rows.num_rows == run.summary["ticks"]  # type: ignore[index]
    assert 30.0 < rows["time_s"][-1].as_py() < 35.0  # with the stop
    kinds = [event["kind"] for event in run.events]
    assert (kinds[0], kinds[-1]) == ("start", "end")
    (fault,) = (event for event in run.events if event["kind"] == "fault")
    assert (fault["name"], fault["mono_s"]) == (
        "displacement_missing",
        pytest.approx(22.3, abs=0.3),
    )
    assert any(event["kind"] == "mark" and event["text"] == "light again" for event in run.events)
    assert len(run.shapes().time_s) >= 10
    assert run.summary["exit"] == "done"  # type: ignore[index]
    assert cli.run(["replay", str(folder)]) == Exit.DONE
    assert "identical" in capsys.readouterr().out


def test_names_have_titles_and_accept_dashes_for_underscores(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert cli.run(["twin", "play"]) == Exit.DONE
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == [path.stem for path in list_scenario_files()]
    assert all(
        load_scenario(path, Scenario).title in line
        for path, line in zip(list_scenario_files(), lines, strict=True)
    )
    assert find_scenario("calm-night") == find_scenario("calm_night")
    assert cli.run(["twin", "play", "bright_day"]) == Exit.BAD_INPUT
    assert "bright_day: no such scenario" in capsys.readouterr().err


def test_a_file_cannot_require_more_than_fits_in_memory(tmp_path: Path) -> None:
    path = tmp_path / "many.toml"
    path.write_text(
        'title = "x"\nduration_s = 1e7\n[[at]]\ntime_s = 0.0\nwrong = "silent"\nfor_s = '
        "1e-4\nevery_s = 1e-3\n"
    )
    with pytest.raises(InputError, match=r"at\.0: every_s"):
        load_scenario(path, Scenario)


def short_run() -> ScenarioRun:
    return ScenarioRun(
        Scenario.model_validate({"title": "x", "config": {"loop": {"rate_hz": 10.0}}})
    )


def test_a_stopped_run_ends_in_the_safe_state() -> None:
    run = short_run()
    for number, _ in enumerate(run.ticks()):
        if number == 50:
            run.stop("SIGINT")
    assert run.virtual.finished == Exit.INTERRUPTED
    assert run.virtual.now_s < 20.0
    assert run.bench.board.pump_fraction == 0.0


def test_in_real_time_each_tick_comes_at_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = [1000.0]
    monkeypatch.setattr(time, "monotonic", lambda: now_s[0])
    monkeypatch.setattr(time, "sleep", lambda pause_s: now_s.__setitem__(0, now_s[0] + pause_s))
    run, seen = short_run(), []
    for _ in play._pace_ticks(run, run.ticks(), RunClock.start()):
        seen.append(now_s[0] - 1000.0 - run.virtual.now_s)
        now_s[0] += 0.25 if len(seen) == 20 else 0.01
        if len(seen) == 40:
            break
    assert seen[:20] == pytest.approx([0.0] * 20)
    assert seen[20] == pytest.approx(0.15)  # after a pause the next ones follow at once
    assert seen[-1] == pytest.approx(0.0)
