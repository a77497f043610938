"""Repair: files torn by a crash, cut at every kind of place; originals stay unless requested otherwise."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from benchmarks.nights import batch_of
from membrane_ctrl.cli import run
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.errors import Exit, InputError
from membrane_ctrl.model.telemetry import COLUMN, unpack
from membrane_ctrl.recorder.rerun_streams import TelemetryStreams
from membrane_ctrl.recorder.sink import Recording, is_whole
from membrane_ctrl.replay.repair import read_rows, rebuild_summary, repair
from membrane_ctrl.run_files.summary import Summary
from membrane_ctrl.run_files.tables import ColumnTables
from tests.support.virtual_record import CONFIG, kept_ticks, write_record

TICKS = kept_ticks(26.0)
ROWS = unpack([outputs.row.pack() for _, outputs in TICKS])


@pytest.fixture(scope="module")
def crashed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose recorder was killed: two segments, the second without its footer, no summary."""
    folder = tmp_path_factory.mktemp("runs") / "20261121T010203Z-night"
    folder.mkdir()
    write_record(folder, TICKS)
    recording = Recording(folder, "night", RunClock.start(), CONFIG)
    streams = TelemetryStreams(recording, CONFIG)
    for first in range(0, len(ROWS), 50):
        if first in (0, 400):
            recording.next_segment()
            streams.start_segment()
        streams.send(ROWS[first : first + 50])
        recording.flush()
    torn = (folder / "night-001.rrd").read_bytes()
    recording.close()
    (folder / "night-001.rrd").write_bytes(torn)
    return folder


@pytest.fixture
def folder(crashed: Path, tmp_path: Path) -> Path:
    copy = tmp_path / crashed.name
    shutil.copytree(crashed, copy)
    return copy


@pytest.fixture
def tables(folder: Path) -> Path:
    """The same without its segments, whose repair takes a second."""
    for path in folder.glob("*.rrd"):
        path.unlink()
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def cut(path: Path, share: float) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])


def test_a_segment_is_read_back_to_the_last_bit(crashed: Path) -> None:
    found = read_rows(crashed / "night-000.rrd")
    assert len(found) == 400
    assert np.array_equal(found[:, 1:], ROWS[:400, 1:], equal_nan=True)
    assert found[:, 0] == pytest.approx(ROWS[:400, 0], abs=1e-9)


def test_a_killed_recorders_run_is_whole_again_and_no_original_is_touched(folder: Path) -> None:
    before = contents(folder)
    findings = {finding.file: finding.state for finding in repair(folder)}
    assert findings["night-000.rrd"] == findings["events.jsonl"] == "whole"
    assert findings["night-001.rrd"] == "torn"
    assert findings["summary.json"] == "missing"
    after = contents(folder)
    assert after.pop("summary.json")
    assert after == before
    repaired = folder / "repaired" / "night-001.rrd"
    assert is_whole(repaired)
    assert np.array_equal(read_rows(repaired)[:, 1:], ROWS[400:, 1:], equal_nan=True)


def test_in_place_replaces_what_was_torn(folder: Path) -> None:
    cut(folder / "events.jsonl", 0.9)
    repair(folder, in_place=True)
    assert is_whole(folder / "night-001.rrd")
    assert not (folder / "repaired").exists()
    assert (folder / "events.jsonl.torn").stat().st_size > 0
    assert all(json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines())
    assert {finding.state for finding in repair(folder)} == {"whole"}


@pytest.mark.parametrize("share", [0.0, 0.001, 0.5, 0.77, 0.999])  # it begins with statics
def test_a_segment_cut_anywhere_gives_back_what_is_before_the_cut(folder: Path, share: float) -> None:
    cut(folder / "night-001.rrd", share)
    finding = next(found for found in repair(folder) if found.file == "night-001.rrd")
    assert finding.state == "torn"
    repaired = folder / "repaired" / "night-001.rrd"
    if share < 0.01:
        assert "nothing could be recovered" in finding.action
        assert not repaired.exists()
        return
    assert is_whole(repaired)
    found = read_rows(repaired)
    assert len(found) >= {0.5: 100, 0.77: 300, 0.999: 800}[share]
    # of the second that was cut, some streams may be there and others not
    whole = len(found) - 50
    assert np.array_equal(found[:whole, 1:], ROWS[400 : 400 + whole, 1:], equal_nan=True)


def test_a_segment_with_a_bad_block_gives_back_what_is_readable(folder: Path) -> None:
    path = folder / "night-001.rrd"
    data = bytearray(path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 4096] = bytes(4096)
    path.write_bytes(data)
    repair(folder)
    assert len(read_rows(folder / "repaired" / "night-001.rrd")) >= 100


@pytest.mark.parametrize(
    "tail", [b'{"mono_s": 3, "kind": "sta', b"\x00" * 512, b'{"a": 1}', b"[" * 30_000, "\u00e4".encode()[:1]]
)
def test_a_torn_tail_of_the_event_log_is_cut_and_kept(tables: Path, tail: bytes) -> None:
    path = tables / "events.jsonl"
    good = path.read_bytes()
    path.write_bytes(good + tail)
    repair(tables)
    assert (tables / "repaired" / "events.jsonl").read_bytes() == good
    assert (tables / "repaired" / "events.jsonl.torn").read_bytes() == tail
    assert path.read_bytes() == good + tail


def test_the_summary_is_rebuilt_as_the_recorder_would_have_written_it(folder: Path) -> None:
    expected = Summary(CONFIG)
    expected.add_rows(ROWS)
    for inputs, _ in TICKS:
        if inputs.estimate is not None:
            expected.add_shape(inputs.estimate)
    for line in (folder / "events.jsonl").read_text().splitlines():
        expected.add_event(json.loads(line))
    wanted, found = expected.as_dict({}, {}), rebuild_summary(folder)
    assert found["rebuilt"] is True
    for key in ("exit", "ticks", "cycles", "transitions", "fault_count", "band_1s_windows", "missed_ticks"):
        assert found[key] == wanted[key], key
    for key in ("true_std_um", "true_bias_um", "reading_std_um", "leak_um_per_s"):
        assert found[key] == pytest.approx(wanted[key], rel=1e-4), key  # a table holds singles
    assert [state["state"] for state in found["states"]] == [state["state"] for state in wanted["states"]]


def test_a_run_without_an_end_has_crashed(folder: Path) -> None:
    path = folder / "events.jsonl"
    path.write_text("".join(line for line in path.read_text().splitlines(keepends=True) if '"end"' not in line))
    assert rebuild_summary(folder)["exit"] == "crashed"


@pytest.mark.parametrize("text", ["", "{", "[]", "\x00\x00"])
def test_an_unreadable_summary_is_an_original_too(tables: Path, text: str) -> None:
    (tables / "summary.json").write_text(text)
    repair(tables)
    assert (tables / "summary.json").read_text() == text
    assert json.loads((tables / "repaired" / "summary.json").read_text())["rebuilt"] is True
    repair(tables, in_place=True)
    assert json.loads((tables / "summary.json").read_text())["ticks"] == len(TICKS)


def test_a_run_with_nothing_but_its_configuration_is_no_error(folder: Path) -> None:
    for path in [*folder.glob("*.rrd"), folder / "events.jsonl"]:
        path.unlink()
    shutil.rmtree(folder / "columns")
    states = {finding.file: finding.state for finding in repair(folder)}
    assert states == {"events.jsonl": "missing", "summary.json": "missing"}
    assert json.loads((folder / "summary.json").read_text())["ticks"] == 0


@pytest.mark.parametrize("config", [b"\0" * 500, b"\xff", b"[loop]\nrate = 3\n"])
def test_a_damaged_configuration_is_named_and_keeps_nothing_from_being_mended(tables: Path, config: bytes) -> None:
    (tables / "config.toml").write_bytes(config)
    findings = {finding.file: finding for finding in repair(tables)}
    assert "config.toml" in findings["config.toml"].action
    assert findings["summary.json"].state == "missing"
    assert json.loads((tables / "summary.json").read_text())["rebuilt"]


def test_what_cannot_be_read_is_one_line(tables: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tables / "events.jsonl").unlink()
    (tables / "events.jsonl").mkdir()
    assert run(["repair", str(tables)]) == Exit.BAD_INPUT
    assert capsys.readouterr().err.endswith("events.jsonl: is a folder, not a file\n")


def test_a_run_that_is_still_recorded_is_left_alone(folder: Path) -> None:
    (folder / ".recorder-state").write_bytes(b"")
    with pytest.raises(InputError, match="still being recorded"):
        repair(folder)


def test_the_command_says_what_it_did(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cut(folder / "columns" / "ticks-000.arrows", 0.5)
    assert run(["repair", str(folder), "--json"]) == Exit.DONE
    out = capsys.readouterr()
    states = {row["file"]: row["state"] for row in json.loads(out.out)["files"]}
    assert states == {
        "night-000.rrd": "whole", "night-001.rrd": "torn", "events.jsonl": "whole",
        "inputs (1 files)": "torn", "summary.json": "missing",
    }  # fmt: skip
    assert "--in-place" in out.err
    assert run(["repair", str(tmp_path)]) == Exit.BAD_INPUT
    assert "not a run folder" in capsys.readouterr().err


def test_what_is_thinned_out_in_quiet_is_still_counted(folder: Path) -> None:
    assert COLUMN["mono_s"] == 0  # `recorded_run` finds a row by it
    for path in folder.glob("*.rrd"):
        path.unlink()
    assert rebuild_summary(folder)["ticks"] == len(TICKS)


def test_with_tables_the_statistics_are_of_every_tick(folder: Path) -> None:
    shutil.rmtree(folder / "columns")
    tables = ColumnTables(folder)
    tables.add_ticks(batch_of(ROWS))
    tables.sync()  # and then it was killed
    expected = Summary(CONFIG)
    expected.add_rows(ROWS)
    wanted = expected.as_dict({}, {})
    for path in folder.glob("*.rrd"):
        path.unlink()
    found = rebuild_summary(folder)
    assert found["ticks"] == len(ROWS)
    for key in ("true_std_um", "true_bias_um", "leak_um_per_s"):
        assert found[key] == pytest.approx(wanted[key], rel=1e-4), key  # a table holds singles
