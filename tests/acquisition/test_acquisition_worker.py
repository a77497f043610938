"""Deadlines, commands and reports of the acquisition loop."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path

import pytest
from acquisition_fakes import VirtualClock, estimate

from membrane_ctrl.acquisition.cycle import CycleDone, CycleFailed
from membrane_ctrl.acquisition.cycle_loop import keep_cycling, next_deadline_s
from membrane_ctrl.acquisition.remote import CaptureRequest, Remote
from membrane_ctrl.model.events import Event
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.processes import child


class ScriptedRemote(Remote):
    """Waits on the virtual clock and gets its commands at given moments."""

    def __init__(self, clock: VirtualClock, script: dict[float, str]) -> None:
        self.clock = clock
        self.script = sorted(script.items())
        self.reports: list[tuple[str, str]] = []
        self.stop = self.paused = self._full = False
        self._capture = None
        self.events: list[dict[str, object]] = []

    def take_commands(self, timeout_s: float = 0.0) -> None:
        assert self.script, "nothing more will happen"
        moment_s, command = self.script[0]
        if self.clock.now_s + timeout_s < moment_s:
            self.clock.now_s += timeout_s
            return
        self.clock.now_s = max(self.clock.now_s, moment_s)
        self.script.pop(0)
        self._execute_command(command)

    def report_state(self, state: str, message: str = "", **details: object) -> None:
        self.reports.append((state, message))

    def send_event(self, event: Event) -> None:
        self.events.append(event.to_dict())


class ScriptedCycle:
    """Takes `duration_s` a cycle and returns the given results, then good ones."""

    def __init__(self, clock: VirtualClock, duration_s: float = 0.5) -> None:
        self.clock = clock
        self.duration_s = duration_s
        self.started_s: list[float] = []
        self.results: list[CycleDone | CycleFailed | None] = []
        self.full_wanted_at_s: list[float] = []
        self.prepared_s: list[float] = []
        self.prepares_s: list[float] = []

    def prepare_next(self) -> None:
        self.prepared_s.append(self.clock.now_s)
        self.clock.sleep(self.prepares_s.pop(0) if self.prepares_s else 0.0)

    def run_cycle(self) -> CycleDone | CycleFailed | None:
        self.started_s.append(self.clock.now_s)
        self.clock.sleep(self.duration_s)
        return (
            self.results.pop(0)
            if self.results
            else CycleDone(estimate(cycle=len(self.started_s)), 0.0)
        )

    def want_full(self) -> None:
        self.full_wanted_at_s.append(self.clock.now_s)


class Loop:
    def __init__(self, script: dict[float, str], duration_s: float = 0.5) -> None:
        self.clock = VirtualClock()
        self.remote = ScriptedRemote(self.clock, script)
        self.cycle = ScriptedCycle(self.clock, duration_s)
        self.published: list[ShapeEstimate] = []
        self.turned_deg: list[float | None] = []
        self.disk_full = False

    def run(self) -> None:
        keep_cycling(
            self.cycle, self.remote, self.published.append, self.clock, lambda: 2.0, self.keep
        )  # type: ignore[arg-type]

    def keep(self, estimate: ShapeEstimate, request: CaptureRequest) -> Path:
        self.turned_deg.append(request.turned_deg)
        if self.disk_full:
            raise OSError(28, "No space left on device")
        return Path("raw") / f"cycle-{estimate.cycle}"


def test_cycles_start_on_absolute_deadlines() -> None:
    loop = Loop({9.0: "stop"})
    loop.run()
    assert loop.cycle.started_s == [0, 2, 4, 6, 8]
    assert len(loop.published) == 5


def test_slow_cycle_skips_deadlines_and_makes_none_up() -> None:
    loop = Loop({9.0: "stop"}, duration_s=2.5)
    loop.run()
    assert loop.cycle.started_s == [0, 4, 8]


def test_the_next_cycle_is_prepared_once_the_figure_is_out_and_starts_late_at_worst() -> None:
    loop = Loop({7.0: "stop"})
    loop.cycle.prepares_s = [0.0, 1.8]
    loop.run()
    assert loop.cycle.started_s == [0, 2, 4.3, 6]
    assert loop.cycle.prepared_s == [
        0.5,
        2.5,
        4.8,
        6.5,
    ]  # half a second after the start: the figure is out


def test_pause_and_resume() -> None:
    loop = Loop({1.0: "pause", 7.3: "resume", 8.0: "stop"})
    loop.run()
    assert loop.cycle.started_s == [0, 7.3]
    assert ("paused", "until the command to resume") in loop.remote.reports


def test_full_on_request_goes_to_the_next_cycle() -> None:
    loop = Loop({1.0: "full", 5.0: "stop"})
    loop.run()
    assert loop.cycle.full_wanted_at_s == [2]


def test_a_set_on_request_is_a_full_cycle_that_is_kept_and_named() -> None:
    loop = Loop({1.0: "capture", 5.0: "stop"})
    loop.run()
    assert loop.cycle.full_wanted_at_s == [2]
    assert loop.remote.events == [
        {
            "kind": "capture",
            "cycle": 2,
            "set": "raw/cycle-2",
            "displacement_um": 0.0,
            "verdict": "ok",
            "reason": "",
        }
    ]


def test_a_set_of_a_turned_mirror_is_kept_with_its_angle() -> None:
    loop = Loop({1.0: "capture -120.5", 3.0: "capture", 7.0: "stop"})
    loop.run()
    assert loop.turned_deg == [-120.5, None]


@pytest.mark.parametrize(
    ("result", "failed"),
    [
        (None, "the cycle was stopped"),
        (CycleFailed(7, "camera", "LinkError: no trigger", 1.0), "camera: LinkError: no trigger"),
        (
            CycleDone(estimate("full", verdict="rejected", reason="no mirror"), 0.0),
            "rejected: no mirror",
        ),
        (CycleDone(estimate("full"), 0.0), "No space left on device"),
    ],
)
def test_a_set_that_cannot_be_taken_gives_the_reason(
    result: CycleDone | CycleFailed | None, failed: str
) -> None:
    loop = Loop({1.0: "capture", 3.0: "stop"})
    loop.cycle.results, loop.disk_full = [CycleDone(estimate(), 0.0), result], True
    loop.run()
    assert [event["failed"] for event in loop.remote.events] == [failed]


def test_failure_is_reported_and_waits_out_its_pause() -> None:
    loop = Loop({9.0: "stop"})
    loop.cycle.results = [CycleFailed(1, "camera", "LinkError: no trigger", 4.0)]
    loop.run()
    assert loop.cycle.started_s == [0, 6, 8]
    assert loop.remote.reports[0] == ("retrying", "camera: LinkError: no trigger; again in 4 s")


def test_rejected_estimate_is_published_and_reported_with_its_reason() -> None:
    loop = Loop({1.0: "stop"})
    loop.cycle.results = [CycleDone(estimate("full", verdict="rejected", reason="no mirror"), 1.0)]
    loop.run()
    assert [e.verdict for e in loop.published] == ["rejected"]
    assert loop.remote.reports == [("running", "rejected: no mirror; next in 1 s")]


def test_interrupted_cycle_publishes_nothing() -> None:
    loop = Loop({1.0: "stop"})
    loop.cycle.results = [None]
    loop.run()
    assert loop.published == []
    assert loop.remote.reports == []


@pytest.mark.parametrize(
    ("now_s", "due_s"), [(10.0, 12.0), (11.9, 12.0), (12.0, 12.0), (12.1, 14.0), (1e6 + 1, 1e6 + 2)]
)
def test_next_deadline(now_s: float, due_s: float) -> None:
    assert next_deadline_s(10.0, 2.0, now_s) == due_s


@pytest.fixture
def line() -> Iterator[tuple[Connection, Connection]]:
    ours, theirs = multiprocessing.Pipe()
    yield ours, theirs
    ours.close()
    theirs.close()


def test_commands_over_a_real_connection(line: tuple[Connection, Connection]) -> None:
    ours, theirs = line
    remote = Remote(theirs)
    for command in ("pause", "full"):
        ours.send(command)
    assert remote.is_interrupting()
    assert remote.paused
    assert [remote.take_full(), remote.take_full()] == [True, False]
    ours.send("resume")
    assert not remote.is_interrupting()
    ours.send("stop")
    assert remote.is_interrupting()
    assert remote.stop


def test_unknown_command_is_answered(line: tuple[Connection, Connection]) -> None:
    ours, theirs = line
    ours.send("dance")
    Remote(theirs).take_commands()
    assert ours.recv()["kind"] == "alive"
    assert "unknown command 'dance'" in ours.recv()["message"]


def test_it_promises_its_next_word_sooner_once_it_is_prepared(
    line: tuple[Connection, Connection],
) -> None:
    ours, theirs = line
    remote = Remote(theirs)
    for _ in range(5):
        remote.take_commands()
    remote.start_line_checks()
    words = [ours.recv() for _ in range(2)]
    assert not ours.poll(), "not more than one a second"
    assert [word["kind"] for word in words] == ["alive", "alive"]
    assert words[0]["for_s"] > 10 * words[1]["for_s"]


def test_closed_line_and_dead_parent_stop_the_process(
    line: tuple[Connection, Connection], monkeypatch: pytest.MonkeyPatch
) -> None:
    ours, theirs = line
    with monkeypatch.context() as orphaned:
        orphaned.setattr(child, "parent_lives", lambda: False)
        assert Remote(theirs).is_interrupting()
    assert not Remote(theirs).is_interrupting()
    ours.close()
    assert Remote(theirs).is_interrupting()


def test_reports_never_wait_for_a_reader(line: tuple[Connection, Connection]) -> None:
    ours, theirs = line
    remote = Remote(theirs)
    for number in range(3000):  # far more than the pipe holds
        remote.report_state("running", f"{number:0200}", cycle=1)
    assert not remote.stop
    assert ours.recv() == {
        "kind": "acquisition",
        "state": "running",
        "message": "0" * 200,
        "cycle": 1,
    }


def test_the_same_report_is_sent_once(line: tuple[Connection, Connection]) -> None:
    ours, theirs = line
    remote = Remote(theirs)
    for cycle in (1, 2, 3):
        remote.report_state("running", "ok", cycle=cycle)
    remote.report_state("running", "rejected: dark", cycle=4)
    assert [ours.recv()["cycle"] for _ in range(2)] == [1, 4]
    assert not ours.poll()
