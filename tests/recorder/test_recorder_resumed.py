"""A recorder dies in the middle of a run; the next one continues,
and the run has everything once.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from membrane_ctrl.config.schema import Config, RecordingConfig
from membrane_ctrl.controller.tick_codec import MESSAGE_BYTES
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.events import Event
from membrane_ctrl.model.file_checksums import dumps_checked
from membrane_ctrl.model.shape_estimate import pack_estimate
from membrane_ctrl.model.state_tree import find_differences
from membrane_ctrl.processes.ring import RingAddress, RingReader, RingWriter, open_ring
from membrane_ctrl.recorder.events_file import EventsFile
from membrane_ctrl.recorder.handover import load_state, save_state
from membrane_ctrl.recorder.recorder import Recorder
from membrane_ctrl.recorder.rerun_recording import Recording, is_whole
from membrane_ctrl.recorder.segment_optimizer import Optimizer
from membrane_ctrl.run_files.detail_level import DetailLevel
from tests.support.rrd_reading import has_footer, reader, recorded_rows, scalars, strings
from tests.worlds.recorded_hold import ring_trip
from tests.worlds.synthetic_run import STARTED_UTC, message_of, rows_of, shape_of

ROWS = rows_of(12.0)


class HandClock(RunClock):
    """A clock moved by hand."""

    moment_s = 0.0

    def now(self) -> float:
        return HandClock.moment_s


class Run:
    """Rings of a run that outlive its recorders."""

    def __init__(
        self, run_dir: Path, stack: ExitStack, config: Config, rows_kept: int = 3000
    ) -> None:
        HandClock.moment_s = 0.0
        self.run_dir, self.config = run_dir, config
        self._stack = stack
        self.addresses: dict[str, RingAddress] = {
            "inputs": stack.enter_context(open_ring(rows_kept, MESSAGE_BYTES)),
            "events": stack.enter_context(open_ring(64, 4000)),
            "shapes": stack.enter_context(open_ring(8, 30_000)),
        }
        self.writers = {name: RingWriter(address) for name, address in self.addresses.items()}
        for writer in self.writers.values():
            stack.callback(writer.close)
        self.reports: list[dict[str, Any]] = []

    def recorder(self, resumes: int) -> Recorder:
        clock = HandClock(0.0, STARTED_UTC)
        first = len(list(self.run_dir.glob("*.rrd")))
        recording = Recording(self.run_dir, "test", clock, self.config, first)
        self._stack.callback(recording._stream.disconnect)
        readers = {name: RingReader(address) for name, address in self.addresses.items()}
        for ring_reader in readers.values():
            self._stack.callback(ring_reader.close)
        return Recorder(
            self.run_dir, clock, self.config, readers, recording, None, self._report, resumes
        )

    def _report(self, event: Event) -> None:
        self.reports.append(event.to_dict())

    def second(self, recorder: Recorder, number: int, write: bool = True) -> None:
        """One second of the run; without `write` the recorder dies with it in its hands."""
        HandClock.moment_s = float(number)
        for row in ROWS[50 * number : 50 * number + 50]:
            self.writers["inputs"].put(message_of(row))
        self.event("mark", number)
        recorder.drain_rings()
        if write:
            recorder.write_second()

    def event(self, kind: str, number: float) -> None:
        self.writers["events"].put(json.dumps({"mono_s": number, "kind": kind}).encode())

    @property
    def summary(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads((self.run_dir / "summary.json").read_text())
        return found


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as found:
        yield found


def recorded(run_dir: Path) -> np.ndarray:
    return np.concatenate([recorded_rows(path) for path in sorted(run_dir.glob("*.rrd"))])


def test_a_recorder_after_the_end_waits_for_no_second_end(tmp_path: Path, stack: ExitStack) -> None:
    """The first one is killed while it closes: on a slow disk that takes longer than the hold
    waits.
    """
    run = Run(tmp_path, stack, Config())
    first = run.recorder(0)
    run.second(first, 0)
    run.writers["events"].put(
        json.dumps({"mono_s": 1.0, "kind": "end", "exit": "safety_trip"}).encode()
    )
    first.drain_rings()
    first.write_second()
    assert first.ended
    second = run.recorder(1)
    assert second.ended
    second.finish(in_haste=True)
    lines = [json.loads(line) for line in (tmp_path / "events.jsonl").read_text().splitlines()]
    assert [line["exit"] for line in lines if line["kind"] == "end"] == ["safety_trip"]
    assert run.summary["exit"] == "safety_trip"


def test_the_next_recorder_continues_and_everything_is_recorded_once(
    tmp_path: Path, stack: ExitStack
) -> None:
    run = Run(tmp_path, stack, Config())
    first = run.recorder(0)
    run.writers["shapes"].put(pack_estimate(shape_of(0.5, 0)))
    for number in range(5):
        run.second(first, number)
    run.second(
        first, 5, write=False
    )  # its events are in the file, its rows are not: then it is killed
    second = run.recorder(1)
    for number in range(6, 12):
        run.second(second, number)
    run.event("end", 12.0)
    second.drain_rings()
    second.finish(in_haste=True)
    ticks = recorded(tmp_path)[:, 1]
    assert np.array_equal(np.sort(ticks), np.arange(600))
    numbers = [
        json.loads(line)["mono_s"] for line in (tmp_path / "events.jsonl").read_text().splitlines()
    ]
    assert numbers == [*range(12), 12.0]
    summary = run.summary
    assert summary["ticks"] == 600
    assert summary["cycles"] == 1
    assert summary["transitions"] == 3
    assert summary["dropped"] == {"inputs": 0, "events": 0, "shapes": 0}
    assert summary["recorder"]["restarts"] == 1
    assert summary["recorder"]["partial"] is False
    assert sorted(path.name for path in tmp_path.glob("*.rrd")) == ["test-000.rrd", "test-001.rrd"]
    assert not (tmp_path / ".recorder-state").exists()


def test_the_page_of_the_next_recorder_has_the_gains(tmp_path: Path, stack: ExitStack) -> None:
    run = Run(tmp_path, stack, Config())
    first = run.recorder(0)
    gains = {
        "mono_s": 0.0,
        "kind": "command",
        "command": "gains",
        "who": "ann",
        "why": "",
        "loop": {"kp_per_s": 0.8, "ti_s": 6.0, "td_s": 0.0},
    }
    run.writers["events"].put(json.dumps(gains).encode())
    run.second(first, 0)
    second = run.recorder(1)
    run.second(second, 1)
    second.finish(in_haste=True)
    pages = [
        text
        for path in sorted(tmp_path.glob("*.rrd"))
        for _, text in strings(path, "/summary", "TextDocument:text")
    ]
    assert len(pages) >= 2
    assert all("| gains | Kp 0.8 1/s, Ti 6 s, Td 0 s |" in page for page in pages)


def test_what_is_handed_on_comes_back_to_the_last_bit(tmp_path: Path, stack: ExitStack) -> None:
    run = Run(tmp_path, stack, Config())
    recorder = run.recorder(0)
    run.writers["shapes"].put(pack_estimate(shape_of(0.5, 0)))
    run.event("fault", 0.5)
    for number in range(12):
        run.second(recorder, number)
    path = tmp_path / ".recorder-state"
    state = load_state(tmp_path)
    assert state is not None
    assert state.windows.levels
    state.reference = ring_trip(shape_of(1.0, 1))
    save_state(tmp_path, state)
    written = path.read_bytes()
    again = load_state(tmp_path)
    assert again is not None
    assert again.reference is not None
    assert np.array_equal(again.reference.covariance_um2, state.reference.covariance_um2)
    save_state(tmp_path, again)
    assert path.read_bytes() == written
    assert find_differences(again, state) == []


def _rename_a_column(state: dict[str, Any]) -> None:
    ticks = state["windows"]["ticks"]
    ticks["another"] = ticks.pop("mono_s")


def _shorten_a_column(state: dict[str, Any]) -> None:
    state["windows"]["levels"]["10.0"]["time_s"] = ""


def _name_another_window(state: dict[str, Any]) -> None:
    state["windows"]["levels"]["7.0"] = state["windows"]["levels"].pop("10.0")


@pytest.mark.parametrize(
    "damage",
    [
        lambda state: state.update(errors="0"),
        lambda state: state.update(errors=-1),
        lambda state: state.update(more=1),
        lambda state: state.pop("dropped"),
        lambda state: state.update(reference=5),
        lambda state: state.update(reference="AAAA"),
        lambda state: state.update(reference="no base64"),
        lambda state: state["summary"]["lateness_ms"].update(bins="AAAAAAAAAAA="),
        lambda state: state["summary"]["states"].append({"state": "hold"}),
        _rename_a_column,
        _shorten_a_column,
        _name_another_window,
    ],
)
def test_a_damaged_state_is_refused(
    tmp_path: Path, stack: ExitStack, damage: Callable[[dict[str, Any]], object]
) -> None:
    run = Run(tmp_path, stack, Config())
    recorder = run.recorder(0)
    for number in range(2):
        run.second(recorder, number)
    path = tmp_path / ".recorder-state"
    state = json.loads(path.read_bytes())
    assert load_state(tmp_path) is not None
    damage(state)
    path.write_text(json.dumps(state))
    assert load_state(tmp_path) is None


def test_a_state_above_the_size_limit_is_refused(
    tmp_path: Path, stack: ExitStack, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Run(tmp_path, stack, Config())
    run.second(run.recorder(0), 0)
    monkeypatch.setattr("membrane_ctrl.recorder.handover._BYTES_MAX", 1000)
    assert load_state(tmp_path) is None


@pytest.mark.parametrize(
    ("left", "rows_kept", "partial", "ticks"),
    [
        (None, 75, True, 100),
        (None, 3000, False, 100),
        *(
            (left, 3000, False, 100)
            for left in (b"", b"no state", b"\x80\x04N.", b"[]", b"[" * 10_000, b"{}", b"null")
        ),
    ],
)
def test_without_a_handover_the_statistics_begin_with_the_ring_and_are_marked_partial(
    tmp_path: Path, stack: ExitStack, left: bytes | None, rows_kept: int, partial: bool, ticks: int
) -> None:
    run = Run(tmp_path, stack, Config(), rows_kept)
    first = run.recorder(0)
    run.second(first, 0)
    state = tmp_path / ".recorder-state"
    state.unlink()
    if left is not None:
        state.write_bytes(left)
    second = run.recorder(1)
    run.second(second, 1)
    run.event("end", 2.0)
    second.drain_rings()
    second.finish(in_haste=True)
    assert run.summary["recorder"]["partial"] is partial
    assert run.summary["ticks"] == ticks
    assert run.summary["dropped"]["inputs"] == max(0, 100 - rows_kept)
    assert [
        json.loads(line)["mono_s"] for line in (tmp_path / "events.jsonl").read_text().splitlines()
    ] == [0, 1, 2]


def test_half_a_line_of_the_event_log_is_written_again_whole(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    lines = [dumps_checked({"kind": kind}).encode() + b"\n" for kind in "abc"]
    path.write_bytes(lines[0] + lines[1] + lines[2][:5])
    file = EventsFile(path, resumed=True)
    file.append_events([{"kind": "b"}, {"kind": "c"}])
    file.close()
    assert path.read_bytes() == b"".join(lines)


def test_a_fault_does_not_wait_for_its_second(tmp_path: Path, stack: ExitStack) -> None:
    run = Run(tmp_path, stack, Config())
    recorder = run.recorder(0)
    run.second(recorder, 0)
    run.event("fault", 1.0)
    recorder.drain_rings()
    assert recorder.urgent
    recorder.write_second()
    assert not recorder.urgent


def test_on_the_last_megabytes_rerun_stops_and_continues_when_there_is_space(
    tmp_path: Path, stack: ExitStack, monkeypatch: pytest.MonkeyPatch
) -> None:
    left_mb = {"now": 5000.0}
    monkeypatch.setattr("membrane_ctrl.run_files.run_folder.free_mb", lambda _: left_mb["now"])
    run = Run(tmp_path, stack, Config())
    recorder = run.recorder(0)
    run.second(recorder, 0)
    left_mb["now"] = 50.0
    run.second(recorder, 1)
    assert has_footer(tmp_path / "test-000.rrd")  # closed while there was room for it
    left_mb["now"] = 5000.0
    run.second(recorder, 2)
    run.event("end", 3.0)
    recorder.drain_rings()
    recorder.finish(in_haste=True)
    assert {int(moment) for moment in scalars(tmp_path / "test-001.rrd", "/loop/error")[0]} == {2}
    assert [report["kind"] for report in run.reports] == [
        "disk_low",
        "recorder_recovered",
        "recorder_done",
    ]
    assert run.summary["ticks"] == 150
    assert run.summary["recorder"]["rows_lost"] == 50


def test_with_little_room_maps_are_left_out(
    tmp_path: Path, stack: ExitStack, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("membrane_ctrl.run_files.run_folder.free_mb", lambda _: 700.0)
    run = Run(tmp_path, stack, Config())
    recorder = run.recorder(0)
    run.writers["shapes"].put(pack_estimate(shape_of(0.5, 0)))
    run.second(recorder, 0)
    recorder.finish(in_haste=True)
    assert recorder._housekeeping.detail == DetailLevel.NO_PICTURES
    data = (tmp_path / "test-000.rrd").read_bytes()
    assert len(scalars(tmp_path / "test-000.rrd", "/shape/zernike")[0]) == 1
    assert b"DepthImage:buffer" not in data


def chunks(path: Path) -> int:
    """Pieces that one signal is in."""
    found = (
        chunk.to_record_batch() for chunk in reader(path).stream().filter(content="/loop/error")
    )
    return sum("Scalars:scalars" in batch.schema.names for batch in found)


def has_layout(path: Path) -> bool:
    return b"ViewportBlueprint" in path.read_bytes()


def test_closed_segments_are_optimised_beside_the_recording(
    tmp_path: Path, stack: ExitStack
) -> None:
    run = Run(tmp_path, stack, Config(recording=RecordingConfig(segment_s=10)))
    recorder = run.recorder(0)
    for number in range(10):
        run.second(recorder, number)
    assert chunks(tmp_path / "test-000.rrd") >= 10
    for number in range(10, 12):
        run.second(recorder, number)
    assert not has_layout(tmp_path / "test-001.rrd")  # sent once only: each sending keeps 3 MB
    optimizer = recorder._housekeeping._optimizer
    assert optimizer._process is not None
    optimizer._process.wait(30.0)
    run.second(recorder, 12)
    assert not optimizer.is_busy
    recorder.finish()
    for name in ("test-000.rrd", "test-001.rrd"):  # the last one as well
        assert chunks(tmp_path / name) == 1
        assert is_whole(tmp_path / name)
        assert has_layout(tmp_path / name)
    assert np.array_equal(np.sort(recorded(tmp_path)[:, 1]), np.arange(600))
    assert not list(tmp_path.glob(".*"))


def test_in_haste_the_last_segment_is_left_as_it_is(tmp_path: Path, stack: ExitStack) -> None:
    (tmp_path / ".test-000.rrd.part").write_bytes(b"left by a recorder that was killed")
    run = Run(tmp_path, stack, Config())
    recorder = run.recorder(0)
    for number in range(10):
        run.second(recorder, number)
    recorder.finish(in_haste=True)
    assert chunks(tmp_path / "test-000.rrd") >= 10
    assert run.summary["ticks"] == 500
    assert not list(tmp_path.glob(".*"))


def test_a_segment_that_cannot_be_optimised_stays_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "test-000.rrd"
    path.write_bytes(b"no recording")
    optimizer = Optimizer(tmp_path)
    optimizer.add_segment(path)
    optimizer.poll_worker()
    assert optimizer._process is not None
    optimizer._process.wait(30.0)
    with pytest.raises(OSError, match="is not optimised"):
        optimizer.poll_worker()
    assert path.read_bytes() == b"no recording"
    assert list(tmp_path.iterdir()) == [path]


def test_what_is_under_way_at_the_end_is_given_up(tmp_path: Path) -> None:
    path = tmp_path / "test-000.rrd"
    path.write_bytes(b"no recording")
    optimizer = Optimizer(tmp_path)
    optimizer.add_segment(path)
    optimizer.poll_worker()
    optimizer.close()
    assert not optimizer.is_busy
    assert list(tmp_path.iterdir()) == [path]
