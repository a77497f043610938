"""How a run ended, from its files: cause, author, time, what to do, and the last read-back."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import pytest

from membrane_ctrl.config.schema import Config
from membrane_ctrl.control_port.ctl import Where
from membrane_ctrl.controller.tick_assembler import TickAssembler
from membrane_ctrl.model.events import Cleared, CommandTaken, Event, Fault, StateEntered
from membrane_ctrl.model.run_events import Ended
from membrane_ctrl.run_files.run_folder import create_run_folder
from membrane_ctrl.run_files.run_tables import RunTables
from membrane_ctrl.service.ended_run import EndKind, find_newest_run, read_ended_run
from membrane_ctrl.service.feed import HoldFeed, history
from tests.worlds.synthetic_run import message_of, rows_of

STARTED = datetime(2026, 1, 2, 3, 0, 0, tzinfo=UTC)
FAULT = Fault(
    51, "locked", "a person has locked the mirror", "the lock", "", "pump_off", True, "ask"
)
STOP = CommandTaken("stop", "page:anna", "web: anna")


def write_run(
    logs: Path, events: Sequence[tuple[float, Event]], seconds: float = 20.0, name: str = "lab"
) -> Path:
    """A run of some seconds whose recorder has written these events."""
    folder = create_run_folder(logs, name, STARTED, Config())
    stamp = {"time_utc": STARTED.isoformat()}
    lines = [json.dumps({**stamp, "mono_s": at_s, **each.to_dict()}) for at_s, each in events]
    first = json.dumps({**stamp, "mono_s": 0.0, "kind": "state", "state": "hold", "from": "settle"})
    (folder / "events.jsonl").write_text("\n".join([first, *lines]) + "\n")
    tables = RunTables(folder)
    tables.add_ticks(TickAssembler().add_messages([message_of(row) for row in rows_of(seconds)]))
    tables.close()
    return folder


@pytest.mark.parametrize(
    ("events", "kind", "cause"),
    [
        (
            [(19.0, STOP), (20.0, Ended("done", 0))],
            EndKind.STOPPED,
            "stopped by page:anna (web: anna)",
        ),
        ([(20.0, Ended("done", 0))], EndKind.FINISHED, "its duration was over"),
        (
            [(18.0, FAULT), (20.0, Ended("safety_trip", 5))],
            EndKind.FAULT,
            "fault 51 locked: a person has locked the mirror",
        ),
        # a recorder that was replaced while it closed has added an end of its own
        (
            [(18.0, FAULT), (20.0, Ended("safety_trip", 5)), (50.0, Ended("terminated"))],
            EndKind.FAULT,
            "fault 51 locked: a person has locked the mirror",
        ),
        (
            [(18.0, FAULT), (18.5, Cleared("locked")), (20.0, Ended("done", 0))],
            EndKind.FINISHED,
            "its duration was over",
        ),
        ([(20.0, Ended("device_failed", 4))], EndKind.DEVICE, "a device failed"),
        ([(20.0, Ended("killed"))], EndKind.CONTROL_GONE, "cause unknown: it looks like a kill"),
        ([], EndKind.NO_RECORD, "no end is recorded; cause unknown: it looks like a power cut"),
        # refused, or so old that the run went on after it
        (
            [(19.0, CommandTaken("stop", "x", "", refused="no")), (20.0, Ended("done", 0))],
            EndKind.FINISHED,
            "its duration was over",
        ),
        ([(19.0, STOP), (400.0, Ended("done", 0))], EndKind.FINISHED, "its duration was over"),
    ],
    ids=[
        "stop",
        "duration",
        "fault",
        "twice",
        "cleared",
        "device",
        "killed",
        "power",
        "refused",
        "old",
    ],
)
def test_the_cause_is_what_the_record_shows(
    tmp_path: Path, events: list[tuple[float, Event]], kind: EndKind, cause: str
) -> None:
    ended = read_ended_run(write_run(tmp_path, events))
    assert ended.kind is kind
    assert ended.is_regular == (kind in (EndKind.STOPPED, EndKind.FINISHED))
    assert cause in ended.headline
    assert (ended.pump_fraction, ended.vent_fraction) == pytest.approx((0.3, 0.0))
    assert ended.lines()[-1] == (
        "as last read back at 03:00:19 UTC: pump 30 %, vent 0 %, state hold"
    )


def test_a_fault_comes_with_time_and_remedy(tmp_path: Path) -> None:
    ended = read_ended_run(write_run(tmp_path, [(18.0, FAULT), (20.0, Ended("safety_trip", 5))]))
    head, seen, remedy, _ = ended.lines()
    assert head.startswith("run ended 2026-01-02 03:00:20 UTC: fault 51 locked")
    assert seen == "seen 03:00:18 UTC: the lock"
    assert remedy == "to do: ask"


def test_without_tables_nothing_is_read_back(tmp_path: Path) -> None:
    folder = write_run(tmp_path, [(20.0, Ended("killed"))])
    for table in folder.glob("*/*"):
        table.unlink()
    ended = read_ended_run(folder)
    assert ended.read_utc is None
    assert not any("read back" in line for line in ended.lines())


def test_the_newest_run_is_found_by_its_name(tmp_path: Path) -> None:
    assert find_newest_run(tmp_path) is None
    assert find_newest_run(tmp_path / "absent") is None
    older = write_run(tmp_path, [])
    newer = write_run(tmp_path, [])
    (tmp_path / "zzz").mkdir()
    assert older != newer
    assert find_newest_run(tmp_path) == newer


def test_the_feed_shows_the_end_and_the_history_before_it(tmp_path: Path) -> None:
    write_run(tmp_path, [(19.0, STOP), (20.0, Ended("done", 0))])
    feed = HoldFeed(Where(logs=tmp_path))
    feed.update_ended_run()
    seen = feed.seen
    assert seen.ended is not None
    assert seen.state_name == "ended"
    assert seen.silent == seen.ended.headline
    assert "stopped by page:anna" in seen.silent
    assert any("Run ended" in line for line in seen.events)
    shown = history(feed, tmp_path, "error_um", 3600.0)
    assert shown.utc_s.size > 5, "weeks later, the last hour is that before the end"
    assert feed.until_s == seen.ended.ended_utc.timestamp()


def test_a_fault_is_the_state_that_is_shown(tmp_path: Path) -> None:
    write_run(
        tmp_path,
        [
            (18.0, StateEntered("fault", "hold", "x")),
            (18.0, FAULT),
            (20.0, Ended("safety_trip", 5)),
        ],
    )
    feed = HoldFeed(Where(logs=tmp_path))
    feed.update_ended_run()
    assert feed.seen.state_name == "fault"
