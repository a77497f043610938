"""The procedure of a live calibration: moves the mirror and takes a set at each setpoint."""

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

from membrane_ctrl.calibration.session import CalibrationHead, CalibrationSession
from membrane_ctrl.calibration.setpoints import (
    HeldMirror,
    move_and_set_s,
    ramp_s,
    setpoint_reach,
)
from membrane_ctrl.calibration.sweep import CaptureLink, Sweep
from membrane_ctrl.model import errors
from membrane_ctrl.sessions.live_hold import HoldError
from membrane_ctrl.sessions.progress import Progress


@dataclass(frozen=True, slots=True)
class Procedure:
    """Moves the mirror for a calibration.

    Attributes
    ----------
    link : CaptureLink
        The hold, and its run folder with the sets that it takes.
    sweep : Sweep
        The hold under control.
    held : HeldMirror
        The mirror before the first move.
    progress : Progress
        Shows steps and their durations; knows of a Ctrl-C.
    """

    link: CaptureLink
    sweep: Sweep
    held: HeldMirror
    progress: Progress

    def times_s(self, head: CalibrationHead, missing: tuple[int, ...]) -> list[float]:
        """Return the duration of each step: the missing sets, and the return to the start.

        Parameters
        ----------
        head : CalibrationHead
            The plan.
        missing : tuple of int
            Numbers of the sets that are not taken yet.

        Returns
        -------
        list of float
            Seconds.
        """
        stops = [self.held.setpoint_um, *(head.setpoints_um[k] for k in missing), head.start_um]
        return [move_and_set_s(self.held, a, b, self.link.config) for a, b in pairwise(stops)]

    def check_setpoints(self, head: CalibrationHead) -> None:
        """Check that the mirror can be moved to all setpoints and back.

        Raises
        ------
        InputError
            If setpoints are out of reach, or the mirror cannot be moved both ways.
        """
        held = self.held
        config = self.link.config

        # Within the range that limits and pump allow.
        low_um = min(head.setpoints_um)
        high_um = max(head.setpoints_um)
        reach = setpoint_reach(held, config)
        if low_um < reach.low_um or high_um > reach.high_um:
            raise errors.InputError(
                f"the sets from {low_um:g} to {high_um:g} µm are beyond {reach.low_um:.0f} to "
                f"{reach.high_um:.0f}, which {reach.low_why} and {reach.high_why} allow"
            )

        # And reachable both ways.
        up_s = ramp_s(held, low_um, high_um, config)
        down_s = ramp_s(held, high_um, low_um, config)
        if math.isinf(up_s + down_s):
            raise errors.InputError(
                f"the mirror loses {held.leak_um_per_s:.2f} µm/s: it cannot be moved both ways; "
                "open the bleed (loop.bleed_fraction), or give the pump more reserve"
            )

    def take_sets(self, session: CalibrationSession) -> None:
        """Take the missing sets and move the mirror back.

        Raises
        ------
        HoldError
            If the mirror is no longer held or someone else moves it: it is then left alone.
        DeviceError, RejectedError, KeyboardInterrupt
            After the mirror has moved back.
        """
        with self.progress.catch_signals(), self._move_back_at_end(session):
            self.sweep.shape_loop(False)
            times_s = self.times_s(session.head, session.missing_indices)
            for number, index in enumerate(session.missing_indices):
                self._take_set(session, index, times_s[number], sum(times_s[number + 1 :]))

    def _take_set(
        self, session: CalibrationSession, index: int, expected_s: float, after_s: float
    ) -> None:
        """Move to the setpoint of the set with this index, take the set and keep it.

        `expected_s` is the duration of this step, `after_s` that of all later ones.
        """
        setpoint_um = session.head.setpoints_um[index]
        step = f"set {index + 1} of {len(session.set_folders)} at {setpoint_um:+g} µm"
        self.progress.begin_step(step, expected_s, after_s)
        self.sweep.go_to_setpoint(setpoint_um, expected_s)
        event = self.sweep.take_set()
        session.keep_set(index, self.link.run_dir / str(event.set))
        reason = ""
        if event.reason:
            reason = f" ({event.reason})"
        self.progress.print_line(f"{step}: {event.verdict}{reason}")

    @contextlib.contextmanager
    def _move_back_at_end(self, session: CalibrationSession) -> Iterator[None]:
        """Move the mirror back at the end, also after an error or Ctrl-C, unless the hold ended."""
        try:
            yield
        # The hold has ended, or a person moves the mirror now: no command of this program may
        # follow.
        except HoldError:
            off = ""
            if session.head.shape_on:
                off = "; the shape loop is off (ctl shape on)"
            self.progress.print_line(
                f"the mirror is left to the client in command{off}; continue with --session "
                f"{session.path}"
            )
            raise
        # Any other end, Ctrl-C too: the mirror goes back, and a second Ctrl-C may stop that wait.
        except BaseException:
            self.progress.interrupted = False
            missing_count = len(session.missing_indices)
            self.progress.print_line(
                f"stopped with {missing_count} sets missing; continue with --session {session.path}"
            )
            with contextlib.suppress(HoldError, errors.DeviceError):
                self._return_to_start(session)
            raise
        self._return_to_start(session)

    def _return_to_start(self, session: CalibrationSession) -> None:
        """Move the mirror to where it was held, and restore the shape loop."""
        head = session.head
        # The mirror may be at any of the setpoints: the farthest gives the longest way.
        far_um = max(head.setpoints_um, key=lambda each: abs(each - head.start_um))
        back_s = move_and_set_s(self.held, far_um, head.start_um, self.link.config)
        self.progress.begin_step(
            f"back to {head.start_um:g} µm (Ctrl-C stops waiting)", back_s, 0.0
        )
        try:
            self.sweep.go_to_setpoint(head.start_um, back_s)
        except KeyboardInterrupt:
            off = ""
            if head.shape_on:
                off = "; then switch the shape loop on (ctl shape on)"
            self.progress.print_line(
                f"left: the hold continues its ramp to {head.start_um:g} µm{off}"
            )
            raise
        if head.shape_on:
            self.sweep.shape_loop(True)
