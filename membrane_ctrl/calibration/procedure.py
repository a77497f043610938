"""The sets of a session, one after the other, on a running hold; and the way back, whatever happens."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise

from membrane_ctrl.calibration.plan import Held, reach_of, step_s, way_s
from membrane_ctrl.calibration.session import Head, Session
from membrane_ctrl.calibration.sweep import CaptureLink, Sweep
from membrane_ctrl.errors import DeviceError, InputError
from membrane_ctrl.tune.progress import Progress
from tuning.hold_link import HoldError


@dataclass(frozen=True, slots=True)
class Procedure:
    """What moves the mirror for a calibration.

    Attributes
    ----------
    link : CaptureLink
        The hold.
    sweep : Sweep
        The hand on it.
    held : Held
        The mirror as it was found.
    progress : Progress
        For the person who waits.
    """

    link: CaptureLink
    sweep: Sweep
    held: Held
    progress: Progress

    def times_s(self, head: Head, missing: tuple[int, ...]) -> list[float]:
        """How long each step takes: the sets that are missing, and the way back."""
        stops = [self.held.setpoint_um, *(head.setpoints_um[k] for k in missing), head.start_um]
        return [step_s(self.held, a, b, self.link.config) for a, b in pairwise(stops)]

    def check(self, head: Head) -> None:
        """Raises InputError if the setpoints are out of reach, or the mirror cannot be moved both ways."""
        held, config = self.held, self.link.config
        low_um, high_um = min(head.setpoints_um), max(head.setpoints_um)
        reach = reach_of(held, config)
        if low_um < reach.low_um or high_um > reach.high_um:
            raise InputError(
                f"the sets from {low_um:g} to {high_um:g} um are beyond {reach.low_um:.0f} to {reach.high_um:.0f}, "
                f"which {reach.low_why} and {reach.high_why} leave"
            )
        if way_s(held, low_um, high_um, config) + way_s(held, high_um, low_um, config) == float("inf"):
            raise InputError(
                f"the mirror loses {held.leak_um_per_s:.2f} um/s: it cannot be moved both ways; "
                "open the bleed (loop.bleed_fraction), or give the pump more reserve"
            )

    def take(self, session: Session) -> None:
        """Take what is missing, come back.

        Raises
        ------
        HoldError
            If the mirror is held no more, or somebody else moves it; it is left alone then.
        DeviceError, RejectedError, KeyboardInterrupt
            After the mirror has come back.
        """
        with self.progress.catching(), self._coming_back(session):
            self.sweep.shape_loop(False)
            times_s = self.times_s(session.head, session.missing)
            for number, index in enumerate(session.missing):
                self._take(session, index, times_s[number], sum(times_s[number + 1 :]))

    def _take(self, session: Session, index: int, expected_s: float, after_s: float) -> None:
        setpoint_um = session.head.setpoints_um[index]
        what = f"set {index + 1} of {len(session.sets)} at {setpoint_um:+g} um"
        self.progress.begin(what, expected_s, after_s)
        self.sweep.go(setpoint_um, expected_s)
        event = self.sweep.take()
        session.keep(index, self.link.run_dir / str(event["set"]))
        self.progress.say(f"{what}: {event['verdict']}" + (f" ({event['reason']})" if event.get("reason") else ""))

    @contextmanager
    def _coming_back(self, session: Session) -> Iterator[None]:
        say = self.progress.say
        try:
            yield
        except HoldError:
            off = "; the shape loop is off (ctl shape on)" if session.head.shape_on else ""
            say(f"the mirror is left to whoever has it{off}; go on with --session {session.path}")
            raise
        except BaseException:
            self.progress.interrupted = False
            say(f"stopped with {len(session.missing)} sets missing; go on with --session {session.path}")
            with contextlib.suppress(HoldError, DeviceError):
                self._come_back(session)
            raise
        self._come_back(session)

    def _come_back(self, session: Session) -> None:
        head = session.head
        far_um = max(head.setpoints_um, key=lambda each: abs(each - head.start_um))
        back_s = step_s(self.held, far_um, head.start_um, self.link.config)
        self.progress.begin(f"back to {head.start_um:g} um (Ctrl-C leaves it on its way)", back_s, 0.0)
        try:
            self.sweep.go(head.start_um, back_s)
        except KeyboardInterrupt:
            off = "; then switch the shape loop on (ctl shape on)" if head.shape_on else ""
            self.progress.say(f"left: the hold ramps on to {head.start_um:g} um by itself{off}")
            raise
        if head.shape_on:
            self.sweep.shape_loop(True)
