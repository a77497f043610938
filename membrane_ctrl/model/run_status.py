"""The state of a run that follows from its rows and events; it serves all displays and alarms."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from membrane_ctrl.model import acquisition_events, child_events, events, run_events
from membrane_ctrl.model.lock import Lock
from membrane_ctrl.model.notices import (
    SHOWN_WITH_DETAILS,
    Notice,
    NoticeKey,
    Notices,
    Topic,
    apply_changes,
)
from membrane_ctrl.model.reason import WhyCode
from membrane_ctrl.model.telemetry import TelemetryRow


@dataclass(frozen=True, slots=True)
class RunStatus:
    """The newest tick, and the state that follows from all events so far."""

    row: TelemetryRow | None = None  # of the newest tick; None before the first one
    since_s: float = 0.0  # when the run entered its state
    why: str = ""  # the controller's last reason
    why_code: str = ""  # of it, while its state lasts
    fault: events.Fault | None = None  # the standing fault
    last_fault: events.Fault | None = None  # the newest fault
    last_fault_s: float = math.nan  # its time
    faults: int = 0  # so far in the run
    notices: Notices = field(default_factory=dict)
    shape_reason: str = ""  # of the shape loop
    held: events.HeldScalarState | None = None  # None while the centre is held
    acquisition: acquisition_events.AcquisitionState | None = None  # the acquisition's last report
    geometry: acquisition_events.GeometryInUse | None = None  # used by the cycles
    # gains set during the run; None: those of the configuration
    loop: Mapping[str, Any] | None = None
    kept_loop: Mapping[str, Any] | None = None  # what a trial goes back to
    locks: tuple[Lock, ...] = ()  # set by people, oldest first
    # by a lock's word: why it is not on the disk
    unstored: Mapping[str, str] = field(default_factory=dict)
    latched: str = ""  # a fault of an earlier run that waits for `ack`
    trial_ends_s: float = math.nan  # when gains on trial are reverted; NaN: none are
    ended: bool = False

    @property
    def paused(self) -> bool:
        """Whether a person paused the loop."""
        return self.why_code == WhyCode.PAUSED

    @property
    def trial_left_s(self) -> float:
        """How long gains on trial may still be kept; NaN if none are."""
        if not self.row:
            return math.nan
        return self.trial_ends_s - self.row.mono_s

    @property
    def other_notices(self) -> tuple[Notice, ...]:
        """Notices of which this status has no more than their text: those on neither faults nor
        locks.
        """
        return tuple(
            notice for key, notice in self.notices.items() if key.topic not in SHOWN_WITH_DETAILS
        )

    @property
    def recording_problems(self) -> tuple[str, ...]:
        """What fails in the recording, a sentence each."""
        return tuple(
            notice.short_text for key, notice in self.notices.items() if _concerns_recording(key)
        )

    def after_row(self, row: TelemetryRow) -> "RunStatus":
        """The status after a tick."""
        same = self.row is not None and row.state == self.row.state
        return replace(self, row=row, since_s=self.since_s if same else row.mono_s)

    def after_event(self, event: events.Event, mono_s: float = math.nan) -> "RunStatus":
        """Return the status after an event; most events change nothing.

        Parameters
        ----------
        event : Event
            The event.
        mono_s : float
            Second of the run at which it happened.
        """
        changes = event.notice_changes(self.notices)
        notices = apply_changes(self.notices, changes)
        if notices is self.notices:
            status = self
        else:
            status = replace(self, notices=notices)
        return status._after_details(event, mono_s)

    def _after_details(self, event: events.Event, mono_s: float) -> "RunStatus":
        """What an event changes besides notices."""
        match event:
            case events.Why():
                return replace(self, why=event.why, why_code=event.code)
            case events.StateEntered():
                fault = None if event.from_ == "fault" else self.fault
                return replace(self, why=event.why, why_code="", fault=fault)
            case events.Fault():
                return replace(
                    self, fault=event, last_fault=event, last_fault_s=mono_s, faults=self.faults + 1
                )
            case events.Cleared():
                return replace(self, fault=None)
            case events.ShapeLoopState():
                return replace(self, shape_reason=event.reason)
            case events.HeldScalarState():
                return replace(self, held=event)
            case events.CommandTaken(refused=None):
                return self._after_command(event, mono_s)
            case events.LockSet():
                lock = Lock(
                    event.word,
                    event.text,
                    event.author,
                    event.account,
                    event.session,
                    event.set_utc,
                )
                return replace(self, locks=(*self.locks, lock))
            case events.LockRemoved(word=word):
                kept_locks = tuple(lock for lock in self.locks if lock.word != word)
                return replace(
                    self, locks=kept_locks, unstored=_remove_standing(self.unstored, word)
                )
            case run_events.LockNotStored():
                return replace(self, unstored={**self.unstored, event.word: event.message})
            case run_events.LockStored():
                return replace(self, unstored=_remove_standing(self.unstored, event.word))
            case events.GainsLimited():
                limits = {"kp_per_s": event.kp_per_s, "ti_s": event.ti_s}
                limited = {**(self.loop or {}), **limits}
                return replace(self, loop=limited, kept_loop=limited)
            case events.GainsReverted():
                return replace(self, loop=self.kept_loop, trial_ends_s=math.nan)
            case acquisition_events.GeometryInUse():
                return replace(self, geometry=event)
            case acquisition_events.AcquisitionState():
                return replace(self, acquisition=event)
            case run_events.Ended():
                return replace(self, ended=True)
        return self

    def _after_command(self, taken: events.CommandTaken, mono_s: float) -> "RunStatus":
        match taken:
            case events.CommandTaken(command="gains", loop=dict() as new, value=trial_s):
                # the pump's curve stays when gains change
                loop: dict[str, Any] = {**(self.loop or {}), **new}
                kept = self.kept_loop if trial_s is not None else loop
                ends_s = math.nan if trial_s is None else mono_s + trial_s
                return replace(self, loop=loop, kept_loop=kept, trial_ends_s=ends_s)
            case events.CommandTaken(command="keep"):
                return replace(self, kept_loop=self.loop, trial_ends_s=math.nan)
            case events.CommandTaken(command="latched"):
                return replace(self, latched=taken.text or "")
            case events.CommandTaken(command="ack"):
                return replace(self, latched="")
        return self


def gains_words(loop: Mapping[str, Any], trial_left_s: float | None) -> str:
    """Return the gains of the loop for a person, with the time that is left of a trial.

    Parameters
    ----------
    loop : mapping
        With `kp_per_s` in 1/s, `ti_s` and `td_s` in s.
    trial_left_s : float or None
        Until the gains are reverted; None or NaN: they are not on trial.
    """
    on_trial = trial_left_s is not None and math.isfinite(trial_left_s)
    trial = ""
    if on_trial:
        trial = f"; on trial, reverted in {max(trial_left_s or 0.0, 0.0):.0f} s unless kept"
    return f"Kp {loop['kp_per_s']:g} 1/s, Ti {loop['ti_s']:g} s, Td {loop['td_s']:g} s{trial}"


def _concerns_recording(key: NoticeKey) -> bool:
    return key.topic is Topic.RECORDING or key == NoticeKey(Topic.CHILD, child_events.RECORDER)


def _remove_standing(standing: Mapping[str, str], name: str) -> Mapping[str, str]:
    return {key: words for key, words in standing.items() if key != name}
