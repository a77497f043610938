"""A running hold controlled by a calibration: observe, move, settle, take a set. The supervisor
stays in charge.
"""

import math
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from membrane_ctrl.calibration.setpoints import (
    SETTLE_S,
    HeldMirror,
)
from membrane_ctrl.config.schema import LimitsConfig
from membrane_ctrl.controller.commands import Command, Kind
from membrane_ctrl.model import acquisition_events, errors, events, telemetry
from membrane_ctrl.sessions.live_hold import HoldError, HoldLink, News

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

    def observe_hold(self) -> HeldMirror:
        """Observe the held mirror for some seconds and a shape. Raises HoldError, or DeviceError
        without a camera.
        """
        rows: deque[telemetry.TelemetryRow] = deque()
        shape = None
        while shape is None or rows[-1].mono_s - rows[0].mono_s < _LOOK_S:
            news = self._read_news()
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
            pressure_pa=_mean_of_finite([row.gauge_pressure_pa for row in rows]),
            # the mean flow replaces the leak, whose own estimate needs a while of hold
            leak_um_per_s=_mean_of_finite(leaks or [row.i_um_per_s for row in rows]),
            swing_adu=shape.modulation_median_adu,
            shape_on=newest.shape_state != telemetry.ShapeState.OFF,
        )

    def claim_command(self, setpoint_um: float) -> None:
        """Take command without a motion, by repeating the setpoint. Raises HoldError if refused."""
        self._send_command("setpoint", setpoint_um)

    def go_to_setpoint(self, setpoint_um: float, expected_s: float) -> None:
        """Ramp to a setpoint and settle.

        Raises HoldError if the mirror is no longer held or someone else moves it; DeviceError if it
        does not arrive.
        """
        self._send_command("setpoint", setpoint_um)
        patience_s = _LATE[0] * expected_s + _LATE[1]
        there: deque[telemetry.TelemetryRow] = deque()
        begin_s, obeyed = math.nan, False
        while True:
            for row in self._read_news().rows:
                obeyed = obeyed or row.target_um == setpoint_um
                if obeyed and row.target_um != setpoint_um:
                    raise HoldError(f"someone else moved the setpoint to {row.target_um:g} µm")
                begin_s = row.mono_s if math.isnan(begin_s) else begin_s
                ramping = abs(row.setpoint_um - row.trim_um - setpoint_um) > _ARRIVED_UM
                if not obeyed or ramping:
                    there.clear()
                    continue
                there.append(row)
            if (
                there
                and there[-1].mono_s - there[0].mono_s >= SETTLE_S
                and self._are_within_band(there)
            ):
                return
            if self._last_s - begin_s > patience_s:
                raise errors.DeviceError(
                    f"the mirror does not settle at {setpoint_um:g} µm in {patience_s:.0f} "
                    "s; paused, or too tight?"
                )

    def take_set(self) -> acquisition_events.Capture:
        """Request a set; repeat a bad one once.

        Raises HoldError if the hold refuses or the mirror is no longer held; RejectedError if both
        are bad.
        """
        first = self._request_capture()
        event = first if first.set else self._request_capture()
        if not event.set:
            raise errors.RejectedError(
                f"no good set in two attempts: {first.failed}; {event.failed}"
            )
        return event

    def shape_loop(self, on: bool) -> None:
        """Switch the shape loop."""
        self._send_command("shape_on" if on else "shape_off")

    def _request_capture(self) -> acquisition_events.Capture:
        self._send_command("capture")
        begin_s = self._last_s
        while self._last_s - begin_s < _SET_WITHIN_S:
            told = [
                event
                for event in self._read_news().events
                if isinstance(event, acquisition_events.Capture)
            ]
            if told:
                return told[-1]
        return acquisition_events.Capture(failed=f"no set within {_SET_WITHIN_S:.0f} s")

    def _are_within_band(self, rows: deque[telemetry.TelemetryRow]) -> bool:
        last = [row.error_um for row in rows if rows[-1].mono_s - row.mono_s <= _MEAN_S]
        return abs(_mean_of_finite(last)) < self._limits.band_um

    def _send_command(self, kind: Kind, value: float = math.nan) -> None:
        self._link.send_command(Command(kind, "calibration", WHY, value=value))

    def _read_news(self) -> News:
        """New ticks, events and shapes. Raises HoldError if the mirror is no longer held."""
        news = self._link.read_news()
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


def _mean_of_finite(values: list[float]) -> float:
    finite = [value for value in values if math.isfinite(value)]
    return sum(finite) / len(finite) if finite else math.nan
