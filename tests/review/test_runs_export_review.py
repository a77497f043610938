"""Catalogue, export, marks, moments, and the viewer's input."""

from __future__ import annotations

import html
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from datetime import UTC, datetime
from pathlib import Path

import h5py
import numpy as np
import pyarrow.csv
import pyarrow.parquet
import pytest
from rerun.chunk import RrdReader

from membrane_ctrl.cli import run as command
from membrane_ctrl.config.schema import LoopConfig
from membrane_ctrl.model.errors import DeviceError, InputError
from membrane_ctrl.model.telemetry import get_column
from membrane_ctrl.model.zernike_terms import NOLL_INDICES
from membrane_ctrl.report_pages.blocks import PageSection, ReportPage
from membrane_ctrl.report_pages.render import render_page
from membrane_ctrl.review import open_run
from membrane_ctrl.review.catalogue import Filter, list_entries, resolve_run
from membrane_ctrl.review.export import export_run
from membrane_ctrl.review.formatting import format_number, format_span, one_line
from membrane_ctrl.review.prune import to_prune
from membrane_ctrl.review.report.pump_history import PumpSeen, explain_pump_change, pump_history
from membrane_ctrl.review.report.run_page import _list_history
from membrane_ctrl.review.run_times import moment_s
from membrane_ctrl.review.viewer.command import ReviewOptions, make_review
from tests.support.review_runs import same, set_summary, written
from tests.worlds.nights import Planted, night

Capsys = pytest.CaptureFixture[str]
ORIGIN = datetime(2026, 11, 21, 18, 0, 30, tzinfo=UTC)


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("logs")
    for day, std in ((21, 0.1), (22, 0.3), (23, 0.2)):
        run = written(folder, 0.02, seed=day, name=f"202611{day}T180000Z-night")
        set_summary(run, held={"std_um": std, "in_band": 1.0})
    (folder / "notes").mkdir()
    return folder


def render_history(seen: list[PumpSeen], change_max: float) -> str:
    """The report's section about the pump, as text with the entities of HTML resolved."""
    section = PageSection("Pump", _list_history(seen, change_max))
    return html.unescape(render_page(ReportPage("run", [section])))


def week(
    logs: Path, number: int, scale: float, sigma: float = 0.03, devices: str = "", curve: str = ""
) -> Path:
    """A run that has learned its pump, from its small files only; `curve` is set before."""
    run = logs / f"2026100{number}T120000Z-week"
    run.mkdir(parents=True)
    (run / "config.toml").write_text(
        "[pump]\ncurve_fraction = [0, 1]\ncurve_um_per_s = [0, 6]\n" + devices
    )
    logged: list[dict[str, object]] = [
        {"kind": "pump", "scale": 9.0, "sigma": 0.1, "correction": 1.0}
    ]
    if curve:
        gains = LoopConfig().model_dump() | {"pump": json.loads(curve)}
        logged.append(
            {"kind": "command", "command": "gains", "who": "eve", "why": "", "loop": gains}
        )
    logged.append({"kind": "pump", "scale": scale, "sigma": sigma, "correction": 1.0})
    lines = [
        {"time_utc": f"2026-10-0{number}T12:00:00+00:00", "mono_s": 0.0, **event}
        for event in logged
    ]
    (run / "events.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    (run / "summary.json").write_text(
        json.dumps({"schema": "membrane-summary/2", "leak_um_per_s": 1.0 + 0.1 * number})
    )
    return run


# twice the flow at every command: what was 1.0 on the first curve is 0.5 on this one
TWICE = '{"curve_fraction": [0.0, 1.0], "curve_um_per_s": [0.0, 12.0]}'


def test_a_pump_that_wears_over_the_weeks_is_reported(tmp_path: Path) -> None:
    twin = "[twin]\nleak_um_per_s = 2.0\n"  # not the bench: its devices are the same
    week(tmp_path, 1, 1.0)
    week(tmp_path, 2, 0.97, devices=twin)
    third = week(tmp_path, 3, 0.80)
    week(tmp_path, 4, 0.5)
    seen = pump_history(third)
    assert [round(each.scale, 3) for each in seen] == [
        1.0,
        0.97,
        0.8,
    ]  # the later run is not known yet
    assert [round(each.leak_um_per_s, 3) for each in seen] == [1.1, 1.2, 1.3]
    assert [each.started_utc.day for each in seen] == [1, 2, 3]
    advice = (
        "the pump gives 20 % less than in 20261001T120000Z-week (+- 4 %): check it, then `tune "
        "pump`"
    )
    assert explain_pump_change(seen, 0.12) == advice
    assert explain_pump_change(seen, 0.25) == ""
    page = render_history(seen, 0.12)
    assert advice in page
    assert "0.800 ± 0.030" in page
    assert "<svg" in page
    assert advice not in render_history(seen, 0.25)
    assert explain_pump_change([], 0.12) == ""


def test_a_change_within_its_error_or_of_another_curve_is_none(tmp_path: Path) -> None:
    week(tmp_path, 1, 1.0, sigma=0.1)
    vague = pump_history(week(tmp_path, 2, 0.8, sigma=0.1))
    assert explain_pump_change(vague, 0.12) == ""
    new_curve = pump_history(week(tmp_path, 3, 0.98, curve=TWICE))
    assert [round(each.scale, 3) for each in new_curve] == [0.5, 0.4, 0.98]
    assert [each.same_curve for each in new_curve] == [False, False, True]
    assert explain_pump_change(new_curve, 0.12) == ""


def test_the_catalogue_lists_and_filters(logs: Path) -> None:
    assert [entry.std_um for entry in list_entries(logs)] == [0.1, 0.3, 0.2]
    since = datetime(2026, 11, 22, tzinfo=UTC)
    # what is written in a run's events counts as its start, not its name
    assert len(list_entries(logs, Filter(since_utc=since))) == 0
    assert [e.name[:8] for e in list_entries(logs, Filter(most_std_um=0.2))] == [
        "20261121",
        "20261123",
    ]
    assert list_entries(logs, Filter(with_faults=True)) == []
    assert (
        len(list_entries(logs, Filter(configuration=list_entries(logs)[0].configuration[:4]))) == 3
    )
    assert [e.name[:8] for e in list_entries(logs, Filter(text="1122"))] == ["20261122"]


def test_a_run_without_an_end_is_as_long_as_what_it_has(tmp_path: Path) -> None:
    folder = written(tmp_path, 0.1)
    (folder / "summary.json").unlink()
    assert [entry.exit for entry in list_entries(tmp_path, Filter(least_s=359.0))] == ["open"]
    assert list_entries(tmp_path, Filter(least_s=370.0)) == []
    shutil.rmtree(folder / "ticks_1s")
    assert np.isnan(list_entries(tmp_path)[0].duration_s)


def test_a_run_is_found_by_part_of_its_name(logs: Path) -> None:
    assert resolve_run(Path("1122"), logs).name == "20261122T180000Z-night"
    assert resolve_run(Path("last"), logs).name == "20261123T180000Z-night"
    with pytest.raises(InputError, match="several runs match"):
        resolve_run(Path("night"), logs)
    second = logs / "20261122T180000Z-night-2"  # a second run in the same second
    leftover = logs / ".deleted-20261123T180000Z-night"
    for copy in (second, leftover):
        shutil.copytree(logs / "20261122T180000Z-night", copy)
    assert resolve_run(Path("20261122T180000Z-night"), logs).name == "20261122T180000Z-night"
    assert [entry.name[:8] for entry in list_entries(logs)] == [
        "20261121",
        "20261122",
        "20261122",
        "20261123",
    ]
    for copy in (second, leftover):
        shutil.rmtree(copy)


def test_runs_commands(logs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert command(["runs", "--logs", str(logs), "--std-um", "0.15", "--json"]) == 0
    assert [run["name"][:8] for run in json.loads(capsys.readouterr().out)] == ["20261121"]
    assert command(["runs", "show", str(logs / "20261122T180000Z-night")]) == 0
    assert "state  hold" in capsys.readouterr().out
    assert command(["runs", "--logs", str(logs / "absent")]) == 2
    assert command(["runs", "prune", "--logs", str(logs)]) == 2
    assert command(["runs", "prune", "--logs", str(logs), "--keep-days", "1e12"]) == 2
    capsys.readouterr()


def test_runs_takes_its_folder_on_either_side_of_a_subcommand(
    logs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for words in (
        ["runs", "--logs", str(logs), "show", "122T18", "--json"],
        ["runs", "show", "122T18", "--logs", str(logs), "--json"],
        ["runs", "--logs", "absent", "show", "122T18", "--logs", str(logs), "--json"],
    ):
        assert command(words) == 0
        assert json.loads(capsys.readouterr().out)["name"] == "20261122T180000Z-night"
    for words in (
        ["runs", "--logs", str(logs), "prune", "--keep-gb", "0", "--json"],
        ["runs", "prune", "--logs", str(logs), "--keep-gb", "0", "--json"],
    ):
        assert command(words) == 0
        gone = json.loads(capsys.readouterr().out)
        assert len(gone["runs"]) == 3
        assert not gone["deleted"]


def test_filters_of_the_list_are_refused_with_a_subcommand(
    logs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command(["runs", "--std-um", "1", "prune", "--keep-gb", "0"]) == 2
    assert "--std-um: filters the list of runs; leave it out" in capsys.readouterr().err
    twice = ["runs", "--logs", str(logs), "--logs", "other", "show", "122T18"]
    assert command(twice) == 2
    assert "--logs: one folder for `show`" in capsys.readouterr().err


def test_runs_of_several_folders_are_one_list(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    south = tmp_path / "south"
    south.mkdir()
    shutil.copytree(logs / "20261122T180000Z-night", south / "20261122T190000Z-later")
    words = ["runs", "--logs", str(south), "--logs", str(logs), "--logs", f"{logs}/."]
    assert command([*words, "--json"]) == 0
    found = [Path(run["folder"]) for run in json.loads(capsys.readouterr().out)]
    assert len(found) == len(set(found)) == 4, "a folder that is named twice counts once"
    assert [folder.name[:8] for folder in found] == ["20261121", "20261122", "20261122", "20261123"]
    assert {folder.parent.name for folder in found} == {"south", logs.name}
    assert command(words) == 0
    assert "south/20261122T190000Z-later " in capsys.readouterr().out, "each run with its folder"
    assert command([*words, "--logs", str(tmp_path / "absent")]) == 2


def test_prune_spares_kept_runs_and_lists_before_it_deletes(tmp_path: Path) -> None:
    for day in range(1, 7):
        written(tmp_path, 0.01, name=f"202611{day:02}T180000Z-night")
    (tmp_path / "20261101T180000Z-night" / ".keep").touch()
    (tmp_path / "20261102T180000Z-night" / "summary.json").unlink()
    gone = to_prune(tmp_path, datetime(2026, 12, 21, tzinfo=UTC), keep_days=30.0, keep_gb=None)
    assert [run.folder.name[:8] for run, _ in gone] == ["20261102", "20261103"]
    # by today's clock the one without a summary may still run
    assert command(["runs", "prune", "--logs", str(tmp_path), "--keep-gb", "0"]) == 0
    assert len(list_entries(tmp_path)) == 6
    assert command(["runs", "prune", "--logs", str(tmp_path), "--keep-gb", "0", "--delete"]) == 0
    assert [run.name[:8] for run in list_entries(tmp_path)] == ["20261101", "20261102"]


@pytest.mark.parametrize("to", ["parquet", "csv", "hdf5"])
def test_exports_hold_the_ticks(tmp_path: Path, to: str) -> None:
    rows, shapes = night(1, 0.03, "typical", [])
    files = export_run(open_run(written(tmp_path, 0.03)), to, tmp_path / "out")
    assert all(path.exists() for path in files)
    if to == "hdf5":
        with h5py.File(tmp_path / "out" / "run.h5") as file:
            error, coeffs = file["ticks/error_um"][:], file["shapes/coeffs_um"][:]
    else:
        read = pyarrow.parquet.read_table if to == "parquet" else pyarrow.csv.read_csv
        error = read(tmp_path / "out" / f"ticks.{to}").column("error_um").to_numpy()
        table = read(tmp_path / "out" / f"shapes.{to}")
        coeffs = np.column_stack([table.column(f"z{j}_um").to_numpy() for j in NOLL_INDICES])
    assert same(error, get_column(rows, "error_um"), 1e-4)
    np.testing.assert_allclose(coeffs, [shape.coeffs_um for shape in shapes])


def test_export_of_some_streams_and_a_part(tmp_path: Path) -> None:
    run = open_run(written(tmp_path, 0.03))
    files = export_run(run, "parquet", tmp_path / "o", ["/loop/error", "pump_fraction"], 10.0, 20.0)
    table = pyarrow.parquet.read_table(files[0])
    assert ([path.name for path in files], table.num_rows) == (["ticks.parquet"], 100)
    assert table.column_names == ["time_s", "time_utc", "error_um", "pump_fraction"]
    with pytest.raises(InputError, match="/loop/eror"):
        export_run(run, "csv", tmp_path / "o", ["/loop/eror"])
    with pytest.raises(InputError, match="xls"):
        export_run(run, "xls", tmp_path / "o")
    (tmp_path / "file").touch()
    with pytest.raises(DeviceError, match="cannot be written"):
        export_run(run, "csv", tmp_path / "file")


def test_the_end_of_an_exported_part_is_given_as_everywhere(tmp_path: Path) -> None:
    folder, out = written(tmp_path, 0.03), tmp_path / "o"
    part = ["--from", "+10s", "--to", "+20s", "--streams", "/loop/error"]
    assert command(["export", str(folder), "--out", str(out), *part]) == 0
    assert pyarrow.parquet.read_table(out / "ticks.parquet").num_rows == 100


@pytest.mark.usefixtures("undrawn")
def test_a_mark_made_later_is_an_event_and_touches_nothing_else(tmp_path: Path) -> None:
    folder = written(tmp_path, 0.05)
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    assert command(["review", "mark", str(folder), "a door", "--at", "+60s"]) == 0
    assert command(["report", str(folder), "--out", str(tmp_path / "out")]) == 0
    marks = [event for event in open_run(folder).events if event["kind"] == "mark"]
    assert [(mark["mono_s"], mark["text"]) for mark in marks] == [(60.0, "a door")]
    assert {path: path.read_bytes() for path in before} == before
    assert command(["review", "mark", str(folder)]) == 2


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("18:01", 30.0),
        ("18:00:45", 15.0),
        ("03:12", 33_090.0),
        ("+1h5m", 3900.0),
        ("+0s", 0.0),
        ("90", 90.0),
        ("2h30m", 9000.0),
        ("0s", 0.0),
        ("2026-11-21T18:01:30", 60.0),
        ("2026-11-21T19:01:30+01:00", 60.0),
    ],
)
def test_moments(text: str, seconds: float) -> None:
    assert moment_s(text, ORIGIN) == seconds


@pytest.mark.parametrize("text", ["3 o'clock", "25:00", "+", "12:61", "12:01:75"])
def test_moments_that_are_none(text: str) -> None:
    with pytest.raises(InputError):
        moment_s(text, ORIGIN)


def test_words() -> None:
    assert one_line("a door\n\x1b[31mµ") == "a door  [31mµ"
    assert [format_span(s) for s in (41, 65, 3600, 28_740, 2_606_400)] == [
        "41 s",
        "1 min 5 s",
        "1 h",
        "7 h 59 min",
        "30 d 4 h",
    ]
    assert (format_span(float("nan")), format_number(float("nan")), format_number(0.12345)) == (
        "?",
        "–",
        "0.123",
    )


def entities(path: Path) -> dict[str, int]:
    """Rows of each entity of a recording."""
    rows: dict[str, int] = {}
    for chunk in RrdReader(path).stream():
        rows[chunk.entity_path] = rows.get(chunk.entity_path, 0) + chunk.to_record_batch().num_rows
    return rows


def colours(path: Path, entity: str) -> list[int]:
    """Of the lines of a plot."""
    batches = (
        chunk.to_record_batch() for chunk in RrdReader(path).stream() if chunk.entity_path == entity
    )
    columns = (
        batch.column("SeriesLines:colors")
        for batch in batches
        if "SeriesLines:colors" in batch.schema.names
    )
    return next(column.to_pylist()[0] for column in columns)


def test_the_viewer_is_given_levels_ticks_figure_and_what_was_found(tmp_path: Path) -> None:
    run = open_run(written(tmp_path, 0.2, [Planted("pressure step", 400.0, 20.0)]))
    make_review([run], ReviewOptions([run.folder]), tmp_path / "r.rrd")
    rows = entities(tmp_path / "r.rrd")
    assert rows["/loop/error"] >= 7200
    assert rows["/overview/loop/error"] >= 720
    assert rows["/shape/map/difference"] >= 20
    assert rows["/found"] >= 1


def test_a_window_limits_the_ticks_and_runs_lie_over_each_other(tmp_path: Path) -> None:
    runs = [open_run(written(tmp_path, 0.1, seed=s, name=f"2026112{s}T180000Z-n")) for s in (1, 2)]
    options = ReviewOptions([run.folder for run in runs], start="+100s", end="+110s")
    make_review(runs, options, tmp_path / "r.rrd")
    rows = entities(tmp_path / "r.rrd")
    assert 100 <= rows["/20261121T180000Z-n/loop/error"] <= 102
    assert 100 <= rows["/20261122T180000Z-n/loop/error"] <= 102
    of_runs = (f"/2026112{number}T180000Z-n/loop/error" for number in (1, 2))
    assert len({tuple(colours(tmp_path / "r.rrd", path)) for path in of_runs}) == 2


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ("--at +9h", "not in the run"),
        ("--at 25:00", "write 03:12"),
        ("--around explosion", "no such event"),
        ("--around= ", "name an event"),
        ("--tab x", "--tab"),
        ("--align x", "--align"),
        ("--from +20s --to +10s", "not before"),
        ("--from +3h --to +4h", "not in the run"),
        ("--to 2020-01-01", "not in the run"),
        ("--at +10s --around hold", "only one"),
        ("--port 9", "only with --web"),
        ("--live", "--live follows"),
    ],
)
def test_what_is_missing_is_named(
    logs: Path, tmp_path: Path, capsys: Capsys, asked: str, message: str
) -> None:
    folder, target = logs / "20261121T180000Z-night", tmp_path / "r.rrd"
    assert (
        command(["review", str(folder), *asked.split(" ", maxsplit=3), "--save", str(target)]) == 2
    )
    assert message in capsys.readouterr().err
    assert not target.exists()


def test_a_place_that_cannot_be_written_is_reported_before_the_work(
    logs: Path, tmp_path: Path, capsys: Capsys
) -> None:
    folder = logs / "20261121T180000Z-night"
    assert command(["review", str(folder), "--screenshot", str(tmp_path / "absent" / "p.png")]) == 4
    assert "cannot be written" in capsys.readouterr().err
    assert command(["review", str(folder), "--save", str(folder / "night-000.rrd")]) == 2
    assert "in a folder of the recorder" in capsys.readouterr().err
    with socket.create_server(("127.0.0.1", 0)) as taken:
        assert command(["review", str(folder), "--web", "--port", str(taken.getsockname()[1])]) == 4
    assert "choose another --port" in capsys.readouterr().err


def test_nothing_to_show_is_explained_and_beside_another_run_only_noted(
    logs: Path, tmp_path: Path, capsys: Capsys
) -> None:
    broken, whole, target = tmp_path / "broken", logs / "20261121T180000Z-night", tmp_path / "r.rrd"
    broken.mkdir()
    (broken / "events.jsonl").write_text('{"kind": "start", "mono_s": 0.0}\n{"kin')
    assert command(["review", str(broken), "--save", str(target)]) == 2
    output = capsys.readouterr().err
    assert "1 line unreadable" in output
    assert output.splitlines()[-1].endswith("no readable telemetry")
    assert command(["review", str(broken), str(whole), "--save", str(target)]) == 0
    assert "broken: not shown" in capsys.readouterr().err
    assert entities(target)["/overview/loop/error"] > 0


def listens(port: int) -> bool:
    """Whether somebody listens on a port of this machine."""
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


@pytest.mark.usefixtures("signals_are_heeded")
@pytest.mark.parametrize(
    "number", [signal.SIGTERM, pytest.param(signal.SIGHUP, marks=pytest.mark.campaign)]
)
def test_a_review_that_is_ended_leaves_nothing_behind(
    logs: Path, tmp_path: Path, number: signal.Signals
) -> None:
    command_line = [
        sys.executable,
        "-m",
        "membrane_ctrl",
        "review",
        str(logs / "20261121T180000Z-night"),
        "--web",
    ]
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    with subprocess.Popen(
        command_line, env=environment, stderr=subprocess.PIPE, text=True
    ) as review:
        assert review.stderr is not None
        page = next(line for line in review.stderr if line.startswith("open http"))
        port = int(page.split("/")[2].split(":")[1])
        while not listens(port):
            time.sleep(0.02)
        assert list(tmp_path.glob("membrane-review-*/review.rrd"))
        review.send_signal(number)
        assert review.wait(30) == 0
    assert not list(tmp_path.iterdir())
    assert not listens(port)


def test_around_finds_events_and_what_was_found(tmp_path: Path) -> None:
    folder = written(tmp_path, 0.2, [Planted("pressure step", 400.0, 20.0)])
    with (folder / "events.jsonl").open("a") as file:
        for at_s, what in ((500.0, "hold"), (300.0, "pause")):
            file.write(json.dumps({"mono_s": at_s, "kind": "command", "command": what}) + "\n")
    run = open_run(folder)
    for what, at_s in (("pressure", 400.0), ("hold", 0.0), ("end", 720.0), ("pause", 300.0)):
        options = ReviewOptions([folder], around=what)
        cursor = make_review([run], options, tmp_path / "r.rrd")
        assert cursor is not None
        assert cursor.nanos / 1e9 == pytest.approx(run.origin_utc.timestamp() + at_s, abs=2.0)
