"""Repair: files torn by a crash, cut at every kind of place; originals stay unless requested
otherwise.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from membrane_ctrl.cli import run
from membrane_ctrl.model.errors import Exit, InputError
from membrane_ctrl.model.telemetry import unpack_rows
from membrane_ctrl.replay.repair import rebuild_summary, repair_run
from membrane_ctrl.run_files.run_tables import RunTables
from membrane_ctrl.run_files.summary import Summary
from tests.worlds.nights import batch_of
from tests.worlds.virtual_record import CONFIG, kept_ticks, write_record

TICKS = kept_ticks(26.0)
ROWS = unpack_rows([outputs.row.pack() for _, outputs in TICKS])


@pytest.fixture(scope="module")
def crashed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose recorder was killed: journals, no summary."""
    folder = tmp_path_factory.mktemp("runs") / "20261121T010203Z-night"
    folder.mkdir()
    write_record(folder, TICKS, close=False)
    return folder


@pytest.fixture
def folder(crashed: Path, tmp_path: Path) -> Path:
    copy = tmp_path / crashed.name
    shutil.copytree(crashed, copy)
    return copy


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def cut(path: Path, share: float) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])


def test_a_killed_recorders_run_is_readable_and_no_original_is_touched(folder: Path) -> None:
    before = contents(folder)
    findings = {finding.file: finding.state for finding in repair_run(folder)}
    assert findings["events.jsonl"] == findings["inputs"] == "whole"
    assert findings["ticks (1 journals)"] == "open"
    assert findings["summary.json"] == "missing"
    after = contents(folder)
    assert after.pop("summary.json")
    assert after == before


def test_in_place_makes_parts_of_the_journals(folder: Path) -> None:
    cut(folder / "events.jsonl", 0.9)
    repair_run(folder, in_place=True)
    assert not list(folder.rglob("*.journal"))
    assert pq.read_table(folder / "ticks" / "ticks-0000.parquet").num_rows == len(TICKS)
    assert not (folder / "repaired").exists()
    assert (folder / "events.jsonl.torn").stat().st_size > 0
    assert all(json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines())
    assert {finding.state for finding in repair_run(folder)} == {"whole"}


@pytest.mark.parametrize(
    "tail",
    [
        b'{"mono_s": 3, "kind": "sta',
        b"\x00" * 512,
        b'{"a": 1}',
        b"[" * 30_000,
        "\u00e4".encode()[:1],
    ],
)
def test_a_torn_tail_of_the_event_log_is_cut_and_kept(folder: Path, tail: bytes) -> None:
    path = folder / "events.jsonl"
    good = path.read_bytes()
    path.write_bytes(good + tail)
    repair_run(folder)
    assert (folder / "repaired" / "events.jsonl").read_bytes() == good
    assert (folder / "repaired" / "events.jsonl.torn").read_bytes() == tail
    assert path.read_bytes() == good + tail


def test_the_summary_is_rebuilt_as_the_recorder_would_have_written_it(folder: Path) -> None:
    expected = Summary.for_config(CONFIG)
    expected.add_rows(ROWS)
    for inputs, _ in TICKS:
        if inputs.estimate is not None:
            expected.add_shape(inputs.estimate)
    for line in (folder / "events.jsonl").read_text().splitlines():
        expected.add_event(json.loads(line))
    wanted, found = expected.as_dict({}, {}), rebuild_summary(folder)
    assert found["rebuilt"] is True
    for key in (
        "exit",
        "ticks",
        "cycles",
        "transitions",
        "fault_count",
        "band_1s_windows",
        "missed_ticks",
    ):
        assert found[key] == wanted[key], key
    for key in ("true_std_um", "true_bias_um", "reading_std_um", "leak_um_per_s"):
        assert found[key] == pytest.approx(wanted[key], rel=1e-4), key  # a table holds singles
    assert [state["state"] for state in found["states"]] == [
        state["state"] for state in wanted["states"]
    ]


def test_a_run_without_an_end_has_crashed(folder: Path) -> None:
    path = folder / "events.jsonl"
    path.write_text(
        "".join(line for line in path.read_text().splitlines(keepends=True) if '"end"' not in line)
    )
    assert rebuild_summary(folder)["exit"] == "crashed"


@pytest.mark.parametrize("text", ["", "{", "[]", "\x00\x00"])
def test_an_unreadable_summary_is_an_original_too(folder: Path, text: str) -> None:
    (folder / "summary.json").write_text(text)
    repair_run(folder)
    assert (folder / "summary.json").read_text() == text
    assert json.loads((folder / "repaired" / "summary.json").read_text())["rebuilt"] is True
    repair_run(folder, in_place=True)
    assert json.loads((folder / "summary.json").read_text())["ticks"] == len(TICKS)


def test_a_run_with_nothing_but_its_configuration_is_no_error(folder: Path) -> None:
    (folder / "events.jsonl").unlink()
    for path in folder.glob("*/"):
        shutil.rmtree(path)
    states = {finding.file: finding.state for finding in repair_run(folder)}
    assert states == {"events.jsonl": "missing", "summary.json": "missing"}
    assert json.loads((folder / "summary.json").read_text())["ticks"] == 0


@pytest.mark.parametrize("config", [b"\0" * 500, b"\xff", b"[loop]\nrate = 3\n"])
def test_a_damaged_configuration_is_named_and_keeps_nothing_from_being_mended(
    folder: Path, config: bytes
) -> None:
    (folder / "config.toml").write_bytes(config)
    findings = {finding.file: finding for finding in repair_run(folder)}
    assert "config.toml" in findings["config.toml"].action
    assert findings["summary.json"].state == "missing"
    assert json.loads((folder / "summary.json").read_text())["rebuilt"]


def test_what_cannot_be_read_is_one_line(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "events.jsonl").unlink()
    (folder / "events.jsonl").mkdir()
    assert run(["repair", str(folder)]) == Exit.BAD_INPUT
    assert capsys.readouterr().err.endswith("events.jsonl: is a folder, not a file\n")


def test_a_run_that_is_still_recorded_is_left_alone(folder: Path) -> None:
    (folder / ".recorder-state").write_bytes(b"")
    with pytest.raises(InputError, match="still being recorded"):
        repair_run(folder)


def test_the_command_reports_its_actions(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    repair_run(folder, in_place=True)
    (folder / "summary.json").unlink()
    cut(folder / "inputs" / "inputs-0000.parquet", 0.5)
    assert run(["repair", str(folder), "--json"]) == Exit.DONE
    out = capsys.readouterr()
    states = {row["file"]: row["state"] for row in json.loads(out.out)["files"]}
    assert states == {"events.jsonl": "whole", "inputs": "torn", "summary.json": "missing"}
    assert run(["repair", str(tmp_path)]) == Exit.BAD_INPUT
    assert "not a run folder" in capsys.readouterr().err


def test_with_tables_the_statistics_are_of_every_tick(folder: Path) -> None:
    for path in folder.glob("*/"):
        shutil.rmtree(path)
    tables = RunTables(folder)
    tables.add_ticks(batch_of(ROWS))
    tables.sync_tables()  # and then it was killed
    expected = Summary.for_config(CONFIG)
    expected.add_rows(ROWS)
    wanted = expected.as_dict({}, {})
    for path in folder.glob("*.rrd"):
        path.unlink()
    found = rebuild_summary(folder)
    assert found["ticks"] == len(ROWS)
    for key in ("true_std_um", "true_bias_um", "leak_um_per_s"):
        assert found[key] == pytest.approx(wanted[key], rel=1e-4), key  # a table holds singles
