"""What the port knows of the run: put together from what every tick decided, and only when somebody asks."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

from membrane_ctrl.names import Rung, ShapeState, State
from membrane_ctrl.recorder_trouble import RecorderTrouble
from membrane_ctrl.telemetry import TelemetryRow
from membrane_ctrl.tick import Event, TickOutputs


class Picture:
    """The newest tick, and what the events since the start leave standing.

    Attributes
    ----------
    row : TelemetryRow or None
        Of the newest tick.
    recorder : RecorderTrouble
        What keeps the run from being recorded.
    """

    def __init__(self) -> None:
        self.row: TelemetryRow | None = None
        self.recorder = RecorderTrouble()
        self._since_s = 0.0
        self._why = self._shape_reason = ""
        self._fault: Event | None = None
        self._maintenance: dict[str, str] = {}
        self._geometry: Event = {}

    def take(self, outputs: TickOutputs) -> None:
        """Remember a tick; this is all the port costs the tick when nobody asks."""
        self.row = outputs.row
        for event in outputs.events:
            self.note(event)
            match event["kind"]:
                case "why":
                    self._why = event["why"]
                case "state":
                    self._since_s, self._why = outputs.row.mono_s, event["why"]
                case "shape":
                    self._shape_reason = event["reason"]
                case "fault":
                    self._fault = event

    def note(self, event: Event) -> None:
        """Remember what stands until it is over: what a person should look at, and which geometry is used."""
        self.recorder.take(event)
        match event["kind"]:
            case "maintenance":
                self._maintenance[event["name"]] = event["message"]
            case "maintenance_over":
                self._maintenance.pop(event["name"], None)
            case "geometry":
                self._geometry = event

    def status(self) -> dict[str, Any]:
        """For people and programs: names for codes, None for what is not there."""
        row = self.row
        if row is None:
            return {"state": "starting", "why": "no tick has run yet"}
        fault = self._fault if row.fault else None
        return {
            "state": State(int(row.state)).name.lower(),
            "state_age_s": round(row.mono_s - self._since_s, 3),
            "why": self._why,
            "fault": {key: fault[key] for key in ("code", "name", "cause", "remedy")} if fault else None,
            "rung": Rung(int(row.rung)).name.lower(),
            "shape": ShapeState(int(row.shape_state)).name.lower(),
            "shape_reason": self._shape_reason,
            "geometry": {key: value for key, value in self._geometry.items() if key != "kind"} or None,
            "maintenance": self._maintenance,
            "recording": dict(self.recorder.standing),
            "row": {key: value if math.isfinite(value) else None for key, value in asdict(row).items()},
        }
