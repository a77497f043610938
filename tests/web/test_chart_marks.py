"""A mark at a moment that a viewer chose goes to the run of that moment, with the viewer's name."""

from __future__ import annotations

from pathlib import Path

import pytest

from membrane_ctrl.model.run_events import Mark
from membrane_ctrl.review import open_run
from membrane_ctrl.web.chart_marks import is_now, mark_past
from tests.worlds.nights import night, write_run


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    rows, _ = night(1, 0.02, "quiet", [])
    write_run(tmp_path / "20261121T180000Z-night", iter([(rows, [])]))
    return tmp_path


def test_a_past_moment_is_marked_in_its_run(logs: Path) -> None:
    began_s = open_run(logs / "20261121T180000Z-night").origin_utc.timestamp()
    assert mark_past(logs, began_s + 30.0, " door ", "web: anna").done
    marks = [
        each
        for each in open_run(logs / "20261121T180000Z-night").log
        if isinstance(each.event, Mark)
    ]
    (mark,) = marks
    assert (mark.event.text, mark.event.who) == ("door", "web: anna")
    assert mark.mono_s == pytest.approx(30.0)


def test_a_moment_without_a_run_is_refused(logs: Path) -> None:
    outcome = mark_past(logs, 0.0, "door", "web: anna")
    assert (outcome.done, outcome.text) == (False, "mark: no run was recorded at that time")
    assert mark_past(logs, 0.0, " ", "web: anna").text == "mark: enter a text"


def test_the_present_is_marked_by_the_hold(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("time.time", lambda: 100.0)
    assert is_now(99.0)
    assert not is_now(90.0)
