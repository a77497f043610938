"""Runs with damaged files: gaps are named, the rest is shown, and nothing of the run is touched."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from benchmarks.nights import night
from membrane_ctrl.cli import run as cli
from membrane_ctrl.model.plain_json import dumps_checked, with_comment
from membrane_ctrl.model.telemetry import FIELDS, column
from membrane_ctrl.review import open_run
from membrane_ctrl.run_files.column_file import FILE_S
from membrane_ctrl.run_files.column_reader import column_files
from membrane_ctrl.run_files.sealed_stream import unseal, whole_batches
from membrane_ctrl.run_files.segments import whole_messages
from tests.support.review_runs import segment, set_summary, tables, written

HOURS = 0.1
FLIP = 3  # bytes


def _flipped(data: bytes, place: int, count: int = FLIP) -> bytes:
    changed = bytearray(data)
    changed[place : place + count] = bytes(byte ^ 0xFF for byte in changed[place : place + count])
    return bytes(changed)


def _as_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def _as_loop(path: Path) -> None:
    path.unlink()
    path.symlink_to(path.name)


HARM: dict[str, Callable[[Path], object]] = {
    "empty": lambda path: path.write_bytes(b""),
    "half": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "garbage": lambda path: path.write_bytes(np.random.default_rng(1).bytes(path.stat().st_size)),
    "missing": Path.unlink,
    "folder": _as_folder,
    "loop": _as_loop,
    "flipped": lambda path: path.write_bytes(_flipped(path.read_bytes(), path.stat().st_size // 2)),
}
CASES = (
    ("columns/ticks-000.arrows", "garbage"), ("columns/ticks-000.arrows", "folder"),
    ("columns/ticks-000.arrows", "missing"), ("columns/levels_1s-000.arrows", "flipped"),
    ("columns/levels_60s-000.arrows", "loop"), ("columns/shapes-000.arrows", "half"), ("config.toml", "empty"),
    ("config.toml", "loop"), ("config.toml", "flipped"), ("events.jsonl", "folder"), ("events.jsonl", "empty"),
    ("events.jsonl", "flipped"), ("summary.json", "garbage"), ("night-000.rrd", "half"), ("night-000.rrd", "folder"),
)  # fmt: skip


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run, six minutes at 10 Hz, with everything that the recorder writes."""
    folder = written(tmp_path_factory.mktemp("sound"), HOURS)
    segment(folder, night(1, HOURS, "typical", [])[0][:600])
    names = ("ticks", "shapes", "levels_1s", "levels_10s", "levels_60s")
    set_summary(folder, recorder={"segments": 1, "tables": dict.fromkeys(names, 1)})
    for path in (folder / "summary.json", folder / "events.jsonl"):
        checked = [dumps_checked(table) for table in _objects(path)]
        path.write_text("\n".join(checked) + "\n")
    config = folder / "config.toml"
    config.write_text(with_comment(config.read_text()))
    return folder


def _objects(path: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def _content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_sound_run_has_nothing_to_say(sound: Path) -> None:
    run = open_run(sound)
    run.look_through()
    assert run.notes == []


@pytest.mark.parametrize(("file", "harm"), CASES)
def test_any_file_may_be_damaged(
    sound: Path, tmp_path: Path, file: str, harm: str, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = shutil.copytree(sound, tmp_path / sound.name)
    HARM[harm](folder / file)
    before = _content(folder)
    assert cli(["runs", "show", str(folder)]) == 0
    said = capsys.readouterr().out
    assert Path(file).name in said
    run = open_run(folder)
    assert run.ticks(["error_um"]).num_rows > 500
    assert run.level(60.0)["time_s"].size > 0
    assert cli(["runs", "--logs", str(tmp_path)]) == 0
    assert _content(folder) == before


def test_report_and_export_show_the_rest(sound: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = shutil.copytree(sound, tmp_path / sound.name)
    whole = open_run(folder).level(10.0)
    (folder / "columns" / "levels_10s-000.arrows").unlink()
    HARM["half"](folder / "columns" / "levels_1s-000.arrows")
    HARM["half"](folder / "events.jsonl")
    before = _content(folder)
    assert np.array_equal(open_run(folder).level(10.0)["rows"], whole["rows"])
    assert cli(["report", str(folder), "--out", str(tmp_path / "report")]) == 0
    pages = [(tmp_path / "report" / page).read_text() for page in ("report.html", "report.json")]
    assert cli(["export", str(folder), "--format", "parquet", "--out", str(tmp_path / "export")]) == 0
    assert "events.jsonl" in capsys.readouterr().out
    for name in ("levels_10s-000.arrows", "levels_1s-000.arrows", "events.jsonl"):
        assert all(name in page for page in pages)
    assert _content(folder) == before


def test_no_flipped_byte_changes_a_value(sound: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(sound, tmp_path / sound.name)
    (folder / "night-000.rrd").unlink()
    whole = open_run(folder).ticks()
    path = folder / "columns" / "ticks-000.arrows"
    data = path.read_bytes()
    for place in np.random.default_rng(2).integers(0, len(data), 20):
        path.write_bytes(_flipped(data, int(place), 1))
        run = open_run(folder)
        found = run.ticks()
        kept = np.isin(whole.column("tick").to_numpy(), found.column("tick").to_numpy())
        assert found.equals(whole.filter(pa.array(kept)))
        assert any("ticks-000.arrows" in note for note in run.notes)


def test_the_batch_that_is_left_out_is_named_by_its_time_and_the_rest_is_there(sound: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(sound, tmp_path / sound.name)
    path = folder / "columns" / "ticks-000.arrows"
    path.write_bytes(_flipped(path.read_bytes(), path.stat().st_size // 2))
    run = open_run(folder)
    time_s = run.ticks(["time_s"]).column("time_s").to_numpy()
    gap = int(np.argmax(np.diff(time_s)))
    note = next(note for note in run.notes if "ticks-000" in note)
    assert f"rows between {time_s[gap]:.2f} s and {time_s[gap + 1]:.2f} s are left out" in note
    assert 59 < time_s[gap + 1] - time_s[gap] < 122


def test_of_a_damaged_journal_the_other_seconds_are_there(tmp_path: Path) -> None:
    rows, shapes = night(3, 0.01, "typical", [])
    tables(tmp_path, rows, shapes, close=False)
    path = tmp_path / "columns" / "ticks-waiting.arrows"
    path.write_bytes(_flipped(path.read_bytes(), path.stat().st_size // 2))
    run = open_run(tmp_path)
    assert 0 < run.ticks(["tick"]).num_rows < len(rows)
    assert any("ticks-waiting.arrows: damaged" in note for note in run.notes)


def test_a_table_of_an_earlier_version_is_read_as_it_is(tmp_path: Path) -> None:
    folder = written(tmp_path, 0.02)
    path = folder / "columns" / "ticks-000.arrows"
    table = pa.Table.from_batches(whole_batches(path)).replace_schema_metadata(None)
    with pa.OSFile(str(path), "wb") as file, pa.ipc.new_stream(file, table.schema) as writer:
        writer.write_table(table)
    assert not unseal(path.read_bytes()).sealed
    run = open_run(folder)
    assert run.ticks().num_rows == table.num_rows
    assert [note for note in run.notes if "without checksums" in note] == run.notes


def test_a_table_without_its_end_is_named(sound: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(sound, tmp_path / sound.name)
    path = folder / "columns" / "ticks-000.arrows"
    path.write_bytes(path.read_bytes()[:-8])  # the mark of the end: cut between two messages
    run = open_run(folder)
    run.ticks()
    assert any("ticks-000.arrows: without its end mark" in note for note in run.notes)


def test_the_last_file_of_a_table_is_missed_and_its_segment_stands_in(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    early, _ = night(5, 0.02, "typical", [])
    late = early.copy()
    late[:, FIELDS.index("mono_s")] += 1.1 * FILE_S
    tables(folder, np.concatenate((early, late)), [])
    assert len(column_files(folder, "ticks")) == 2
    segment(folder, late)
    (folder / "summary.json").write_text(dumps_checked(
        {"schema": "membrane-summary/2", "duration_s": float(late[-1, 0]), "recorder": {"tables": {"ticks": 2}}}
    ))  # fmt: skip
    (folder / "columns" / "ticks-001.arrows").unlink()
    run = open_run(folder)
    assert np.allclose(run.ticks(["time_s"]).column("time_s"), np.concatenate((early, late))[:, 0])
    assert any("ticks-001.arrows: missing" in note for note in run.notes)
    assert any("Rerun segments replace ticks" in note for note in run.notes)


@pytest.mark.parametrize(("share", "behind"), [(0.3, 0), (0.3, 15), (0.6, 1), (0.6, 16), (0.9, 400)])
def test_a_torn_segment_gives_its_whole_messages(tmp_path: Path, share: float, behind: int) -> None:
    """Rerun takes a file that ends between two messages, or within the head of one (16 bytes), as whole."""
    rows, _ = night(4, 0.02, "typical", [])
    path = segment(tmp_path, rows)
    messages = whole_messages(path)
    path.write_bytes(path.read_bytes()[: messages[int(share * len(messages))].end + behind])
    before = _content(tmp_path)
    run = open_run(tmp_path)
    found = run.ticks(["displacement_um"])
    count = found.num_rows
    assert 0.5 * share * len(rows) < count <= len(rows)
    assert np.allclose(found.column("displacement_um"), column(rows[:count], "displacement_um"), equal_nan=True)
    told = [note for note in run.notes if note.startswith("night-000.rrd: ")]
    assert len(told) == 1
    if behind:
        assert "damaged or truncated" in told[0]
        assert f"{behind / 1e3:.1f} kB of it are left out" in told[0]
    else:
        assert "has no end" in told[0]
    assert _content(tmp_path) == before


@pytest.mark.parametrize("within", [True, False])
def test_a_repaired_copy_is_read_instead(tmp_path: Path, within: bool) -> None:
    """Wherever the segment was cut off: one that ends between two messages looks like that of a killed recorder."""
    rows, _ = night(4, 0.02, "typical", [])
    path = segment(tmp_path, rows)
    (tmp_path / "repaired").mkdir()
    shutil.copy(path, tmp_path / "repaired")
    end = next(message.end for message in whole_messages(path) if message.end > 100_000)
    path.write_bytes(path.read_bytes()[: end - within])
    run = open_run(tmp_path)
    assert run.ticks(["error_um"]).num_rows == len(rows)
    assert any("read from its copy in repaired/" in note for note in run.notes)


def test_an_event_and_a_figure_that_were_changed_are_not_believed(sound: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(sound, tmp_path / sound.name)
    for name, old, new in (("events.jsonl", '"settle"', '"sottle"'), ("summary.json", '"done"', '"dune"')):
        path = folder / name
        path.write_text(path.read_text().replace(old, new))
    run = open_run(folder)
    assert run.summary is None
    assert [event["kind"] for event in run.events] == ["start", "end"]


def test_an_empty_export_is_refused(sound: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = shutil.copytree(sound, tmp_path / sound.name)
    shutil.rmtree(folder / "columns")
    (folder / "night-000.rrd").unlink()
    arguments = ["export", str(folder), "--format", "csv", "--out", str(tmp_path / "export")]
    assert cli(arguments) == 0
    assert "no telemetry" in capsys.readouterr().out
    assert cli([*arguments, "--streams", "error_um"]) == 2
    assert "nothing to export" in capsys.readouterr().err
