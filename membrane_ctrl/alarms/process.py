"""The process that tells people: mail servers may take a minute, and nothing of the run waits for them."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from types import FrameType
from typing import Any

from membrane_ctrl.alarms.apprise_sender import apprise_senders
from membrane_ctrl.alarms.book import Notice
from membrane_ctrl.alarms.outbox import Outbox, Send
from membrane_ctrl.alarms.watcher import Watcher
from membrane_ctrl.child_report import alive, reporter
from membrane_ctrl.clock import RunClock
from membrane_ctrl.ipc.ring import RingAddress, RingReader
from membrane_ctrl.port_config import AlarmsConfig
from membrane_ctrl.processes import STOP
from membrane_ctrl.tick import Event

_LOOK_S = 0.5
# After the run's end, for the last notices; a longer one would keep a service manager from restarting
_LAST_S = 8.0
_SENDING_S = 300.0  # a list of mail servers, each with a minute of time-out
_TO = ("urls_file", "escalation_urls_file")  # of the configuration, in the order of the senders
_IDLE_S = 15.0  # with nothing to send; who hangs then would not tell anybody anything


@dataclass(frozen=True, slots=True)
class AlarmsSpec:
    """What the process needs to know of the run.

    Attributes
    ----------
    clock : RunClock
        The run's clock.
    telemetry, events : RingAddress
        What to look at.
    config : AlarmsConfig
        Rules, times and files of URLs.
    run : str
        Name of the run folder.
    """

    clock: RunClock
    telemetry: RingAddress
    events: RingAddress
    config: AlarmsConfig
    run: str


def alarms_main(spec: AlarmsSpec, status: Any) -> None:
    """Watch until the run ends, or the control process is gone.

    Target of a `spawn`ed process; `status` is its end of a pipe, for events about what it has sent.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(STOP, _leave)
    parent = multiprocessing.parent_process()  # who started it, even if that is gone by now
    parent_pid = os.getppid() if parent is None else parent.pid
    watch(spec, apprise_senders(spec.config, spec.run), reporter(status), lambda: os.getppid() == parent_pid)


def watch(
    spec: AlarmsSpec, senders: Sequence[Send], report: Callable[[Event], None], parent_lives: Callable[[], bool]
) -> None:
    """The process's loop.

    Parameters
    ----------
    spec : AlarmsSpec
        The run.
    senders : sequence of callable
        Tell people, see `Outbox`: all, and those of the escalation.
    report : callable
        Tells the run's record what was sent, and the control process that this one is alive; never waits.
    parent_lives : callable
        Whether the control process is still there.
    """
    clock = spec.clock
    outboxes = [Outbox(_reporting(send, to, report)) for send, to in zip(senders, _TO, strict=False)]
    watcher = Watcher(spec.config, outboxes, clock.now())
    with closing(RingReader(spec.telemetry)) as telemetry, closing(RingReader(spec.events)) as events:
        while True:
            lives = parent_lives()  # before the rings: who ends puts the last word in first
            report(alive(_SENDING_S))
            watcher.look(telemetry.drain(), events.drain(), clock.now())
            if watcher.ended or not lives:
                break
            report(alive(_IDLE_S))
            time.sleep(_LOOK_S)
        if not watcher.ended:
            watcher.orphaned(clock.now())
    give_up_s = clock.now() + _LAST_S
    while not all(outbox.empty for outbox in outboxes) and clock.now() < give_up_s:
        time.sleep(_LOOK_S)
        for outbox in outboxes:
            outbox.step(clock.now())


def _reporting(send: Send, to: str, report: Callable[[Event], None]) -> Send:
    def sending(notice: Notice) -> bool:
        through = send(notice)
        event = {"kind": "alarm", "alarm": notice.name, "what": notice.kind, "severity": notice.severity}
        report({**event, "text": notice.text, "to": to, "sent": through, "escalated": notice.escalated})
        return through

    return sending


def _leave(number: int, frame: FrameType | None) -> None:
    raise SystemExit(0)
