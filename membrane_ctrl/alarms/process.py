"""The alarm process of a hold: mail servers may take a minute, and the run does not wait for them.

The service sends the alarms of the holds that it follows, also when a hold vanishes. This process
follows its own hold, and sends the alarms if no service has done so for half a minute.
"""

import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from membrane_ctrl.alarms.addresses import apprise_senders
from membrane_ctrl.alarms.memory_limit import limited_memory
from membrane_ctrl.alarms.outbox import Send
from membrane_ctrl.alarms.run_alarms import RunAlarms
from membrane_ctrl.alarms.sent_log import SentLog
from membrane_ctrl.config.alarms import AlarmsConfig
from membrane_ctrl.model import child_events, port_events
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.events import Event
from membrane_ctrl.processes import child, event_pipe, ring

WITHOUT_SERVICE_S = 30.0  # a service that restarts takes less
_LOOK_S = 0.5
# After the run's end, for the last messages; longer would delay a service manager's restart
_LAST_S = 8.0
_SENDING_S = 300.0  # a list of mail servers, each with a minute of time-out
_IDLE_S = 15.0  # with nothing to send; a process that hangs then could not send an alarm


@dataclass(frozen=True, slots=True)
class AlarmsSpec:
    """What the process needs of the run."""

    clock: RunClock
    telemetry: ring.RingAddress
    events: ring.RingAddress
    config: AlarmsConfig  # rules, times and files of URLs
    run_dir: Path


def alarms_main(spec: AlarmsSpec, status: Any) -> None:
    """Watch until the run ends or the control process has gone: target of a `spawn`ed process.

    Parameters
    ----------
    spec : AlarmsSpec
        Rings of the run, and its configuration.
    status : Connection
        Its end of a pipe, for events about sent messages.
    """
    child.leave_at_stop()
    senders = apprise_senders(spec.config, spec.run_dir.name)
    with limited_memory():
        watch_run(spec, senders, event_pipe.make_event_sender(status), child.parent_lives)


def watch_run(
    spec: AlarmsSpec,
    senders: Sequence[Send],
    report: Callable[[Event], None],
    parent_lives: Callable[[], bool],
) -> None:
    """Run the process's loop.

    Parameters
    ----------
    spec : AlarmsSpec
        Clock, rings, configuration and folder of the run.
    senders : sequence of Send
        The one for all messages, and the one for escalated ones.
    report : callable
        Gets events about sent messages.
    parent_lives : callable
        Whether the control process is still there.
    """
    clock = spec.clock
    with (
        closing(SentLog(spec.run_dir, "hold")) as sent_log,
        closing(ring.RingReader(spec.telemetry)) as telemetry,
        closing(ring.RingReader(spec.events)) as events,
    ):
        # The service sends; this process does so only without one
        alarms = RunAlarms(spec.config, sent_log, senders, WITHOUT_SERVICE_S, clock.now)
        while True:
            # before the rings are read: a dying parent has written its last message first
            lives = parent_lives()
            report(child_events.Alive(_SENDING_S))
            alarms.process_news(telemetry.drain(), events.drain())
            _report_attempts(sent_log, report)
            if alarms.has_ended or not lives:
                break
            report(child_events.Alive(_IDLE_S))
            time.sleep(_LOOK_S)
        # The run has ended, or its process has died: report that, then send what is due
        alarms.end_patience()
        if not alarms.has_ended:
            alarms.report_orphan()
        # A network that does not answer must not keep the process for ever
        give_up_s = clock.now() + _LAST_S
        alarms.send_due()
        while not alarms.is_done and clock.now() < give_up_s:
            time.sleep(_LOOK_S)
            alarms.send_due()
        _report_attempts(sent_log, report)


def _report_attempts(sent_log: SentLog, report: Callable[[Event], None]) -> None:
    """Report the messages that any process has sent, for the run's events."""
    for line in sent_log.take_attempts():
        report(
            port_events.AlarmSent(
                alarm=str(line.get("name")),
                what=str(line.get("kind")),
                severity=str(line.get("severity")),
                text=str(line.get("text")),
                to=str(line.get("to")),
                sent=line.get("sent") is True,
                escalated=line.get("escalated") is True,
            )
        )
