"""A review of a part shows its lines, its maps, and the time cursor there."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rerun.chunk import RrdReader

from membrane_ctrl.review import open_run
from membrane_ctrl.review.viewer import viewer
from membrane_ctrl.review.viewer.command import ReviewOptions, make_review
from tests.support.review_runs import written
from tests.worlds.nights import Planted


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    doors = [Planted("pressure step", at_s, 20.0) for at_s in (150.0, 400.0, 650.0)]
    run = written(tmp_path_factory.mktemp("part"), 0.2, doors)
    with (run / "events.jsonl").open("a") as file:
        for at_s in (50.0, 390.0, 700.0):
            file.write(
                json.dumps({"mono_s": at_s, "kind": "command", "command": "mark", "text": "knock"})
                + "\n"
            )
    return run


def times_s(path: Path, entity: str) -> list[float]:
    batches = (
        chunk.to_record_batch() for chunk in RrdReader(path).stream() if chunk.entity_path == entity
    )
    columns = (
        batch.column("run_time").cast("int64")
        for batch in batches
        if "run_time" in batch.schema.names
    )
    return sorted(1e-9 * tick for column in columns for tick in column.to_pylist())


@pytest.mark.parametrize(
    ("asked", "from_s", "to_s", "cursor_s"),
    [
        ({"at": "+400s"}, 280.0, 520.0, 400.0),
        ({"start": "+350s", "end": "+450s"}, 350.0, 450.0, 350.0),
    ],
)
def test_logs_maps_and_cursor_are_those_of_the_part(
    folder: Path, tmp_path: Path, asked: dict[str, str], from_s: float, to_s: float, cursor_s: float
) -> None:
    file, run = tmp_path / "r.rrd", open_run(folder)
    cursor = make_review([run], ReviewOptions([folder], **asked), file)
    assert cursor == viewer.CursorTime("utc", round(1e9 * (run.origin_utc.timestamp() + cursor_s)))
    assert times_s(file, "/events") == pytest.approx([390.0])
    assert times_s(file, "/found") == pytest.approx([400.0], abs=1.5)
    maps_s = times_s(file, "/shape/map/difference")
    assert len(maps_s) > 10
    assert from_s <= maps_s[0] <= maps_s[-1] <= to_s
    lines_s = times_s(
        file, "/found/lines/pressure_step"
    )  # of the whole run, as the plots can be zoomed out
    assert lines_s[::3] == pytest.approx([150.0, 400.0, 650.0], abs=1.5)


def test_a_whole_run_is_complete_without_a_requested_moment(folder: Path, tmp_path: Path) -> None:
    file = tmp_path / "r.rrd"
    assert make_review([open_run(folder)], ReviewOptions([folder]), file) is None
    assert {50.0, 390.0, 700.0} <= {round(at_s, 3) for at_s in times_s(file, "/events")}
    assert len(times_s(file, "/found")) == 3


class Client:
    """A viewer that refuses first, then has not opened its file yet."""

    calls = 0
    at_ns: int | None = None

    @classmethod
    def connect(cls, _: str) -> Client:
        cls.calls += 1
        if cls.calls == 1:
            raise ConnectionError
        return cls()

    def set_time(self, timeline: str, timestamp: np.datetime64, play_state: str) -> None:
        assert (timeline, play_state) == ("utc", "paused")
        Client.at_ns = int(timestamp.astype(np.int64)) if Client.calls >= 3 else None

    def get_state(self) -> SimpleNamespace:
        return SimpleNamespace(recordings=[SimpleNamespace(current_time=Client.at_ns)])


def test_the_cursor_is_put_again_until_it_stands_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewer, "ViewerClient", Client)
    monkeypatch.setattr(viewer, "_CURSOR_AGAIN_S", 0.0)
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        viewer.put_cursor(process, 1, viewer.CursorTime("utc", 800_250_000_001))
        assert (Client.calls, Client.at_ns) == (3, 800_250_000_001)
        process.communicate(b"\n")
        viewer.put_cursor(
            process, 1, viewer.CursorTime("utc", 10)
        )  # ended meanwhile: nothing to do
    assert Client.calls == 3
