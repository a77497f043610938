"""Runs with damaged files: gaps are named, the rest is shown, and nothing of the run is touched."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from membrane_ctrl.cli import run as cli
from membrane_ctrl.model.file_checksums import add_checksum_comment, dumps_checked
from membrane_ctrl.review import open_run
from tests.support.review_runs import segment, set_summary, written
from tests.worlds.nights import night

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
    ("ticks/ticks-0000.parquet", "garbage"),
    ("ticks/ticks-0000.parquet", "folder"),
    ("ticks/ticks-0000.parquet", "missing"),
    ("ticks_1s/ticks_1s-0000.parquet", "flipped"),
    ("ticks_60s/ticks_60s-0000.parquet", "loop"),
    ("shapes/shapes-0000.parquet", "half"),
    ("config.toml", "empty"),
    ("config.toml", "loop"),
    ("config.toml", "flipped"),
    ("events.jsonl", "folder"),
    ("events.jsonl", "empty"),
    ("events.jsonl", "flipped"),
    ("summary.json", "garbage"),
    ("ticks/manifest.jsonl", "flipped"),
)


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run, six minutes at 10 Hz, with everything that the recorder writes."""
    folder = written(tmp_path_factory.mktemp("sound"), HOURS)
    segment(folder, night(1, HOURS, "typical", [])[0][:600])
    names = ("ticks", "shapes", "ticks_1s", "ticks_10s", "ticks_60s")
    set_summary(folder, recorder={"segments": 1, "tables": dict.fromkeys(names, 1)})
    for path in (folder / "summary.json", folder / "events.jsonl"):
        checked = [dumps_checked(table) for table in _objects(path)]
        path.write_text("\n".join(checked) + "\n")
    config = folder / "config.toml"
    config.write_text(add_checksum_comment(config.read_text()))
    return folder


def _objects(path: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def _content(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_a_sound_run_has_no_notes(sound: Path) -> None:
    run = open_run(sound)
    run.read_all_parts()
    assert run.notes == []


@pytest.mark.parametrize(("file", "harm"), CASES)
def test_any_file_may_be_damaged(
    sound: Path, tmp_path: Path, file: str, harm: str, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = shutil.copytree(sound, tmp_path / sound.name)
    HARM[harm](folder / file)
    before = _content(folder)
    assert cli(["runs", "show", str(folder)]) == 0
    output = capsys.readouterr().out
    assert Path(file).name in output
    run = open_run(folder)
    assert run.ticks(["error_um"]).num_rows == 3600 * (not file.startswith("ticks/ticks"))
    assert run.level(60.0)["time_s"].size > 0
    assert cli(["runs", "--logs", str(tmp_path)]) == 0
    assert _content(folder) == before


def test_report_and_export_show_the_rest(
    sound: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = shutil.copytree(sound, tmp_path / sound.name)
    whole = open_run(folder).level(10.0)
    (folder / "ticks_10s" / "ticks_10s-0000.parquet").unlink()
    HARM["half"](folder / "ticks_1s" / "ticks_1s-0000.parquet")
    HARM["half"](folder / "events.jsonl")
    before = _content(folder)
    assert np.array_equal(open_run(folder).level(10.0)["rows"], whole["rows"])
    assert cli(["report", str(folder), "--out", str(tmp_path / "report")]) == 0
    pages = [(tmp_path / "report" / page).read_text() for page in ("report.html", "report.json")]
    assert (
        cli(["export", str(folder), "--format", "parquet", "--out", str(tmp_path / "export")]) == 0
    )
    assert "events.jsonl" in capsys.readouterr().out
    for name in ("ticks_10s-0000.parquet", "ticks_1s-0000.parquet", "events.jsonl"):
        assert all(name in page for page in pages)
    assert _content(folder) == before


def test_no_flipped_byte_changes_a_value(sound: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(sound, tmp_path / sound.name)
    (folder / "night-000.rrd").unlink()
    whole = open_run(folder).ticks()
    path = folder / "ticks" / "ticks-0000.parquet"
    data = path.read_bytes()
    for place in np.random.default_rng(2).integers(0, len(data), 20):
        path.write_bytes(_flipped(data, int(place), 1))
        run = open_run(folder)
        found = run.ticks()
        kept = np.isin(whole.column("tick").to_numpy(), found.column("tick").to_numpy())
        assert not found.num_rows or found.equals(whole.filter(pa.array(kept)))
        assert found.num_rows == whole.num_rows or any(
            "ticks-0000.parquet" in note for note in run.notes
        )


def test_an_event_and_a_figure_that_were_changed_are_not_used(sound: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(sound, tmp_path / sound.name)
    for name, old, new in (
        ("events.jsonl", '"settle"', '"sottle"'),
        ("summary.json", '"done"', '"dune"'),
    ):
        path = folder / name
        path.write_text(path.read_text().replace(old, new))
    run = open_run(folder)
    assert run.summary is None
    assert [event["kind"] for event in run.events] == ["start", "end"]


def test_an_empty_export_is_refused(
    sound: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = shutil.copytree(sound, tmp_path / sound.name)
    for path in folder.glob("*/manifest.jsonl"):
        shutil.rmtree(path.parent)
    arguments = ["export", str(folder), "--format", "csv", "--out", str(tmp_path / "export")]
    assert cli(arguments) == 0
    assert "no telemetry" in capsys.readouterr().out
    assert cli([*arguments, "--streams", "error_um"]) == 2
    assert "nothing to export" in capsys.readouterr().err
