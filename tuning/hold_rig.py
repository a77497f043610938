"""A running hold under the tuner's hand: the supervisor stays in charge, its ticks are the record.

Records that follow each other have no gap: each begins with the tick after the last one taken, so that what a
session did in between (a fit takes a second) is in the next record and not lost.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence

import numpy as np

from membrane_ctrl.commands import Command
from membrane_ctrl.config import LoopConfig
from membrane_ctrl.control.experiments.machine import Around, Finished
from membrane_ctrl.control.experiments.measurement import Measurement
from membrane_ctrl.control.experiments.spec import ExperimentSpec
from membrane_ctrl.estimate import ShapeEstimate
from membrane_ctrl.names import State
from membrane_ctrl.telemetry import TelemetryRow
from membrane_ctrl.tick import Event
from tuning.hold_link import HoldError, HoldLink
from tuning.records import Record, Series
from tuning.rig import around_of

Progress = Callable[[float], None]  # seconds of the hold that have been recorded since the last call
_HELD = frozenset({State.HOLD, State.TUNE})
_ANSWER_TICKS = 500  # until the state changes after a command was obeyed: 10 s at 50 Hz


class HoldRig:
    """Holds, experiments and gains on a hold that somebody else runs.

    Parameters
    ----------
    link : HoldLink
    who : str
        Recorded with every command.
    progress : callable

    Attributes
    ----------
    loop : LoopConfig
        Gains as they were last set.
    shapes : list of ShapeEstimate
        All that came so far.
    """

    def __init__(self, link: HoldLink, who: str, progress: Progress = lambda seconds: None) -> None:
        self._link, self._who, self._progress = link, who, progress
        self._rows: deque[TelemetryRow] = deque()
        self._events: deque[Event] = deque()
        self.loop = link.config.loop
        self.dt_s = 1 / self.loop.rate_hz
        self.shapes: list[ShapeEstimate] = []

    def hold(self, duration_s: float) -> Record:
        """The next seconds of hold. Raises HoldError if the mirror is not held throughout."""
        return self.record([self._next_held() for _ in range(round(duration_s / self.dt_s))])

    def hold_about(self, duration_s: float) -> tuple[Record, Series]:
        """As `hold`, with the setpoint of each sample in um: the outer loop moves it, and the mirror with it."""
        rows = [self._next_held() for _ in range(round(duration_s / self.dt_s))]
        record = self.record(rows)
        ticks = np.array([row.tick + row.missed_ticks for row in rows])
        setpoints = np.interp(ticks[0] + np.arange(len(record)), ticks, [row.setpoint_um for row in rows])
        return record, setpoints

    def around(self, held: Record, limit_um: float = 10.0) -> Around:
        """The frame of an experiment, from a hold before it."""
        return around_of(held, self.loop, self._link.config.pump, limit_um)

    def perform(self, spec: ExperimentSpec) -> tuple[Record, Finished]:
        """Let the controller run an experiment; the record ends with the tick that gave the mirror back.

        Raises HoldError if it is refused, or ends in another state than hold.
        """
        return self.performed(spec)[:2]

    def performed(self, spec: ExperimentSpec) -> tuple[Record, Finished, Event]:
        """As `perform`, with the event that tells its end (and the pump map's figures)."""
        self._events.clear()
        self._link.ask(Command("tune", self._who, f"tuning session: {spec.kind}", experiment=spec))
        rows: list[TelemetryRow] = []
        begun = False
        while not begun or rows[-1].state == State.TUNE:
            rows.append(self._next_held())
            begun = begun or rows[-1].state == State.TUNE
            if not begun and len(rows) > _ANSWER_TICKS:
                raise HoldError("the hold took the experiment and did not begin it")
        told = self._event("experiment")
        return self.record(rows), Finished(bool(told["completed"]), str(told["reason"])), told

    def set_gains(self, loop: LoopConfig, why: str = "tuning session", trial_s: float = math.nan) -> None:
        """Bumpless. On trial for a time, the hold goes back by itself without `keep`."""
        self._link.ask(Command("gains", self._who, why, value=trial_s, loop=loop))
        self.loop = loop

    def keep(self) -> None:
        """The gains on trial are good."""
        self._link.ask(Command("keep", self._who, "verified"))

    def setpoint(self, setpoint_um: float, why: str) -> None:
        """Move the setpoint."""
        self._link.ask(Command("setpoint", self._who, why, value=setpoint_um))

    def shape_loop(self, on: bool, why: str) -> None:
        """Switch the outer loop."""
        self._link.ask(Command("shape_on" if on else "shape_off", self._who, why))

    def go_back(self, loop: LoopConfig) -> None:
        """End an experiment that may be running, and set the last good gains."""
        self._take()
        if self._rows and self._rows[-1].state == State.TUNE:
            self._link.ask(Command("hold", self._who, "tuning session interrupted"))
        if loop != self.loop:
            self.set_gains(loop, "back to the last good gains")

    def record(self, rows: Sequence[TelemetryRow]) -> Record:
        """Ticks as an even record; one that was skipped has no reading and the flow before it."""
        flows: list[float] = []
        samples: list[Measurement] = []
        flow = next((row.flow_um_per_s for row in rows if math.isfinite(row.flow_um_per_s)), 0.0)
        tick = rows[0].tick + rows[0].missed_ticks if rows else 0.0
        for row in rows:
            place = row.tick + row.missed_ticks
            gap = max(0, round(place - tick))
            flows += [flow] * gap
            samples += [Measurement(math.nan, row.ambient_pressure_pa, row.air_temperature_c)] * gap
            flow = row.flow_um_per_s if math.isfinite(row.flow_um_per_s) else flow
            flows.append(flow)
            samples.append(Measurement(row.displacement_um, row.ambient_pressure_pa, row.air_temperature_c))
            tick = place + 1
        return Record.from_samples(self.dt_s, flows, samples)

    def _next_held(self) -> TelemetryRow:
        row = self._peek()
        if row.state not in _HELD:
            raise HoldError(
                f"the mirror is not held (state {State(int(row.state)).name.lower()}): {self._why()}; "
                "start or resume the hold, then repeat this step"
            )
        self._progress(self.dt_s)
        return self._rows.popleft()

    def _peek(self) -> TelemetryRow:
        while not self._rows:
            self._take()
        return self._rows[0]

    def _take(self) -> None:
        news = self._link.news()
        self._rows.extend(news.rows)
        self._events.extend(news.events)
        self.shapes += news.shapes

    def _event(self, kind: str) -> Event:
        """The newest event of a kind; it may come a moment after its tick."""
        for _ in range(20):
            found = [event for event in self._events if event["kind"] == kind]
            if found:
                return found[-1]
            self._take()
        raise HoldError(f"the hold did not tell of the end of the {kind}")

    def _why(self) -> str:
        said = [str(e["why"]) for e in self._events if e["kind"] == "state"]
        return said[-1] if said else "no reason was told"
