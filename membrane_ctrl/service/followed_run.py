"""The alarms of one run, as the service sends them: also when its hold vanishes.

Rows and events come from the run's rings. A service that starts during a run reads the events
before from the run's file. The hold keeps a lock on a file of the run while it lives: a run whose
lock is free without an event of its end has lost its control process.
"""

from __future__ import annotations

import json
import time
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

from membrane_ctrl.alarms.addresses import apprise_senders
from membrane_ctrl.alarms.run_alarms import RunAlarms
from membrane_ctrl.alarms.sent_log import SentLog
from membrane_ctrl.config.alarms import AlarmsConfig
from membrane_ctrl.model import event_lines, telemetry
from membrane_ctrl.model.events import EventLine
from membrane_ctrl.model.run_events import ENDS_WITHOUT_CONTROL, Ended
from membrane_ctrl.processes import published_rings, ring
from membrane_ctrl.run_files.event_log import read_events
from membrane_ctrl.service.run_events_reader import RunEventsReader

_LOOKS_WITHOUT_CONTROL = 2  # see `is_control_alive`


class FollowedRun:
    """Follows a run and sends its alarms.

    Parameters
    ----------
    folder : Path
        Of the run.
    alarms : AlarmsConfig
        Its own.

    Raises
    ------
    InputError, DeviceError
        Its alarms cannot be sent from here.
    OSError
        Its files belong to another user.
    """

    def __init__(self, folder: Path, alarms: AlarmsConfig) -> None:
        self.folder = folder
        self._seconds = _RunSeconds(folder)
        senders = apprise_senders(alarms, folder.name)
        self._sent_log = SentLog(folder, "service")
        self._alarms = RunAlarms(alarms, self._sent_log, senders, 0.0, self._seconds.now)
        self._looks_without_control = 0
        self._is_gone = False
        self._rings: dict[str, ring.RingReader] = {}
        with suppress(OSError, ValueError):
            self._rings = published_rings.attach_rings(folder, whole=("events",))
        recorded = [_without_control(each.line) for each in read_events(folder, [])]
        self._events = RunEventsReader(recorded, self._rings.get("events"))

    @property
    def is_done(self) -> bool:
        """Whether the run is over, and all of its alarms are sent."""
        return (self._alarms.has_ended or self._is_gone) and self._alarms.is_done

    def step(self) -> None:
        """Take what is new, and send what is due."""
        self._look_for_control()  # before the rings: it has written its last message first
        # 1. What is new. Only the newest row's time is needed to date the alarms of a run whose
        #    start is known to a second only
        events = [json.dumps(line).encode() for line in self._events.read_new()]
        rows = _drain(self._rings.get("telemetry"))
        if rows:
            self._seconds.note_tick(telemetry.TelemetryRow.unpack(rows[-1]).mono_s)
        # 2. A run that is over has no news, but an alarm may have to be repeated or escalated
        is_over = self._alarms.has_ended or self._is_gone
        if not is_over or events:
            self._alarms.process_news(rows, events)
        else:
            self._alarms.send_due()
        # 3. No control process and no event of its end, twice in a row: it was killed
        if self._looks_without_control < _LOOKS_WITHOUT_CONTROL or self._alarms.has_ended:
            return
        if not self._is_gone:
            self._is_gone = True
            self._alarms.report_orphan()

    def close(self) -> None:
        """Stop following; the hold's own process may send."""
        for reader in self._rings.values():
            reader.close()
        self._sent_log.close()

    def _look_for_control(self) -> None:
        is_alive = False
        with suppress(OSError):
            is_alive = published_rings.is_control_alive(self.folder)
        self._looks_without_control = 0 if is_alive else self._looks_without_control + 1


class _RunSeconds:
    """Seconds of a run that another process has started.

    They follow from the start in the folder's name, to a second, until a tick states them.
    """

    def __init__(self, folder: Path) -> None:
        began_utc = datetime.strptime(folder.name[:16], "%Y%m%dT%H%M%SZ").replace(tzinfo=UTC)
        age_s = (datetime.now(UTC) - began_utc).total_seconds()
        self._origin_s = time.monotonic() - age_s
        self._is_exact = False

    def now(self) -> float:
        """The present second."""
        return time.monotonic() - self._origin_s

    def note_tick(self, mono_s: float) -> None:
        """Note the newest tick's second."""
        if not self._is_exact:
            self._origin_s = time.monotonic() - mono_s
            self._is_exact = True


def _without_control(line: EventLine) -> EventLine:
    """Return an event of the file; nothing for an end that the recorder has written without the
    control process, which is reported as such.
    """
    event = event_lines.from_dict(line)
    is_end = isinstance(event, Ended) and event.exit in ENDS_WITHOUT_CONTROL
    return {} if is_end else line


def _drain(reader: ring.RingReader | None) -> list[bytes]:
    return [] if reader is None else reader.drain()
