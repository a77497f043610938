"""A report of a part ignores the rest of the run, and is compared as stated."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from membrane_ctrl.cli import run as command
from membrane_ctrl.model.telemetry import COLUMN, get_column
from membrane_ctrl.review import open_run
from membrane_ctrl.review.run_times import is_from_start
from membrane_ctrl.review.statistics.analysis import analyse_run
from tests.support.review_runs import written
from tests.worlds.nights import night, write_run

HOURS = 0.1


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six minutes with a fault at 50 s and at 300 s, and 5 ticks missed before 100 s,
    2 at 200 s.
    """
    rows, shapes = night(1, HOURS, "typical", [])
    time_s = get_column(rows, "mono_s")
    rows[:, COLUMN["missed_ticks"]] = 5.0 * (time_s > 60) + 2.0 * (time_s > 200)
    folder = tmp_path_factory.mktemp("part") / "20261121T180000Z-part"
    write_run(folder, iter([(rows, shapes)]))
    faults = [
        {"mono_s": at_s, "kind": "fault", "name": "displacement_missing"} for at_s in (50.0, 300.0)
    ]
    with (folder / "events.jsonl").open("a") as file:
        file.write("".join(json.dumps(fault) + "\n" for fault in faults))
    return folder


def _seen(folder: Path, start_s: float, end_s: float) -> dict[str, str]:
    return {odd.name: odd.seen for odd in analyse_run(open_run(folder), start_s, end_s).anomalies}


def test_faults_and_missed_ticks_of_a_part_are_its_own(folder: Path) -> None:
    whole = _seen(folder, -float("inf"), float("inf"))
    assert whole["fault"] == "displacement_missing, 2 times"
    assert whole["missed ticks"].startswith("7 of")
    assert not {"fault", "missed ticks"} & set(_seen(folder, 100.0, 180.0))
    later = _seen(folder, 180.0, 320.0)
    assert later["fault"] == "displacement_missing, 1 time"
    assert later["missed ticks"].startswith("2 of")
    assert _seen(folder, -float("inf"), 100.0)["missed ticks"].startswith("5 of")


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    ("part", "whole", "message"),
    [
        # the plus sign may be omitted
        (["--from", "100s", "--to", "+180s"], False, ", same part: Held for 1 min 15 s"),
        (["--from", "18:02", "--to", "18:04"], True, ", all of it: Held for 5 min 55 s"),
        ([], True, "-other: Held for 5 min 55 s"),
    ],
)
def test_a_part_is_compared_with_the_same_part_or_marked_as_not_compared(
    folder: Path,
    tmp_path: Path,
    part: list[str],
    whole: bool,
    message: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    other = written(tmp_path, HOURS, seed=8, name="20261122T180000Z-other")
    assert (
        command(
            ["report", str(folder), *part, "--compare", str(other), "--out", str(tmp_path / "o")]
        )
        == 0
    )
    assert message in capsys.readouterr().out
    table = json.loads((tmp_path / "o" / "report.json").read_text())["compared_with"]
    assert table["whole_run"] is whole
    page = (tmp_path / "o" / "report.html").read_text()
    assert ("Part of this run against the whole other run" in page) is (whole and bool(part))


@pytest.mark.parametrize("text", ["+100s", "100s", "1h5m", "0", " +0s"])
def test_a_duration_is_counted_from_the_start(text: str) -> None:
    assert is_from_start(text)


@pytest.mark.parametrize("text", ["03:12", "03:12:30", "2026-11-21T03:12:00", "2026-11-21"])
def test_a_time_of_day_and_a_date_are_not(text: str) -> None:
    assert not is_from_start(text)
