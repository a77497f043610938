"""A running hold controlled by a calibration: observe, move, settle, take a set. The supervisor
stays in charge.
"""

import contextlib
import math
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Protocol

from membrane_ctrl.calibration.session import (
    SETTLE_S,
    CalibrationHead,
    CalibrationSession,
    HeldMirror,
    reach_of,
    step_s,
    way_s,
)
from membrane_ctrl.config.schema import LimitsConfig
from membrane_ctrl.controller.commands import Command, Kind
from membrane_ctrl.model import errors, events, run_events, telemetry
from membrane_ctrl.sessions.live_hold import HoldError, HoldLink, News, Progress

WHY = "calibration of the optics"
_LOOK_S = 10.0  # averaging time for pressure and leak, which are noisy
_SHAPE_WITHIN_S = 90.0  # a rejected cycle pauses up to a minute
_SET_WITHIN_S = 180.0  # likewise, and a slow machine reconstructs for seconds
_ARRIVED_UM = 0.5  # the ramp's end is exponential
_MEAN_S = 5.0  # the mirror must be inside the band for this long
_LATE = 2.0, 300.0  # factor on the planned time, and seconds more: then something else is wrong


class CaptureLink(HoldLink, Protocol):
    """A hold with a readable run folder, where its sets are."""

    @property
    def run_dir(self) -> Path:
        """The run's folder."""
        ...


class Sweep:
    """Moves and observes; every wait has a time-out.

    `progress` gets the elapsed seconds of the hold, and may raise KeyboardInterrupt.
    """

    def __init__(
        self, link: CaptureLink, limits: LimitsConfig, progress: Callable[[float], None]
    ) -> None:
        self._link, self._limits, self._progress = link, limits, progress
        self._last_s = math.nan
        self._why = ""

    def look(self) -> HeldMirror:
        """Observe the held mirror for some seconds and a shape. Raises HoldError, or DeviceError
        without a camera.
        """
        rows: deque[telemetry.TelemetryRow] = deque()
        shape = None
        while shape is None or rows[-1].mono_s - rows[0].mono_s < _LOOK_S:
            news = self._news()
            rows.extend(news.rows)
            shape = next(
                (each for each in reversed(news.shapes) if each.verdict != "rejected"), shape
            )
            if shape is None and rows and rows[-1].mono_s - rows[0].mono_s > _SHAPE_WITHIN_S:
                raise errors.DeviceError(
                    f"{self._link.name}: no shape within {_SHAPE_WITHIN_S:.0f} s; "
                    "does this run have a camera that sees the mirror? (ctl status)"
                )
        newest = rows[-1]
        leaks = [row.leak_um_per_s for row in rows if math.isfinite(row.leak_um_per_s)]
        return HeldMirror(
            setpoint_um=newest.target_um,
            sag_mm=1e-3 * shape.sag_um,
            pressure_pa=_mean([row.gauge_pressure_pa for row in rows]),
            # the mean flow replaces the leak, whose own estimate needs a while of hold
            leak_um_per_s=_mean(leaks or [row.i_um_per_s for row in rows]),
            swing_adu=shape.modulation_median_adu,
            shape_on=newest.shape_state != telemetry.ShapeState.OFF,
        )

    def claim(self, setpoint_um: float) -> None:
        """Take command without a motion, by repeating the setpoint. Raises HoldError if refused."""
        self._ask("setpoint", setpoint_um)

    def go(self, setpoint_um: float, expected_s: float) -> None:
        """Ramp to a setpoint and settle.

        Raises HoldError if the mirror is no longer held or someone else moves it; DeviceError if it
        does not arrive.
        """
        self._ask("setpoint", setpoint_um)
        patience_s = _LATE[0] * expected_s + _LATE[1]
        there: deque[telemetry.TelemetryRow] = deque()
        begin_s, obeyed = math.nan, False
        while True:
            for row in self._news().rows:
                obeyed = obeyed or row.target_um == setpoint_um
                if obeyed and row.target_um != setpoint_um:
                    raise HoldError(f"someone else moved the setpoint to {row.target_um:g} µm")
                begin_s = row.mono_s if math.isnan(begin_s) else begin_s
                ramping = abs(row.setpoint_um - row.trim_um - setpoint_um) > _ARRIVED_UM
                if not obeyed or ramping:
                    there.clear()
                    continue
                there.append(row)
            if there and there[-1].mono_s - there[0].mono_s >= SETTLE_S and self._inside(there):
                return
            if self._last_s - begin_s > patience_s:
                raise errors.DeviceError(
                    f"the mirror does not settle at {setpoint_um:g} µm in {patience_s:.0f} "
                    "s; paused, or too tight?"
                )

    def take(self) -> run_events.Capture:
        """Request a set; repeat a bad one once.

        Raises HoldError if the hold refuses or the mirror is no longer held; RejectedError if both
        are bad.
        """
        first = self._capture()
        event = first if first.set else self._capture()
        if not event.set:
            raise errors.RejectedError(
                f"no good set in two attempts: {first.failed}; {event.failed}"
            )
        return event

    def shape_loop(self, on: bool) -> None:
        """Switch the shape loop."""
        self._ask("shape_on" if on else "shape_off")

    def _capture(self) -> run_events.Capture:
        self._ask("capture")
        begin_s = self._last_s
        while self._last_s - begin_s < _SET_WITHIN_S:
            told = [event for event in self._news().events if isinstance(event, run_events.Capture)]
            if told:
                return told[-1]
        return run_events.Capture(failed=f"no set within {_SET_WITHIN_S:.0f} s")

    def _inside(self, rows: deque[telemetry.TelemetryRow]) -> bool:
        last = [row.error_um for row in rows if rows[-1].mono_s - row.mono_s <= _MEAN_S]
        return abs(_mean(last)) < self._limits.band_um

    def _ask(self, kind: Kind, value: float = math.nan) -> None:
        self._link.ask(Command(kind, "calibration", WHY, value=value))

    def _news(self) -> News:
        """New ticks, events and shapes. Raises HoldError if the mirror is no longer held."""
        news = self._link.news()
        for event in news.events:
            if isinstance(event, events.StateEntered):
                self._why = f" ({event.why})"
        for row in news.rows:
            if row.state != telemetry.State.HOLD:
                name = telemetry.State(int(row.state)).name.lower()
                raise HoldError(
                    f"the mirror is not held, but in state {name}{self._why}; start or "
                    "resume the hold first"
                )
        if news.rows:
            passed_s = news.rows[-1].mono_s - self._last_s
            self._last_s = news.rows[-1].mono_s
            self._progress(passed_s if passed_s > 0 else 0.0)
        return news


def _mean(values: list[float]) -> float:
    finite = [value for value in values if math.isfinite(value)]
    return sum(finite) / len(finite) if finite else math.nan


# The sets of a session, one after the other, on a running hold, and the return, whatever happens.


@dataclass(frozen=True, slots=True)
class Procedure:
    """Moves the mirror for a calibration."""

    link: CaptureLink
    sweep: Sweep  # the hold under control
    held: HeldMirror  # the mirror before the first move
    progress: Progress

    def times_s(self, head: CalibrationHead, missing: tuple[int, ...]) -> list[float]:
        """Duration of each step: the missing sets, and the return."""
        stops = [self.held.setpoint_um, *(head.setpoints_um[k] for k in missing), head.start_um]
        return [step_s(self.held, a, b, self.link.config) for a, b in pairwise(stops)]

    def check(self, head: CalibrationHead) -> None:
        """Raises InputError if the setpoints are out of reach, or the mirror cannot be moved both
        ways.
        """
        held, config = self.held, self.link.config
        low_um, high_um = min(head.setpoints_um), max(head.setpoints_um)
        reach = reach_of(held, config)
        if low_um < reach.low_um or high_um > reach.high_um:
            raise errors.InputError(
                f"the sets from {low_um:g} to {high_um:g} µm are beyond {reach.low_um:.0f} "
                f"to {reach.high_um:.0f}, "
                f"which {reach.low_why} and {reach.high_why} allow"
            )
        if way_s(held, low_um, high_um, config) + way_s(held, high_um, low_um, config) == float(
            "inf"
        ):
            raise errors.InputError(
                f"the mirror loses {held.leak_um_per_s:.2f} µm/s: it cannot be moved both ways; "
                "open the bleed (loop.bleed_fraction), or give the pump more reserve"
            )

    def take(self, session: CalibrationSession) -> None:
        """Take the missing sets and move the mirror back.

        Raises HoldError if the mirror is no longer held or someone else moves it (it is then left
        alone); DeviceError, RejectedError or KeyboardInterrupt after the mirror has moved back.
        """
        with self.progress.catching(), self._coming_back(session):
            self.sweep.shape_loop(False)
            times_s = self.times_s(session.head, session.missing)
            for number, index in enumerate(session.missing):
                self._take(session, index, times_s[number], sum(times_s[number + 1 :]))

    def _take(
        self, session: CalibrationSession, index: int, expected_s: float, after_s: float
    ) -> None:
        setpoint_um = session.head.setpoints_um[index]
        what = f"set {index + 1} of {len(session.sets)} at {setpoint_um:+g} µm"
        self.progress.begin(what, expected_s, after_s)
        self.sweep.go(setpoint_um, expected_s)
        event = self.sweep.take()
        session.keep(index, self.link.run_dir / str(event.set))
        self.progress.say(
            f"{what}: {event.verdict}" + (f" ({event.reason})" if event.reason else "")
        )

    @contextlib.contextmanager
    def _coming_back(self, session: CalibrationSession) -> Iterator[None]:
        say = self.progress.say
        try:
            yield
        except HoldError:
            off = "; the shape loop is off (ctl shape on)" if session.head.shape_on else ""
            say(
                f"the mirror is left to whoever has command{off}; continue with --session "
                f"{session.path}"
            )
            raise
        except BaseException:
            self.progress.interrupted = False
            say(
                f"stopped with {len(session.missing)} sets missing; continue with --session "
                f"{session.path}"
            )
            with contextlib.suppress(HoldError, errors.DeviceError):
                self._come_back(session)
            raise
        self._come_back(session)

    def _come_back(self, session: CalibrationSession) -> None:
        head = session.head
        far_um = max(head.setpoints_um, key=lambda each: abs(each - head.start_um))
        back_s = step_s(self.held, far_um, head.start_um, self.link.config)
        self.progress.begin(f"back to {head.start_um:g} µm (Ctrl-C stops waiting)", back_s, 0.0)
        try:
            self.sweep.go(head.start_um, back_s)
        except KeyboardInterrupt:
            off = "; then switch the shape loop on (ctl shape on)" if head.shape_on else ""
            self.progress.say(f"left: the hold continues its ramp to {head.start_um:g} µm{off}")
            raise
        if head.shape_on:
            self.sweep.shape_loop(True)
