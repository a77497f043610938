"""The files made from the table of telemetry columns are up to date, and have every column."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from membrane_ctrl.model.columns import COLUMNS, PUBLISHED
from tests.support import telemetry_pages


def test_the_committed_files_are_fresh(capsys: pytest.CaptureFixture[str]) -> None:
    assert telemetry_pages.main(["--check"]) == 0, capsys.readouterr().err


def test_every_column_has_a_row_on_the_page() -> None:
    page = telemetry_pages.telemetry_page()
    for each in COLUMNS.values():
        assert (
            page.count(f"| `{each.name}` | {each.unit} | {each.label} | {each.description} |") == 1
        )


def test_every_published_column_is_in_the_dashboard() -> None:
    panels = json.loads(telemetry_pages.dashboard_text())["panels"]
    asked = " ".join(target["expr"] for panel in panels for target in panel["targets"])
    missing = [each.name for each in PUBLISHED if f"membrane_{each.name}" not in asked]
    assert missing == []


def test_an_old_file_is_named_and_not_touched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    old = tmp_path / "telemetry.md"
    old.write_text("old")
    monkeypatch.setattr(telemetry_pages, "TELEMETRY", old)
    assert telemetry_pages.main(["--check"]) == 1
    assert old.read_text() == "old"
    assert "telemetry.md" in capsys.readouterr().err
    assert telemetry_pages.main([]) == 0
    assert old.read_text() == telemetry_pages.telemetry_page()


def test_a_page_without_marks_is_not_written_over() -> None:
    with pytest.raises(ValueError, match=r"bridges\.md"):
        telemetry_pages.bridges_page("# Bridges\n")
