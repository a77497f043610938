"""A replay elsewhere: other last bits of numbers are no difference, other decisions and other
numbers are.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from membrane_ctrl.cli import run
from membrane_ctrl.control import filters
from membrane_ctrl.model.arithmetic import describe_arithmetic, find_model
from membrane_ctrl.model.columns import COLUMNS, Kind
from membrane_ctrl.model.errors import Exit
from membrane_ctrl.model.telemetry import FIELDS, TelemetryRow
from membrane_ctrl.replay import command
from membrane_ctrl.replay import replay as replays
from membrane_ctrl.replay.numbers import RecordedRows
from membrane_ctrl.run_files.inputs_file import InputsReader
from membrane_ctrl.run_files.run_tables import as_recorded
from tests.worlds.virtual_record import kept_ticks, laser_lost, snapshot_at, write_record

TICKS = kept_ticks(16.0, laser_lost)
SNAPSHOTS = {500: snapshot_at(TICKS, 500)}


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("20261121T010203Z-night")
    write_record(folder, TICKS, snapshots=SNAPSHOTS)
    return folder


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "describe_arithmetic", lambda: "another processor")


@pytest.fixture
def off_by(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Compute every lag wrong by a share."""
    smoothing = filters.lag_step_fraction

    def compute_wrong(share: float) -> None:
        monkeypatch.setattr(
            filters, "lag_step_fraction", lambda dt_s, lag_s: smoothing(dt_s, lag_s) * (1.0 + share)
        )

    return compute_wrong


def replayed(folder: Path, capsys: pytest.CaptureFixture[str]) -> tuple[int, dict[str, object]]:
    code = run(["replay", str(folder), "--json"])
    return code, json.loads(capsys.readouterr().out)


@pytest.mark.usefixtures("elsewhere")
def test_the_same_bits_are_identical_anywhere(
    record: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, report = replayed(record, capsys)
    assert (code, report["verdict"], report["near"]) == (Exit.DONE, "identical", 0)
    assert report["computed_on"] == describe_arithmetic()


@pytest.mark.usefixtures("elsewhere")
def test_other_last_bits_are_no_difference_and_are_reported(
    record: Path, capsys: pytest.CaptureFixture[str], off_by: Callable[[float], None]
) -> None:
    off_by(1e-13)
    code, report = replayed(record, capsys)
    assert (code, report["verdict"], report["different"]) == (Exit.DONE, "same numbers", 0)
    assert 100 < int(str(report["near"])) <= len(TICKS)
    assert report["state_differences"] is None
    assert run(["replay", str(record)]) == Exit.DONE
    output = capsys.readouterr().out
    assert "another processor, or with other libraries" in output
    assert "have other last bits" in output


@pytest.mark.usefixtures("elsewhere")
@pytest.mark.parametrize("share", [1e-3, 3e-9])
def test_other_numbers_are_a_difference(
    share: float, record: Path, capsys: pytest.CaptureFixture[str], off_by: Callable[[float], None]
) -> None:
    """A small one shows in the snapshot alone: the table of ticks has single precision."""
    off_by(share)
    code, report = replayed(record, capsys)
    assert (code, report["verdict"]) == (Exit.REJECTED, "different")
    assert report["state_differences"] is not None
    assert report["different"] or share < 1e-4


def test_on_the_same_processor_other_last_bits_are_a_difference(
    record: Path, capsys: pytest.CaptureFixture[str], off_by: Callable[[float], None]
) -> None:
    off_by(1e-13)
    code, report = replayed(record, capsys)
    assert (code, report["verdict"], report["computed_on"]) == (Exit.REJECTED, "different", None)


def test_a_column_that_the_program_does_not_have_leaves_the_others_compared(
    record: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(InputsReader, "columns", property(lambda _: [*FIELDS, "gone_um"]))
    monkeypatch.setattr(replays, "output_crc", lambda *_: -1)  # it lacks the column
    code, report = replayed(record, capsys)
    assert (code, report["verdict"], report["unknown_columns"]) == (
        Exit.DONE,
        "same numbers",
        ["gone_um"],
    )
    assert report["near"] == report["compared"] == len(TICKS)


ROW = TelemetryRow(
    **{
        name: float(place) if column.kind is not Kind.QUANTITY else 0.1 * place
        for place, (name, column) in enumerate(COLUMNS.items())
    }
)


def rows_of(row: TelemetryRow) -> RecordedRows:
    return RecordedRows(iter([{name: np.array([getattr(row, name)]) for name in FIELDS}]))


@pytest.mark.parametrize(
    ("change", "differing"),
    [
        ({}, ()),
        ({"trim_um": 1e-8}, ()),  # single precision in the record
        ({"trim_um": 1e-5}, ("trim_um",)),
        ({"mono_s": 1e-12}, ()),
        ({"mono_s": 1e-8}, ("mono_s",)),
        ({"fault": 1.0}, ("fault",)),
        ({"trim_um": math.nan, "leak_um_per_s": math.inf}, ("leak_um_per_s", "trim_um")),
    ],
)
def test_codes_are_exact_and_numbers_as_exact_as_recorded(
    change: dict[str, float], differing: tuple[str, ...]
) -> None:
    today = replace(ROW, **{name: getattr(ROW, name) + by for name, by in change.items()})
    assert rows_of(as_recorded(ROW)).find_differing(today) == differing


def test_a_missing_value_is_the_same_twice_and_a_row_that_is_missing_is_none() -> None:
    missing = replace(ROW, trim_um=math.nan)
    assert rows_of(missing).find_differing(missing) == ()
    assert rows_of(ROW).find_differing(replace(ROW, tick=1e6)) is None
    assert RecordedRows(iter([])).find_differing(ROW) is None


def test_the_processor_is_described_by_its_model() -> None:
    assert (
        find_model("processor\t: 0\nmodel name\t: Foo 9\n\nprocessor\t: 1\nmodel name\t: Foo 9\n")
        == "Foo 9"
    )
    assert find_model("processor: 0\nCPU implementer: 0x41\nCPU part: 0xd0b\n") == "0x41 0xd0b"
    assert find_model("") == ""
    assert f"NumPy {np.__version__}" in describe_arithmetic()
