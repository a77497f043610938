"""The recorder as it runs: its own process, real rings, and the faults it must survive."""

from __future__ import annotations

import json
import multiprocessing
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from membrane_ctrl.config.schema import Config
from membrane_ctrl.controller.tick_codec import MESSAGE_BYTES
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.recorder_events import RecorderError
from membrane_ctrl.model.shape_estimate import pack_estimate
from membrane_ctrl.model.telemetry import COLUMN, unpack_rows
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from membrane_ctrl.processes.child import STOP
from membrane_ctrl.processes.event_pipe import make_event_sender
from membrane_ctrl.processes.ring import RingWriter, open_ring
from membrane_ctrl.recorder.process import RecorderSpec, recorder_main
from membrane_ctrl.run_files.run_folder import create_run_folder
from membrane_ctrl.run_files.streams import STREAMS
from tests.support.rrd_reading import has_footer, scalars, strings
from tests.worlds.synthetic_run import message_of, rows_of, shape_of

pytestmark = pytest.mark.real_time

SPAWN = multiprocessing.get_context("spawn")
DEADLINE_S = 30.0


@dataclass
class Feed:
    """The control process' end of the rings."""

    spec: RecorderSpec
    inputs: RingWriter
    events: RingWriter
    shapes: RingWriter

    def event(self, kind: str, **more: Any) -> None:
        self.events.put(
            json.dumps({"time_utc": "2026-11-21T01:23:45+00:00", "kind": kind, **more}).encode()
        )


@pytest.fixture
def feed(tmp_path: Path) -> Iterator[Feed]:
    clock = RunClock.start()
    run_dir = create_run_folder(tmp_path, "test", clock.origin_utc, Config())
    with ExitStack() as stack:
        addresses = [
            stack.enter_context(open_ring(slots, size))
            for slots, size in ((2000, MESSAGE_BYTES), (64, 4000), (16, 30_000))
        ]
        writers = [RingWriter(address) for address in addresses]
        spec = RecorderSpec(run_dir, "test", clock, Config(), *addresses)
        yield Feed(spec, *writers)
        for writer in writers:
            writer.close()


@contextmanager
def recorder(
    spec: RecorderSpec, file_bytes_max: int | None = None
) -> Iterator[tuple[Any, Connection]]:
    """A recorder in its process; it cannot make a file larger than `file_bytes_max`.

    That limit is the nearest thing to a small disk that needs no rights.
    """
    ours, theirs = SPAWN.Pipe()
    process = SPAWN.Process(target=recorder_main, args=(spec, theirs))
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (file_bytes_max or soft, hard))
    try:
        process.start()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    theirs.close()
    try:
        yield process, ours
    finally:
        process.join(DEADLINE_S)
        process.kill()
        process.join()
        ours.close()


def received(status: Connection) -> list[dict[str, Any]]:
    """All reports of a recorder that has ended, but for those that it is alive."""
    reports = []
    while True:
        try:
            reports.append(status.recv())
        except EOFError:
            break
    assert sum(report["kind"] == "alive" for report in reports) >= 1
    return [report for report in reports if report["kind"] != "alive"]


def summary_of(run_dir: Path) -> dict[str, Any]:
    return json.loads((run_dir / "summary.json").read_text())


def recorded_bytes(run_dir: Path) -> int:
    return sum(path.stat().st_size for path in run_dir.glob("*.rrd"))


def wait_for(condition: Callable[[], bool]) -> None:
    until_s = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < until_s, "nothing came"
        time.sleep(0.02)


def test_every_row_event_and_shape_is_found_again(feed: Feed) -> None:
    rows = rows_of(20.0)
    with recorder(feed.spec) as (process, status):
        feed.event("state", mono_s=0.0, to="standby")
        for row in rows:
            feed.inputs.put(message_of(row))
        for cycle in range(5):
            feed.shapes.put(
                pack_estimate(shape_of(2.0 * cycle, cycle, "rejected" if cycle == 3 else "ok"))
            )
        feed.event("fault", mono_s=19.0, cause="over_pressure")
        feed.event("end", mono_s=20.0, exit="done")
        process.join(DEADLINE_S)
        assert process.exitcode == 0
        assert [report["kind"] for report in received(status)] == ["recorder_done"]
    path = feed.spec.run_dir / "test-000.rrd"
    table = unpack_rows([row.pack() for row in rows])
    for stream in STREAMS:
        columns = table[:, [COLUMN[line.field] for line in stream.lines]]
        if np.isfinite(columns).any():
            time_s, values = scalars(path, stream.path)
            assert time_s == pytest.approx(table[:, COLUMN["mono_s"]], abs=1e-9), stream.path
            assert np.array_equal(values, columns, equal_nan=True), stream.path
    assert has_footer(path)
    assert scalars(path, "/shape/zernike")[1].shape == (4, ZERNIKE_TERMS)
    assert [word for _, word in strings(path, "/state/controller", "StateChange:state")] == [
        "standby",
        "settle",
        "hold",
    ]
    assert [word for _, word in strings(path, "/state/verdict", "StateChange:state")] == [
        "ok",
        "rejected",
        "ok",
    ]
    events = [
        text.split()[1].rstrip(":") for _, text in strings(path, "/events", "TextLog:text")
    ]  # after the time
    assert events == ["state", "fault", "Run"]
    found = summary_of(feed.spec.run_dir)
    assert (found["ticks"], found["cycles"], found["cycles_rejected"], found["exit"]) == (
        1000,
        5,
        1,
        "done",
    )
    assert found["dropped"] == {"inputs": 0, "events": 0, "shapes": 0}
    kinds = [
        json.loads(line)["kind"]
        for line in (feed.spec.run_dir / "events.jsonl").read_text().splitlines()
    ]
    assert kinds == ["state", "fault", "end"]


def test_what_the_ring_overwrote_is_counted(feed: Feed) -> None:
    for row in rows_of(60.0):  # 3000 rows into 2000 slots, before anyone reads
        feed.inputs.put(message_of(row))
    feed.event("end", mono_s=60.0, exit="done")
    recorder_in_process(feed.spec)
    found = summary_of(feed.spec.run_dir)
    assert found["dropped"]["inputs"] == 1000
    assert found["ticks"] == 3000


def recorder_in_process(spec: RecorderSpec) -> list[dict[str, Any]]:
    """The recorder without a process of its own; what it reported."""
    from membrane_ctrl.recorder import process

    reports: list[dict[str, Any]] = []
    process._record_run(
        spec, lambda event: reports.append(event.to_dict()), lambda: False, lambda: False
    )
    return reports


@pytest.mark.parametrize(
    ("asked", "orphan", "word"), [(True, False, "terminated"), (False, True, "killed")]
)
def test_without_an_end_event_the_run_still_gets_one(
    feed: Feed, asked: bool, orphan: bool, word: str
) -> None:
    from membrane_ctrl.recorder import process

    feed.inputs.put(message_of(rows_of(0.02)[0]))
    process._record_run(feed.spec, lambda message: None, lambda: asked, lambda: orphan)
    assert summary_of(feed.spec.run_dir)["exit"] == word
    assert summary_of(feed.spec.run_dir)["ticks"] == 1
    assert has_footer(feed.spec.run_dir / "test-000.rrd")


def test_sigint_is_ignored_and_a_stop_finishes(feed: Feed) -> None:
    with recorder(feed.spec) as (process, _):
        wait_for((feed.spec.run_dir / "test-000.rrd").exists)
        os.kill(process.pid, signal.SIGINT)
        for row in rows_of(1.0):
            feed.inputs.put(message_of(row))
        os.kill(process.pid, STOP)
        process.join(DEADLINE_S)
        assert process.exitcode == 0
    found = summary_of(feed.spec.run_dir)
    assert (found["exit"], found["ticks"]) == ("terminated", 50)


PARENT = """
import os, signal, sys
sys.path.insert(0, {tests!r})
from pathlib import Path
import multiprocessing
from tests.worlds.synthetic_run import message_of, rows_of
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.config.schema import Config  # noqa: E402
from membrane_ctrl.processes.ring import Ring, RingWriter
from membrane_ctrl.processes.child import STOP
from membrane_ctrl.recorder.process import RecorderSpec, recorder_main
from membrane_ctrl.controller.tick_codec import MESSAGE_BYTES

if __name__ == "__main__":
    inputs, events = Ring(2000, MESSAGE_BYTES), Ring(64, 4000)
    spec = RecorderSpec(Path({run_dir!r}), "test", RunClock.start(), Config(), inputs.address, events.address)
    multiprocessing.get_context("spawn").Process(target=recorder_main, args=(spec,)).start()
    writer = RingWriter(inputs.address)
    rows = rows_of(20.0)
    for row in rows[:500]:
        writer.put(message_of(row))
    while not (spec.run_dir / "test-000.rrd").exists():
        pass
    for row in rows[500:]:
        writer.put(message_of(row))
    os.kill(os.getpid(), signal.SIGKILL)
"""  # noqa: E501


def test_a_killed_control_process_leaves_a_whole_recording(tmp_path: Path) -> None:
    run_dir = create_run_folder(tmp_path, "test", RunClock.start().origin_utc, Config())
    script = tmp_path / "parent.py"
    script.write_text(PARENT.format(tests=str(Path(__file__).parents[2]), run_dir=str(run_dir)))
    with subprocess.Popen([sys.executable, str(script)], stderr=subprocess.DEVNULL) as parent:
        assert parent.wait(DEADLINE_S) == -signal.SIGKILL
        wait_for((run_dir / "summary.json").exists)
    found = summary_of(run_dir)
    assert (found["exit"], found["ticks"], found["dropped"]["inputs"]) == ("killed", 1000, 0)
    assert has_footer(run_dir / "test-000.rrd")
    assert len(scalars(run_dir / "test-000.rrd", "/loop/error")[0]) == 1000
    last = json.loads((run_dir / "events.jsonl").read_text().splitlines()[-1])
    assert (last["kind"], last["exit"]) == ("end", "killed")


def test_a_writer_that_dies_is_reported_and_the_recording_continues(feed: Feed) -> None:
    run_dir = feed.spec.run_dir
    rows = iter(rows_of(60.0))
    fed: list[float] = []
    with recorder(replace(feed.spec, flush_s=0.2), file_bytes_max=1_000_000) as (process, status):
        wait_for((run_dir / "test-000.rrd").exists)
        while not (run_dir / "test-001.rrd").exists():
            enough_bytes = (
                recorded_bytes(run_dir) + 40_000
            )  # of the 60 000 and more that 100 rows take
            for row in islice(rows, 100):
                feed.inputs.put(message_of(row))
                fed.append(row.mono_s)
            wait_for(lambda enough=enough_bytes: recorded_bytes(run_dir) >= enough)
        feed.event("end", mono_s=fed[-1], exit="done")
        process.join(DEADLINE_S)
        assert process.exitcode == 0
        kinds = [report["kind"] for report in received(status)]
    assert kinds == ["recorder_error", "recorder_recovered", "recorder_done"]
    account = summary_of(run_dir)["recorder"]
    lost = dict.fromkeys(
        ("rows_lost", "table_rows_lost", "events_lost", "input_ticks_lost", "restarts"), 0
    )
    assert account["tables"]["ticks"] == len(list((run_dir / "ticks").glob("ticks-*")))
    expected = {"errors": 1, "partial": False, "folder_replaced_s": None}
    assert (
        account == {"segments": account["segments"], "tables": account["tables"]} | expected | lost
    )
    assert has_footer(run_dir / "test-001.rrd")
    # the batch that met the full disk is in the new file, whole
    time_s, _ = scalars(run_dir / "test-001.rrd", "/loop/error")
    assert time_s == pytest.approx(fed[-len(time_s) :], abs=1e-9)


def test_a_report_without_a_reader_does_not_block() -> None:
    ours, theirs = SPAWN.Pipe()
    report = make_event_sender(theirs)
    for _ in range(10_000):
        report(RecorderError("x", "x" * 5000))
    first = ours.recv()
    assert (first["kind"], len(first["message"])) == ("recorder_error", 1000)
    ours.close()
    report(RecorderError("x", "nobody is there"))
    theirs.close()


def test_the_specification_does_not_load_rerun() -> None:
    code = "import sys, membrane_ctrl.recorder.process; sys.exit('rerun' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
