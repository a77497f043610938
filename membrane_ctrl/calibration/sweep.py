"""A running hold controlled by a calibration: observe, move, settle, take a set.

The hold's own supervisor still judges every command, and its safety rules stay in effect.
"""

import math
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from membrane_ctrl.calibration.setpoints import SETTLE_S, HeldMirror
from membrane_ctrl.config.schema import LimitsConfig
from membrane_ctrl.controller.command import Command, Kind
from membrane_ctrl.model import acquisition_events, errors, events, telemetry
from membrane_ctrl.sessions.live_hold import HoldError, HoldLink, News

WHY = "calibration of the optics"
_OBSERVE_S = 10.0  # averaging time for pressure and leak, which are noisy
_SHAPE_WITHIN_S = 90.0  # a rejected cycle pauses up to a minute
_SET_WITHIN_S = 180.0  # the same, and a slow machine reconstructs for seconds
_ARRIVED_UM = 0.5  # the ramp's end is exponential
_MEAN_S = 5.0  # the mirror must be inside the band for this long
# A motion that takes longer than this factor of its planned time, and these seconds more, has
# another fault than a slow pump.
_PATIENCE_FACTOR = 2.0
_PATIENCE_MORE_S = 300.0


class CaptureLink(HoldLink, Protocol):
    """A hold with a readable run folder, where its sets are."""

    @property
    def run_dir(self) -> Path:
        """The run's folder."""
        ...


class Sweep:
    """Moves and observes; every wait has a time-out.

    Parameters
    ----------
    link : CaptureLink
        The hold, and where its sets are.
    limits : LimitsConfig
        Of the hold: its band decides when the mirror has settled.
    progress : callable
        Gets the seconds of hold since its last call, and may raise KeyboardInterrupt.
    """

    def __init__(
        self, link: CaptureLink, limits: LimitsConfig, progress: Callable[[float], None]
    ) -> None:
        self._link = link
        self._limits = limits
        self._progress = progress
        self._last_s = math.nan  # time of the newest tick that was read
        self._why = ""  # of the newest change of state, in brackets

    def observe_hold(self) -> HeldMirror:
        """Observe the held mirror for some seconds, until a figure has come too.

        Raises
        ------
        HoldError
            If the mirror is no longer held.
        DeviceError
            If no usable figure comes, for example without a camera.
        """
        rows: deque[telemetry.TelemetryRow] = deque()
        shape = None
        while shape is None or rows[-1].mono_s - rows[0].mono_s < _OBSERVE_S:
            news = self._read_news()
            rows.extend(news.rows)
            for each in news.shapes:
                if each.verdict != "rejected":
                    shape = each
            if shape is None and rows and rows[-1].mono_s - rows[0].mono_s > _SHAPE_WITHIN_S:
                raise errors.DeviceError(
                    f"{self._link.name}: no shape within {_SHAPE_WITHIN_S:.0f} s; does this run "
                    "have a camera that sees the mirror? (ctl status)"
                )
        # The mean flow replaces the leak while there is no estimate of it, which needs some minutes
        # of hold.
        newest = rows[-1]
        leaks = [row.leak_um_per_s for row in rows if math.isfinite(row.leak_um_per_s)]
        return HeldMirror(
            setpoint_um=newest.target_um,
            sag_mm=1e-3 * shape.sag_um,
            pressure_pa=_mean_of_finite([row.gauge_pressure_pa for row in rows]),
            leak_um_per_s=_mean_of_finite(leaks or [row.i_um_per_s for row in rows]),
            swing_adu=shape.modulation_median_adu,
            shape_on=newest.shape_state != telemetry.ShapeState.OFF,
        )

    def claim_command(self, setpoint_um: float) -> None:
        """Take command without a motion, by repeating the setpoint. Raises HoldError if refused."""
        self._send_command("setpoint", setpoint_um)

    def go_to_setpoint(self, setpoint_um: float, expected_s: float) -> None:
        """Ramp to a setpoint and settle there.

        Parameters
        ----------
        setpoint_um : float
            Reading of the laser to go to.
        expected_s : float
            Planned duration of ramp and settling.

        Raises
        ------
        HoldError
            If the mirror is no longer held, or someone else moves the setpoint.
        DeviceError
            If the mirror does not settle in time.
        """
        self._send_command("setpoint", setpoint_um)
        patience_s = _PATIENCE_FACTOR * expected_s + _PATIENCE_MORE_S
        # Ticks since the ramp ended.
        arrived: deque[telemetry.TelemetryRow] = deque()
        begin_s = math.nan
        is_commanded = False  # whether a tick has shown the new target
        while True:
            for row in self._read_news().rows:
                if row.target_um == setpoint_um:
                    is_commanded = True
                elif is_commanded:
                    raise HoldError(f"someone else moved the setpoint to {row.target_um:g} µm")
                if math.isnan(begin_s):
                    begin_s = row.mono_s
                # The row's setpoint is that of the loop: the ramped target plus trim and offset of
                # the held scalar. Without these it is the ramp, which ends at the target.
                offset_um = row.held_offset_um
                if math.isnan(offset_um):  # the centre is held
                    offset_um = 0.0
                shift_um = row.trim_um + offset_um
                is_ramping = abs(row.setpoint_um - shift_um - setpoint_um) > _ARRIVED_UM
                if is_commanded and not is_ramping:
                    arrived.append(row)
                else:
                    arrived.clear()
            if self._are_settled(arrived):
                return
            if self._last_s - begin_s > patience_s:
                raise errors.DeviceError(
                    f"the mirror does not settle at {setpoint_um:g} µm in {patience_s:.0f} "
                    "s; paused, or too tight?"
                )

    def take_set(self) -> acquisition_events.Capture:
        """Request a set; repeat a bad one once.

        Raises
        ------
        HoldError
            If the hold refuses, or the mirror is no longer held.
        RejectedError
            If both sets are bad.
        """
        first = self._request_capture()
        event = first
        if not first.set:
            event = self._request_capture()
        if not event.set:
            raise errors.RejectedError(
                f"no good set in two attempts: {first.failed}; {event.failed}"
            )
        return event

    def shape_loop(self, on: bool) -> None:
        """Switch the shape loop."""
        self._send_command("shape_on" if on else "shape_off")

    def _request_capture(self) -> acquisition_events.Capture:
        """Request a set and wait for the event that reports it, or for the time-out."""
        self._send_command("capture")
        begin_s = self._last_s
        while self._last_s - begin_s < _SET_WITHIN_S:
            captures = [
                event
                for event in self._read_news().events
                if isinstance(event, acquisition_events.Capture)
            ]
            if captures:
                return captures[-1]
        return acquisition_events.Capture(failed=f"no set within {_SET_WITHIN_S:.0f} s")

    def _are_settled(self, rows: deque[telemetry.TelemetryRow]) -> bool:
        """Whether these ticks last long enough, and their newest errors average within the band."""
        if not rows or rows[-1].mono_s - rows[0].mono_s < SETTLE_S:
            return False
        newest = [row.error_um for row in rows if rows[-1].mono_s - row.mono_s <= _MEAN_S]
        return abs(_mean_of_finite(newest)) < self._limits.band_um

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
    """Mean of the finite values; nan if there are none."""
    finite = [value for value in values if math.isfinite(value)]
    if finite:
        return sum(finite) / len(finite)
    return math.nan
