"""The pages made from the safety table are up to date."""

from __future__ import annotations

import pytest

from membrane_ctrl.controller.safety import TABLE
from tests.support import faults_page


def test_the_committed_pages_are_fresh(capsys: pytest.CaptureFixture[str]) -> None:
    assert faults_page.main(["--check"]) == 0, capsys.readouterr().err


def test_every_rule_is_on_both_pages() -> None:
    for rule in TABLE:
        assert f"| {rule.code} | `{rule.name}` | {rule.cause} |" in faults_page.faults_page()
        assert (
            f"| {rule.code} `{rule.name}` | {rule.cause} | {rule.remedy} |" in faults_page.alarms()
        )


def test_an_outdated_page_is_reported_and_not_changed(
    tmp_path: object, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from pathlib import Path

    old = Path(str(tmp_path)) / "faults.md"
    old.write_text("old")
    monkeypatch.setattr(faults_page, "FAULTS", old)
    assert faults_page.main(["--check"]) == 1
    assert old.read_text() == "old"
    assert "faults.md" in capsys.readouterr().err
    assert faults_page.main([]) == 0
    assert old.read_text() == faults_page.faults_page()


def test_a_runbook_without_markers_is_not_overwritten() -> None:
    with pytest.raises(ValueError, match="substring"):
        faults_page.operations_page("# Operations\n")
