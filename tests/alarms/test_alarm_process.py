"""The watcher over real rings, the outbox, and Apprise replaced by a
stand-in with its three names.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from multiprocessing import Pipe
from pathlib import Path
from types import ModuleType

import pytest

from membrane_ctrl.alarms.addresses import apprise_senders, read_urls, require_sendable
from membrane_ctrl.alarms.book import AlarmMessage
from membrane_ctrl.alarms.outbox import Outbox
from membrane_ctrl.alarms.process import AlarmsSpec, watch_run
from membrane_ctrl.alarms.watcher import Watcher
from membrane_ctrl.cli import run
from membrane_ctrl.config.alarms import AlarmsConfig
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.errors import DeviceError, InputError
from membrane_ctrl.model.events import Event, EventLine
from membrane_ctrl.model.port_events import AlarmSent
from membrane_ctrl.model.telemetry import FIELDS, ROW_BYTES, TelemetryRow
from membrane_ctrl.processes.event_pipe import make_event_sender
from membrane_ctrl.processes.ring import RingWriter, open_ring

CONFIG = AlarmsConfig(silent_s=5.0)
ROW = TelemetryRow(*(0.0 for _ in FIELDS))
TEST = AlarmMessage("raised", "test", "warning", "text")


class FakeSender:
    """Takes notices, unless the network is down."""

    def __init__(self) -> None:
        self.through: list[AlarmMessage] = []
        self.tried = 0
        self.down = False

    def __call__(self, notice: AlarmMessage) -> bool:
        self.tried += 1
        if not self.down:
            self.through.append(notice)
        return not self.down


def message(**event: object) -> bytes:
    return json.dumps(event).encode()


def sent_notices(sender: FakeSender) -> list[tuple[str, str]]:
    return [(notice.name, notice.kind) for notice in sender.through]


def test_a_fault_that_was_held_for_too_long_is_sent_as_latched() -> None:
    sender = FakeSender()
    watcher = Watcher(CONFIG, [Outbox(sender)], 0.0)
    watcher.process_news(
        [ROW.pack()], [message(kind="fault", name="displacement_missing", latching=False)], 1.0
    )
    watcher.process_news(
        [ROW.pack()], [message(kind="state", state="fault", **{"from": "hold"})], 31.0
    )
    assert [(notice.name, notice.severity) for notice in sender.through] == [
        ("glitch", "warning"),
        ("fault", "critical"),
    ]
    assert sender.through[1].text.startswith("Fault displacement_missing")


def test_the_next_fault_is_sent_however_soon_it_comes_after_an_acknowledgement() -> None:
    sender = FakeSender()
    watcher = Watcher(CONFIG, [Outbox(sender)], 0.0)
    watcher.process_news([ROW.pack()], [message(kind="fault", name="late", latching=True)], 1.0)
    acknowledged = [
        message(kind="command", command="ack"),
        message(kind="state", state="standby", **{"from": "fault"}),
    ]
    watcher.process_news([ROW.pack()], acknowledged, 2.0)
    watcher.process_news(
        [ROW.pack()], [message(kind="fault", name="over_pressure", latching=True)], 10.0
    )
    watcher.process_news([ROW.pack()], [], 10.0 + CONFIG.escalate_after_s)
    assert sent_notices(sender) == [
        ("fault", "raised"),
        ("fault", "raised"),
        ("fault", "escalated"),
    ]
    assert sender.through[-1].text.startswith("Fault over_pressure")


def test_a_fault_is_sent_at_once_and_its_end_too() -> None:
    sender = FakeSender()
    watcher = Watcher(CONFIG, [Outbox(sender)], 0.0)
    watcher.process_news([ROW.pack()], [message(kind="fault", name="late", latching=True)], 1.0)
    watcher.process_news(
        [ROW.pack()], [message(kind="state", state="standby", **{"from": "fault"})], 2.0
    )
    watcher.process_news([ROW.pack()], [], 33.0)
    assert sent_notices(sender) == [("fault", "raised"), ("fault", "cleared")]


def test_a_value_out_of_its_limits() -> None:
    sender = FakeSender()
    watcher = Watcher(CONFIG, [Outbox(sender)], 0.0)
    bad, good = replace(ROW, error_um=-20.0).pack(), ROW.pack()
    for now_s in range(30):
        watcher.process_news([bad], [], float(now_s))
    assert sent_notices(sender) == []
    watcher.process_news([bad], [], 30.0)
    assert sent_notices(sender) == [("out_of_band", "raised")]
    watcher.process_news([good], [], 31.0)
    watcher.process_news([good], [], 61.0)
    assert sent_notices(sender)[1:] == [("out_of_band", "cleared")]


def test_a_loop_that_falls_silent_is_reported_and_a_slow_start_is_not() -> None:
    sender = FakeSender()
    watcher = Watcher(CONFIG, [Outbox(sender)], 0.0)
    watcher.process_news([], [], 30.0)
    watcher.process_news([ROW.pack()], [], 31.0)
    watcher.process_news([], [], 35.9)
    assert sent_notices(sender) == []
    watcher.process_news([], [], 36.0)
    assert sent_notices(sender) == [("silent", "raised")]


def test_an_escalation_is_tried_until_it_is_sent_and_delays_no_other_message() -> None:
    sender, behind = FakeSender(), FakeSender()
    behind.down = True
    watcher = Watcher(CONFIG, [Outbox(sender), Outbox(behind)], 0.0)
    watcher.process_news([ROW.pack()], [message(kind="fault", latching=True)], 0.0)
    late_s = CONFIG.escalate_after_s
    watcher.process_news([ROW.pack()], [], late_s)
    watcher.process_news([ROW.pack()], [message(kind="link", message="lost")], late_s + 1.0)
    watcher.process_news([ROW.pack()], [], late_s + 7.0)
    assert sent_notices(sender) == [("fault", "raised"), ("fault", "escalated"), ("link", "raised")]
    assert sent_notices(behind) == []
    behind.down = False
    watcher.process_news([ROW.pack()], [], late_s + 11.0)
    assert sent_notices(behind) == [("fault", "escalated")]


@pytest.mark.parametrize(
    "event", [{"kind": "alarms_acknowledged"}, {"kind": "command", "command": "ack"}]
)
def test_an_acknowledgement_keeps_the_others_asleep(event: EventLine) -> None:
    sender = FakeSender()
    watcher = Watcher(CONFIG, [Outbox(sender)], 0.0)
    watcher.process_news([ROW.pack()], [message(kind="fault", latching=True)], 0.0)
    watcher.process_news([ROW.pack()], [message(**event)], 1.0)
    watcher.process_news([ROW.pack()], [], 10_000.0)
    assert sent_notices(sender) == [("fault", "raised")]


def test_a_network_that_is_down_is_tried_later_and_later_in_order() -> None:
    sender = FakeSender()
    sender.down = True
    outbox = Outbox(sender)
    for number in range(60):
        outbox.queue_message(replace(TEST, name=str(number)))
    assert outbox.dropped == 10
    for now_s in range(100):
        outbox.step(float(now_s))
    assert sender.tried == 4, "at 0, 10, 30 and 70 s"
    assert outbox.failures
    sender.down = False
    outbox.step(150.0)
    assert [notice.name for notice in sender.through] == [str(n) for n in range(10, 60)]
    assert outbox.is_empty
    assert not outbox.failures


def spec(telemetry: object, events: object, folder: Path) -> AlarmsSpec:
    return AlarmsSpec(RunClock.start(), telemetry, events, CONFIG, folder)  # type: ignore[arg-type]


def test_the_process_ends_with_the_run_and_sends_why_it_ended(tmp_path: Path) -> None:
    sender, reports = FakeSender(), list[Event]()
    with open_ring(16, ROW_BYTES) as telemetry, open_ring(16, 4096) as events:
        writer = RingWriter(events)
        writer.put(message(kind="end", exit="safety_trip"))
        watch_run(spec(telemetry, events, tmp_path), [sender], reports.append, lambda: True)
        writer.close()
    assert sent_notices(sender) == [("run_ended", "raised")]
    assert [(r.alarm, r.sent) for r in reports if isinstance(r, AlarmSent)] == [("run_ended", True)]


def test_a_control_process_that_vanishes_is_reported(tmp_path: Path) -> None:
    sender = FakeSender()

    theirs, ours = Pipe()
    theirs.close()
    with open_ring(16, ROW_BYTES) as telemetry, open_ring(16, 4096) as events:
        watch_run(
            spec(telemetry, events, tmp_path), [sender], make_event_sender(ours), lambda: False
        )
    assert sent_notices(sender) == [("control_gone", "raised")]


class Target:
    """A target that Apprise makes of an URL."""

    sent: list[tuple[str, str, str, str]] = []  # noqa: RUF012  one list for all, as the test looks at it

    def __init__(self, url: str) -> None:
        self.url = url

    def notify(self, title: str, body: str, notify_type: str) -> bool:
        if "broken" in self.url:
            raise RuntimeError("plug-in")
        self.sent.append((self.url, title, body, notify_type))
        return "refusing" not in self.url


@pytest.fixture
def apprise(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[tuple[str, str, str, str]]]:
    class Apprise:
        @staticmethod
        def instantiate(url: str) -> Target | None:
            return Target(url) if "://" in url else None

    module = ModuleType("apprise")
    module.Apprise = Apprise  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "apprise", module)
    Target.sent.clear()
    yield Target.sent
    Target.sent.clear()


def urls(folder: Path, *lines: str, name: str = "urls.txt") -> str:
    path = folder / name
    path.write_text("\n".join(lines) + "\n")
    return str(path)


def test_each_list_receives_its_alarms(
    tmp_path: Path, apprise: list[tuple[str, str, str, str]]
) -> None:
    first = urls(tmp_path, "# people", "", "mail://ann", "broken://x")
    more = urls(tmp_path, "chat://all", name="more.txt")
    send, escalate = apprise_senders(
        AlarmsConfig(urls_file=first, escalation_urls_file=more), "the-run"
    )
    assert send(TEST), "one of two is enough"
    assert apprise == [
        ("mail://ann", "membrane-ctrl warning raised: test", "text\nrun: the-run", "warning")
    ]
    assert escalate(replace(TEST, kind="escalated", escalated=True))
    assert [sent[0] for sent in apprise[1:]] == ["chat://all"]
    assert apprise[-1][3] == "failure"


def test_files_of_urls_that_are_none(
    tmp_path: Path, apprise: list[tuple[str, str, str, str]]
) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_urls(tmp_path / "none")
    with pytest.raises(InputError, match="no URL found"):
        read_urls(Path(urls(tmp_path, "# nothing")))
    secret = urls(tmp_path, "mail://ok", "password-and-no-scheme")
    with pytest.raises(InputError, match="URL 2: Apprise does not support it") as refused:
        apprise_senders(AlarmsConfig(urls_file=secret), "run")
    assert "password" not in str(refused.value)


def test_without_apprise_a_run_does_not_begin(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    require_sendable(AlarmsConfig())
    with pytest.raises(DeviceError, match=r"pip install 'membrane-ctrl\[alarms\]'"):
        require_sendable(AlarmsConfig(urls_file=urls(tmp_path, "mail://ann")))


def test_alarm_test(
    tmp_path: Path, apprise: list[tuple[str, str, str, str]], capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "lab.toml"
    config.write_text(f'[alarms]\nurls_file = "{urls(tmp_path, "mail://ann")}"\n')
    assert run(["alarm", "test", "--config", str(config), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"sent": True}
    assert "this is only a test" in apprise[0][2]
    assert run(["alarm", "test", "--config", str(config), "--escalated"]) == 2
    assert "escalation_urls_file: missing" in capsys.readouterr().err
    config.write_text(
        config.read_text()
        + f'escalation_urls_file = "{urls(tmp_path, "refusing://x", name="more.txt")}"\n'
    )
    assert run(["alarm", "test", "--config", str(config), "--escalated"]) == 4
    assert "more.txt: no service accepted the message" in capsys.readouterr().err
    urls(tmp_path, "refusing://ann")
    assert run(["alarm", "test", "--config", str(config)]) == 4
    assert run(["alarm", "test"]) == 2
    assert "urls_file: missing" in capsys.readouterr().err
