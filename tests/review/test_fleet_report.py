"""`report --fleet`: the figures of each run's own report on one page, also on several processes or
a cluster.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from membrane_ctrl.cli import run as command
from membrane_ctrl.model.errors import Exit
from membrane_ctrl.review.report import command as report_command
from membrane_ctrl.review.report import fleet
from tests.support.dask_cluster import PATIENT, cluster
from tests.support.review_runs import written

NAMES = ("20261121T180000Z-one", "20261122T180000Z-two")
HOSTILE = "<script>alert(1)<"


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two mirrors with a run each; a folder that only looks like a run, and one that is none."""
    folder = tmp_path_factory.mktemp("lab")
    for seed, (mirror, name) in enumerate(zip(("north", "south"), NAMES, strict=True), 1):
        written(folder / mirror, 0.02, seed=seed, name=name)
    event = {
        "kind": "alarm",
        "mono_s": 5.0,
        "time_utc": "2026-11-21T18:00:05+00:00",
        "alarm": "leaky",
    }
    event |= {
        "what": "raised",
        "severity": "warning",
        "text": "t",
        "to": "lab",
        "sent": True,
        "escalated": False,
    }
    fault = {
        "kind": "fault",
        "mono_s": 6.0,
        "time_utc": "2026-11-21T18:00:06+00:00",
        "code": 40,
        "name": "late",
    }
    with (folder / "north" / NAMES[0] / "events.jsonl").open("a") as log:
        log.writelines(json.dumps(each) + "\n" for each in (event, fault))
    (folder / "south" / HOSTILE).mkdir()
    (folder / "south" / HOSTILE / "events.jsonl").write_text('{"kind": \n')
    (folder / "empty").mkdir()
    return folder


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pages without pictures, which take seconds."""
    for module in (fleet, report_command):
        monkeypatch.setattr(
            module, "render_report", lambda analysis, *_, **__: f"page of {analysis.run.name}"
        )


def table_of(out: Path) -> dict[str, dict[str, Any]]:
    return {line["name"]: line for line in json.loads((out / "fleet.json").read_text())["runs"]}


class Cells(HTMLParser):
    """Texts of the table's rows; what else the page contains."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.rows: list[list[str]] = []
        self.links: list[str] = []
        self.tags: set[str] = set()
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        if tag == "tr":
            self.rows.append([])
        elif tag in ("td", "th"):
            self.rows[-1].append("")
        elif tag == "a":
            self.links.append(dict(attrs)["href"] or "")

    def handle_data(self, data: str) -> None:
        if self.rows and self.rows[-1]:
            self.rows[-1][-1] += data


@pytest.mark.usefixtures("undrawn")
def test_the_page_has_the_figures_of_each_runs_own_report(lab: Path, tmp_path: Path) -> None:
    given = [
        str(lab / each) for each in ("north", "south", "empty", "missing", f"north/{NAMES[0]}")
    ]
    assert (
        command(["report", "--fleet", *given, "--out", str(tmp_path / "out"), "--workers", "1"])
        == Exit.DONE
    )
    found = table_of(tmp_path / "out")
    assert list(found) == [
        f"north/{NAMES[0]}",
        f"south/{NAMES[1]}",
        f"south/{HOSTILE}",
        "empty",
        "missing",
    ]
    for name in list(found)[:2]:
        own = tmp_path / "own" / name
        assert command(["report", str(lab / name), "--out", str(own)]) == Exit.DONE
        beside = tmp_path / "out" / found[name]["report"]
        assert beside.read_text() == (own / "report.html").read_text()
        assert beside.with_name("report.json").read_bytes() == (own / "report.json").read_bytes()
        table = json.loads((own / "report.json").read_text())
        seconds = table["true"]["windows"][0]
        for key in ("std_um", "mean_um", "in_band"):
            assert found[name][key] == seconds[key]
        for key in ("verdict", "sentence", "settled_s", "ticks_missed"):
            assert found[name][key] == table[key]
    assert [line.get("faults") for line in found.values()] == [["late"], [], None, None, None]
    assert [line.get("alarms") for line in found.values()] == [["leaky"], [], None, None, None]
    problems = [line.get("problem", "") for line in found.values()]
    assert [
        "nothing to report" in problems[2],
        "not a run" in problems[3],
        "no such run" in problems[4],
    ] == [
        True,
        True,
        True,
    ]
    page = Cells((tmp_path / "out" / "fleet.html").read_text())
    assert [len(row) for row in page.rows] == [13] * 6
    assert page.rows[1][9] == "leaky"
    assert page.rows[3][:4] == [f"south/{HOSTILE}", "", "", "not reported"]
    assert "script" not in page.tags
    assert [(tmp_path / "out" / link).exists() for link in page.links] == [True, True]
    assert "path" in page.tags, "the error as a small line"


@pytest.mark.usefixtures("undrawn")
def test_what_no_run_can_break(lab: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise KeyError("frames")

    monkeypatch.setattr(fleet, "report_table", broken)
    line = fleet.run_report(None, None, lab / "north" / NAMES[0]).entry
    assert line == {"problem": "cannot be reported: KeyError: 'frames'"}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--fleet", "empty", "missing", "--workers", "1"], "not a run"),
        (["north", "south"], "--fleet makes one page of several"),
        (["north", "--workers", "2"], "are for --fleet"),
        (["--fleet", "north", "--compare", "south"], "leave out --fleet"),
    ],
)
def test_impossible_options_are_refused(
    lab: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(lab)
    assert command(["report", *words]) == Exit.BAD_INPUT
    assert message in capsys.readouterr().err
    assert not (lab / "fleet").exists()


def files_of(out: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(out)): path.read_bytes()
        for path in sorted(out.rglob("*"))
        if path.is_file()
    }


def reported(lab: Path, out: Path, *more: str) -> dict[str, bytes]:
    words = ["report", "--fleet", str(lab / "north"), str(lab / "south"), "--out", str(out), *more]
    subprocess.run(
        [sys.executable, "-m", "membrane_ctrl", *words], check=True, env=os.environ | PATIENT
    )
    return files_of(out)


@pytest.mark.campaign
def test_processes_and_a_cluster_write_the_same_bytes(lab: Path, tmp_path: Path) -> None:
    here = reported(lab, tmp_path / "here", "--workers", "1")
    assert len(here) == 6
    assert reported(lab, tmp_path / "two", "--workers", "2") == here
    with cluster(tmp_path) as address:
        there = reported(lab, tmp_path / "there", "--scheduler", address)
    assert there == here


def test_a_fleet_of_nothing_is_a_line_for_each(
    lab: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        command(["report", "--fleet", str(lab / "empty"), str(lab / "missing")]) == Exit.BAD_INPUT
    )
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(":")[1].strip().rsplit("/")[-1] for line in lines] == ["empty", "missing"]
