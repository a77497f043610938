"""What `hold` and `twin play` report at their end: a fault first, then the figures, and a changed
run folder.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from membrane_ctrl import cli
from membrane_ctrl.hold.closing_words import RunEnd, make_closing_lines, print_closing_report
from membrane_ctrl.model.errors import Exit
from membrane_ctrl.model.events import Cleared, Event, Fault, StateEntered
from membrane_ctrl.model.standing_fault import fault_of_end, standing_fault_after
from membrane_ctrl.review import catalogue


def words(run_dir: Path, capsys: pytest.CaptureFixture[str]) -> str:
    print_closing_report(run_dir, as_json=False)
    return capsys.readouterr().err


def test_a_folder_that_is_gone_is_not_offered(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    captured = words(tmp_path / "run", capsys)
    assert "removed or moved" in captured
    assert "rerun" not in captured
    assert "are readable" not in captured


def test_a_recreated_folder_states_when_it_begins(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "summary.json").write_text(json.dumps({"recorder": {"folder_replaced_s": 13.44}}))
    assert "starts at 13.4 s" in words(tmp_path, capsys)
    (tmp_path / "summary.json").write_text(json.dumps({"recorder": {"folder_replaced_s": None}}))
    assert "starts at" not in words(tmp_path, capsys)


def test_only_a_recording_that_is_there_is_offered(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "open it" not in words(tmp_path, capsys)
    (tmp_path / "ticks").mkdir()
    assert "open it" not in words(tmp_path, capsys)
    (tmp_path / "ticks" / "ticks-0000.journal").touch()
    assert f"open it:    membrane-ctrl review {tmp_path}\n" in words(tmp_path, capsys)
    monkeypatch.chdir(tmp_path)
    run_dir = Path("logs/20261122T031200Z-hold")
    (run_dir / "ticks").mkdir(parents=True)
    (run_dir / "ticks" / "ticks-0000.parquet").touch()
    assert "open it:    membrane-ctrl review last\n" in words(run_dir, capsys)


FAULT = Fault(
    14,
    "laser_implausible",
    "the laser is wrong",
    "laser +9 µm",
    "limits.x",
    "hold_flow",
    False,
    "look",
)


@pytest.mark.parametrize(
    ("exit_", "fault", "message"),
    [
        (
            Exit.SAFETY_TRIP,
            FAULT,
            ["FAULT 14 laser_implausible: the laser is wrong", "laser +9 µm", "look"],
        ),
        (Exit.DEVICE_FAILED, FAULT, ["FAULT 14 laser_implausible", "laser +9 µm", "look"]),
        (Exit.DEVICE_FAILED, None, ["DEVICE FAILED", "to do: ", "supply"]),
        (Exit.SAFETY_TRIP, None, ["SAFETY TRIP", "to do: "]),
        (Exit.DONE, None, []),
        (Exit.DONE, FAULT, []),  # stopped while the cause was there, and ended well
        (Exit.INTERRUPTED, None, []),
        (Exit.REJECTED, None, ["NEVER HELD: the duration was over in the state starting"]),
    ],
)
def test_a_run_that_ends_in_a_fault_states_the_fault_first(
    exit_: Exit,
    fault: Fault | None,
    message: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    closing = RunEnd(exit_, fault, 205.5)
    (tmp_path / "summary.json").write_text(json.dumps({"recorder": {}, "missed_ticks": 3}))
    print_closing_report(tmp_path, False, closing)
    lines = capsys.readouterr().err.splitlines()
    count = len(make_closing_lines(closing))
    first = "\n".join(lines[:count])
    assert all(part in first for part in message)
    assert (count > 0) == bool(message)
    assert lines[count].startswith("held:")
    assert lines[count + 1].startswith("missed ticks:")


def test_the_fault_is_printed_without_a_disk_and_with_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for as_json in (False, True):
        print_closing_report(tmp_path / "gone", as_json, RunEnd(Exit.SAFETY_TRIP, FAULT, 1.0))
        printed = capsys.readouterr()
        assert printed.err.startswith("FAULT 14 laser_implausible")
        assert printed.out == ("{}\n" if as_json else "")


def test_the_closing_words_name_the_fault_that_is_still_latched() -> None:
    def standing(*events: Event) -> Fault | None:
        fault: Fault | None = None
        for event in events:
            fault = standing_fault_after(fault, event)
        return fault

    assert standing(FAULT) == FAULT
    assert standing(FAULT, StateEntered("fault", "hold", "latched")) == FAULT
    assert standing(FAULT, Cleared("laser_implausible")) is None
    assert (
        standing(
            FAULT, StateEntered("fault", "hold", "latched"), StateEntered("standby", "fault", "ack")
        )
        is None
    )
    assert fault_of_end(FAULT, "safety_trip") == fault_of_end(FAULT, "device_failed") == FAULT
    assert fault_of_end(FAULT, None) == fault_of_end(FAULT, "crashed") == FAULT
    assert fault_of_end(FAULT, "done") is None
    assert fault_of_end(FAULT, "interrupted") is None


# What ends a scenario, the exit code, and the fault that must be named.
ENDS = {
    "lost device": ('[[at]]\ntime_s = 22.0\nwrong = "silent"\n', 5, "device_silent"),
    "lost laser": ('[[at]]\ntime_s = 22.0\nwrong = "no_light"\n', 5, "displacement_missing"),
    "operator": ('[[at]]\ntime_s = 22.0\ncommand = "latch"\ntext = "hands inside"\n', 5, "locked"),
    "cleared": ('[[at]]\ntime_s = 22.0\nwrong = "no_light"\nfor_s = 1.0\n', 0, ""),
}


@pytest.mark.parametrize("what", ENDS)
def test_exit_code_words_summary_and_catalogue_agree(
    what: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    happens, code, name = ENDS[what]
    scene = tmp_path / "scene.toml"
    scene.write_text(
        'title = "x"\nduration_s = 60.0\n[config.loop]\nrate_hz = '
        '10.0\n[config.twin]\nscenario = "calm"\n'
        f"start_error_um = -5.0\n[config.states]\nactuator_test = false\n{happens}"
    )
    logs = tmp_path / "logs"
    assert cli.run(["twin", "play", str(scene), "--logs", str(logs)]) == code
    lines = capsys.readouterr().err.splitlines()
    (entry,) = catalogue.list_entries(logs)
    summary = json.loads((entry.folder / "summary.json").read_text())
    assert summary["exit"] == entry.exit == Exit(code).name.lower()
    assert summary["end"]["exit_code"] == code
    assert entry.ended_in == name
    assert (summary["ended_in"] or {"name": ""})["name"] == name
    fault_line = lines[2]
    assert fault_line.startswith("FAULT ") == bool(name)
    assert name in fault_line
    if name:
        assert lines[3].strip().startswith("seen:")
        assert lines[4].strip().startswith("to do:")
    assert cli.run(["runs", "--logs", str(logs)]) == 0
    assert name in capsys.readouterr().out


@pytest.mark.parametrize(
    ("finished", "has_held", "is_standby", "exit_"),
    [
        (Exit.DONE, True, False, Exit.DONE),
        (Exit.DONE, False, False, Exit.REJECTED),
        (Exit.DONE, False, True, Exit.DONE),  # it was to wait
        (Exit.INTERRUPTED, False, False, Exit.INTERRUPTED),  # a person ended it
        (Exit.SAFETY_TRIP, False, False, Exit.SAFETY_TRIP),
    ],
)
def test_a_run_whose_duration_ends_before_it_held_has_failed(
    finished: Exit, has_held: bool, is_standby: bool, exit_: Exit
) -> None:
    assert RunEnd(has_held=has_held).judge_exit(finished, is_standby) is exit_
