"""The page made from the classes of events is up to date."""

from __future__ import annotations

from pathlib import Path

import pytest

from membrane_ctrl.model.event_lines import KINDS
from tests.support import events_page


def test_the_committed_page_is_fresh(capsys: pytest.CaptureFixture[str]) -> None:
    assert events_page.main(["--check"]) == 0, capsys.readouterr().err


def test_every_kind_of_a_run_is_on_the_page_with_its_keys() -> None:
    page = events_page.events_page()
    for kind, cls in KINDS.items():
        (row,) = [line for line in page.splitlines() if line.startswith(f"| `{kind}` |")] or [""]
        assert bool(row) == (kind != "alive")
        for _, key in cls.keys if row else ():
            assert f"`{key}` " in row


def test_an_outdated_page_is_reported_and_not_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    old = tmp_path / "events.md"
    old.write_text("old")
    monkeypatch.setattr(events_page, "PAGE", old)
    assert events_page.main(["--check"]) == 1
    assert old.read_text() == "old"
    assert "events.md" in capsys.readouterr().err
    assert events_page.main([]) == 0
    assert old.read_text() == events_page.events_page()
