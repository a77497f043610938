"""A review of a part shows its lines, its maps, and the time cursor there."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from rerun.chunk import RrdReader

from benchmarks.nights import Planted
from membrane_ctrl.review import open_run
from membrane_ctrl.review.viewer import viewer
from membrane_ctrl.review.viewer.command import ReviewOptions, make_review
from tests.support.review_runs import written


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    doors = [Planted("pressure step", at_s, 20.0) for at_s in (150.0, 400.0, 650.0)]
    run = written(tmp_path_factory.mktemp("part"), 0.2, doors)
    with (run / "events.jsonl").open("a") as file:
        for at_s in (50.0, 390.0, 700.0):
            file.write(json.dumps({"mono_s": at_s, "kind": "command", "command": "mark", "text": "knock"}) + "\n")
    return run


def times_s(path: Path, entity: str) -> list[float]:
    batches = (chunk.to_record_batch() for chunk in RrdReader(path).stream() if chunk.entity_path == entity)
    columns = (batch.column("run_time").cast("int64") for batch in batches if "run_time" in batch.schema.names)
    return sorted(1e-9 * tick for column in columns for tick in column.to_pylist())


@pytest.mark.parametrize(
    ("asked", "from_s", "to_s", "cursor_s"),
    [({"at": "+400s"}, 280.0, 520.0, 400.0), ({"start": "+350s", "end": "+450s"}, 350.0, 450.0, 350.0)],
)
def test_logs_maps_and_cursor_are_those_of_the_part(
    folder: Path, tmp_path: Path, asked: dict[str, str], from_s: float, to_s: float, cursor_s: float
) -> None:
    file = tmp_path / "r.rrd"
    assert make_review([open_run(folder)], ReviewOptions([folder], **asked), file) == pytest.approx(cursor_s)
    assert times_s(file, "/events") == pytest.approx([390.0])
    assert times_s(file, "/found") == pytest.approx([400.0], abs=1.5)
    maps_s = times_s(file, "/shape/map")
    assert len(maps_s) > 10
    assert from_s <= maps_s[0] <= maps_s[-1] <= to_s
    assert len(times_s(file, "/found/marks")) == 3  # the plots can be zoomed out


def test_of_a_whole_run_everything_is_there_and_no_moment_was_asked_for(folder: Path, tmp_path: Path) -> None:
    file = tmp_path / "r.rrd"
    assert make_review([open_run(folder)], ReviewOptions([folder]), file) is None
    assert {50.0, 390.0, 700.0} <= {round(at_s, 3) for at_s in times_s(file, "/events")}
    assert len(times_s(file, "/found")) == 3


class Client:
    """A viewer that refuses first, then has not opened its file yet."""

    calls = 0
    at_s: float | None = None

    @classmethod
    def connect(cls, _: str) -> Client:
        cls.calls += 1
        if cls.calls == 1:
            raise ConnectionError
        return cls()

    def set_time(self, _: str, duration: float, play_state: str) -> None:
        assert play_state == "paused"
        Client.at_s = duration if Client.calls >= 3 else None

    def get_state(self) -> SimpleNamespace:
        current = None if Client.at_s is None else round(1e9 * Client.at_s)
        return SimpleNamespace(recordings=[SimpleNamespace(current_time=current)])


def test_the_cursor_is_put_again_until_it_stands_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewer, "ViewerClient", Client)
    monkeypatch.setattr(viewer, "_CURSOR_AGAIN_S", 0.0)
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        viewer.put_cursor(process, 1, 800.25)
        assert (Client.calls, Client.at_s) == (3, 800.25)
        process.communicate(b"\n")
        viewer.put_cursor(process, 1, 10.0)  # ended meanwhile: nothing to do
    assert Client.calls == 3
