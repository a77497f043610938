"""The state of a run, assembled from its ticks and events, for all displays and notices."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from membrane_ctrl.model import events, run_events, telemetry

_GONE = "no recorder runs"
_LONGEST = 300  # characters of one failure in the status; the event has the full text


@dataclass(frozen=True, slots=True)
class RunStatus:
    """The newest tick, and the state that follows from all events so far."""

    row: telemetry.TelemetryRow | None = None  # of the newest tick; None before the first one
    since_s: float = 0.0  # when the run entered its state
    why: str = ""  # the controller's last reason
    fault: events.Fault | None = None  # the standing fault
    last_fault: events.Fault | None = None  # the newest fault
    last_fault_s: float = math.nan  # its time
    faults: int = 0  # so far in the run
    shape_reason: str = ""  # of the shape loop
    acquisition: run_events.AcquisitionState | None = None  # the acquisition's last report
    geometry: run_events.GeometryInForce | None = None  # used by the cycles
    maintenance: Mapping[str, str] = field(default_factory=dict)  # active maintenance notices, by name
    # failures of the recording, by subject. A full disk may prevent `events.jsonl` from reporting itself
    recording: Mapping[str, str] = field(default_factory=dict)
    loop: Mapping[str, Any] | None = None  # gains set during the run; None: those of the configuration
    kept_loop: Mapping[str, Any] | None = None  # what a trial goes back to
    trial_ends_s: float = math.nan  # when gains on trial are reverted; NaN: none are
    ended: bool = False

    @property
    def trial_left_s(self) -> float:
        """How long gains on trial may still be kept; NaN if none are."""
        return self.trial_ends_s - self.row.mono_s if self.row else math.nan

    @property
    def recording_words(self) -> str:
        """All failures of the recording in one line; empty if there are none."""
        return "; ".join(self.recording.values())

    def after_row(self, row: telemetry.TelemetryRow) -> RunStatus:
        """The status after a tick."""
        same = self.row is not None and row.state == self.row.state
        return replace(self, row=row, since_s=self.since_s if same else row.mono_s)

    def after_event(self, event: events.Event, mono_s: float = math.nan) -> RunStatus:
        """The status after an event; most change nothing."""
        match event:
            case events.Why():
                return replace(self, why=event.why)
            case events.StateEntered():
                return replace(self, why=event.why, fault=None if event.from_ == "fault" else self.fault)
            case events.Fault():
                return replace(self, fault=event, last_fault=event, last_fault_s=mono_s, faults=self.faults + 1)
            case events.Cleared():
                return replace(self, fault=None)
            case events.ShapeLoopState():
                return replace(self, shape_reason=event.reason)
            case events.CommandTaken(command="gains", refused=None, loop=loop, value=trial_s):
                kept = self.kept_loop if trial_s is not None else loop
                ends_s = math.nan if trial_s is None else mono_s + trial_s
                return replace(self, loop=loop, kept_loop=kept, trial_ends_s=ends_s)
            case events.CommandTaken(command="keep", refused=None):
                return replace(self, kept_loop=self.loop, trial_ends_s=math.nan)
            case events.GainsReverted():
                return replace(self, loop=self.kept_loop, trial_ends_s=math.nan)
            case events.Maintenance():
                return replace(self, maintenance={**self.maintenance, event.name: event.message})
            case events.MaintenanceOver():
                return replace(self, maintenance=_without(self.maintenance, event.name))
            case run_events.GeometryInForce():
                return replace(self, geometry=event)
            case run_events.AcquisitionState():
                return replace(self, acquisition=event)
            case run_events.Ended():
                return replace(self, ended=True)
        return replace(self, recording=_recording(self.recording, event))


def gains_words(loop: Mapping[str, Any], trial_left_s: float | None) -> str:
    """Gains for a person, with the countdown of a trial."""
    on_trial = trial_left_s is not None and math.isfinite(trial_left_s)
    trial = f"; on trial, reverted in {max(trial_left_s or 0.0, 0.0):.0f} s unless kept" if on_trial else ""
    return f"Kp {loop['kp_per_s']:g} 1/s, Ti {loop['ti_s']:g} s, Td {loop['td_s']:g} s{trial}"


def _recording(standing: Mapping[str, str], event: events.Event) -> Mapping[str, str]:
    match event:
        case run_events.RecorderError() | run_events.DiskLow():
            return {**standing, event.what: " ".join(event.message.split())[:_LONGEST]}
        case run_events.RecorderRecovered():
            return _without(standing, event.what)
        case run_events.ChildEnded(child="recorder") | run_events.ChildGivenUp(child="recorder"):
            return {**standing, "recorder": _GONE}
        case run_events.ChildRestarted(child="recorder"):
            return {}  # the next recorder reports remaining failures
    return standing


def _without(standing: Mapping[str, str], name: str) -> Mapping[str, str]:
    return {key: words for key, words in standing.items() if key != name}
