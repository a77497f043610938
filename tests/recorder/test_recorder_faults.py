"""A recorder whose disk or data fails: it reports this, loses as little as possible,
and continues.
"""

from __future__ import annotations

import errno
import json
import shutil
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from membrane_ctrl.config import toml_file as config_file
from membrane_ctrl.config.schema import Config, RecordingConfig
from membrane_ctrl.controller.tick_codec import MESSAGE_BYTES
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.file_checksums import dumps_checked
from membrane_ctrl.model.shape_estimate import pack_estimate
from membrane_ctrl.processes.ring import RingReader, RingWriter, open_ring
from membrane_ctrl.recorder import events_file
from membrane_ctrl.recorder.recorder import Recorder
from membrane_ctrl.recorder.rerun_output import RETRY_S
from membrane_ctrl.recorder.rerun_recording import Recording, RecordingError
from membrane_ctrl.run_files.inputs_file import InputsReader
from membrane_ctrl.run_files.run_folder import write_heads
from membrane_ctrl.run_files.table_store.disk import Disk
from tests.support.rrd_reading import scalars
from tests.worlds.synthetic_run import STARTED_UTC, message_of, rows_of, shape_of


class HandClock(RunClock):
    """A clock moved by hand."""

    moment_s = 0.0

    def now(self) -> float:
        return HandClock.moment_s


class FlakyRecording(Recording):
    """A recording on a disk that can be filled."""

    full = False

    def abandon(self) -> None:
        """End of the test, whatever became of the file."""
        self._stream.disconnect()

    def next_segment(self) -> None:
        if self.full:
            raise RecordingError("no space left on device")
        super().next_segment()

    def flush(self) -> None:
        if self.full:
            raise RecordingError("writer thread is gone")
        super().flush()


@dataclass
class Bench:
    """A recorder in this process, its rings' writers and what it reported."""

    run_dir: Path
    recording: FlakyRecording
    recorder: Recorder
    writers: dict[str, RingWriter]
    reports: list[dict[str, Any]] = field(default_factory=list)

    def second(self, number: int) -> None:
        """One second of rows at its place in the run, and the recorder's work for it."""
        HandClock.moment_s = float(number)
        for row in rows_of(number + 1.0)[-50:]:
            self.writers["inputs"].put(message_of(row))
        self.recorder.drain_rings()
        self.recorder.write_second()

    def kinds(self) -> list[str]:
        return [report["kind"] for report in self.reports]


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    yield from make_bench(tmp_path, Config())


def make_bench(run_dir: Path, config: Config) -> Iterator[Bench]:
    HandClock.moment_s = 0.0
    clock = HandClock(0.0, STARTED_UTC)
    with ExitStack() as stack:
        sizes = {"inputs": (2000, MESSAGE_BYTES), "events": (64, 4000), "shapes": (8, 30_000)}
        addresses = {name: stack.enter_context(open_ring(*size)) for name, size in sizes.items()}
        readers = {name: RingReader(address) for name, address in addresses.items()}
        writers = {name: RingWriter(address) for name, address in addresses.items()}
        recording = FlakyRecording(run_dir, "test", clock, config)
        reports: list[dict[str, Any]] = []
        yield Bench(
            run_dir,
            recording,
            Recorder(
                run_dir,
                clock,
                config,
                readers,
                recording,
                None,
                lambda event: reports.append(event.to_dict()),
            ),
            writers,
            reports,
        )
        recording.abandon()
        for end in (*readers.values(), *writers.values()):
            end.close()


def times_s(bench: Bench) -> list[int]:
    """Whole seconds found in all segments."""
    found: set[int] = set()
    for path in sorted(bench.run_dir.glob("*.rrd")):
        found |= {int(moment + 1e-6) for moment in scalars(path, "/loop/error")[0]}
    return sorted(found)


def test_a_dead_writer_gets_a_new_file_and_no_row_is_lost(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.second(0)
    real_flush, failures = FlakyRecording.flush, iter([True])

    def flush(recording: FlakyRecording) -> None:
        if next(failures, False):
            raise RecordingError("writer thread is gone")
        real_flush(recording)

    monkeypatch.setattr(FlakyRecording, "flush", flush)
    bench.second(1)
    bench.second(2)
    bench.recorder.finish(in_haste=True)
    assert bench.kinds() == ["recorder_error", "recorder_recovered", "recorder_done"]
    assert bench.recording.segments == 2
    assert times_s(bench) == [0, 1, 2]


def test_a_full_disk_is_reported_once_counted_and_recovered_from(bench: Bench) -> None:
    bench.second(0)
    bench.recording.full = True
    for number in range(1, 6):
        bench.second(number)
    assert (
        bench.kinds().count("recorder_error") <= 2
    )  # the flush, then the new file: not one a second
    bench.recording.full = False
    back_s = int(2 + 2 * RETRY_S)
    bench.second(back_s)
    bench.recorder.finish(in_haste=True)
    assert bench.kinds()[-2:] == ["recorder_recovered", "recorder_done"]
    # second 1 was on its way when the disk was full: here it can still arrive, on a real disk it
    # would not
    assert set(times_s(bench)) - {1} == {0, back_s}
    found = json.loads((bench.run_dir / "summary.json").read_text())
    assert found["recorder"]["rows_lost"] == 5 * 50
    assert found["ticks"] == 7 * 50  # the statistics lost nothing


def test_a_file_that_was_not_closed_whole_is_reported(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.second(0)
    monkeypatch.setattr(FlakyRecording, "sync", lambda _: None)
    (bench.run_dir / "test-000.rrd").unlink()
    bench.recorder.finish(in_haste=True)
    assert bench.kinds() == ["recorder_error", "recorder_done"]
    assert "closed without its footer" in bench.reports[0]["message"]


def test_a_segment_deleted_under_the_recorder_is_reported_and_another_begun(bench: Bench) -> None:
    bench.second(0)
    (bench.run_dir / "test-000.rrd").unlink()
    bench.second(1)
    bench.second(2)
    bench.recorder.finish(in_haste=True)
    assert bench.kinds() == ["recorder_error", "recorder_recovered", "recorder_done"]
    assert times_s(bench) == [2]


def emptied(folder: Path) -> None:
    """As an `rm -r` leaves it that met a file just written."""
    for path in folder.glob("*/"):
        shutil.rmtree(path)
    for path in folder.glob("*.*"):
        path.unlink()


def replaced(folder: Path) -> None:
    """As by the acquisition, which makes the folder of its frames."""
    shutil.rmtree(folder)
    (folder / "raw").mkdir(parents=True)


TAKEN_AWAY = {
    "removed": shutil.rmtree,
    "moved": lambda folder: folder.rename(folder.with_name("elsewhere")),
    "emptied": emptied,
    "replaced": replaced,
}


@pytest.mark.parametrize("how", TAKEN_AWAY)
def test_a_removed_run_folder_is_created_again_and_reported(tmp_path: Path, how: str) -> None:
    run_dir = tmp_path / "run"
    config = Config()
    run_dir.mkdir()
    write_heads(run_dir, config)
    for bench in make_bench(run_dir, config):
        bench.writers["events"].put(b'{"kind": "start", "mono_s": 0.0}')
        bench.second(0)
        TAKEN_AWAY[how](run_dir)
        bench.writers["events"].put(b'{"kind": "mark", "mono_s": 0.9}')
        for number in (1, 2):
            bench.second(number)
        bench.recorder.finish(in_haste=True)
        messages = [
            report["message"] for report in bench.reports if report["kind"] == "recorder_error"
        ]
        what = f"{run_dir} was removed or moved; a new one starts at 1.0 s"
        assert messages == [f"{what}, without the earlier data"]
        assert "recorder_recovered" not in bench.kinds()
        assert times_s(bench) == [1, 2]
    assert config_file.load_toml(run_dir / "config.toml", Config) == config
    assert json.loads((run_dir / "events.jsonl").read_text())["kind"] == "mark"
    found = json.loads((run_dir / "summary.json").read_text())
    assert (found["ticks"], found["recorder"]["folder_replaced_s"]) == (150, 1.0)
    rows = pq.read_metadata(run_dir / "ticks" / "ticks-0001.parquet").num_rows
    assert rows == 100  # those of the first second were in the old folder


def test_segments_are_changed_in_time_without_losing_a_row(bench: Bench) -> None:
    bench.second(0)
    bench.second(1)
    HandClock.moment_s = Config().recording.segment_s + 1
    for row in rows_of(3.0)[-50:]:
        bench.writers["inputs"].put(message_of(row))
    bench.recorder.drain_rings()
    bench.recorder.write_second()
    bench.recorder.finish(in_haste=True)
    assert sorted(path.name for path in bench.run_dir.glob("*.rrd")) == [
        "test-000.rrd",
        "test-001.rrd",
    ]
    assert times_s(bench) == [0, 1, 2]


def test_a_broken_shape_is_reported_and_the_next_one_taken(bench: Bench) -> None:
    bench.writers["shapes"].put(b"no shape")
    bench.writers["shapes"].put(pack_estimate(shape_of(1.0, 1)))
    bench.second(0)
    bench.recorder.finish(in_haste=True)
    assert bench.kinds() == ["recorder_error", "recorder_recovered", "recorder_done"]
    assert "shape estimate: JSONDecodeError" in bench.reports[0]["message"]
    assert json.loads((bench.run_dir / "summary.json").read_text())["cycles"] == 1


def test_events_that_cannot_be_written_are_reported_and_come_later(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    real_open = events_file.os.open

    def full(*_: Any) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(events_file.os, "open", full)
    bench.writers["events"].put(b'{"kind": "fault", "mono_s": 0.5}')
    bench.second(0)
    assert "events.jsonl: [Errno 28] No space left on device" in bench.reports[0]["message"]
    monkeypatch.setattr(events_file.os, "open", real_open)
    bench.second(1)
    bench.recorder.finish(in_haste=True)
    text = (bench.run_dir / "events.jsonl").read_text()
    assert text == dumps_checked({"kind": "fault", "mono_s": 0.5}) + "\n"


@pytest.mark.parametrize("room_again", [True, False])
def test_inputs_that_met_a_full_disk_come_later_or_are_counted(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, room_again: bool
) -> None:
    def full(*_: Any) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    def seconds(first: int, count: int) -> None:
        for number in range(first, first + count):
            bench.second(number)

    seconds(0, 3)
    with monkeypatch.context() as patch:
        patch.setattr(Disk, "write", full)
        seconds(3, 4)
        if not room_again:
            bench.recorder.finish(in_haste=True)
    if room_again:
        seconds(7, 2)
        bench.recorder.finish(in_haste=True)
    found = [int(tick) for frame in InputsReader(bench.run_dir) for tick in frame.records["tick"]]
    account = json.loads((bench.run_dir / "summary.json").read_text())["recorder"]
    assert found == list(range(1, 450 if room_again else 150))
    assert account["input_ticks_lost"] == (0 if room_again else 200)


def test_a_disk_that_runs_low_is_reported_once(tmp_path: Path) -> None:
    config = Config(recording=RecordingConfig(min_free_mb=1e9))
    for bench in make_bench(tmp_path, config):
        for number in range(3):
            bench.second(number)
        assert bench.kinds() == ["disk_low"]
        assert str(tmp_path) in bench.reports[0]["message"]
