"""The mirror's vibrations while it is held: modes followed from minute to minute, and notices."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from membrane_ctrl.metrology.vibrations.mode_search import (
    LEAST_RATE_HZ,
    MOVED,
    SEARCH_S,
    VibrationMode,
    find_modes,
)
from membrane_ctrl.model import acquisition_events, events
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.state_tree import Count, StateNode

MODES = 8  # that a hold follows
_SEARCHES = 5  # whose median is a mode's frequency; a line heard in fewer passes by
_AT_STROKES = 0.01  # relative
_DAY_S = 86_400.0
_PAST_EVERY_S, _WEEK_S = _DAY_S / 4, 8 * _DAY_S  # a shift that takes a whole week is within it


class VibrationFollower:
    """The mirror's vibrations while it is held, searched in each minute of tracked figures.

    Eight modes are followed. One that moves by 1 % within a week tells of another tension; one
    within 1 % of `stroke_hz`, the pump's strokes (0: unknown), is driven by them. `begin_utc_s` is
    time 0 of the figures; `known` is what an earlier listener has heard, and the notices of this
    run that stand.
    """

    def __init__(
        self, stroke_hz: float = 0.0, begin_utc_s: float = 0.0, known: "FollowedModes | None" = None
    ) -> None:
        self._time_s: list[float] = []
        self._terms_um: list[FloatArray] = []
        self._stroke_hz, self._begin_utc_s = stroke_hz, begin_utc_s
        self.followed = known or FollowedModes()

    def add_estimate(self, estimate: ShapeEstimate) -> list[events.Event]:
        """Take a figure; once a minute, say what was heard, if ever there was something."""
        if estimate.kind != "track" or estimate.verdict == "rejected":
            return []
        self._time_s.append(estimate.time_s)
        self._terms_um.append(estimate.coeffs_um)
        if estimate.time_s - self._time_s[0] < SEARCH_S:
            return []
        time_s, terms_um = np.array(self._time_s), np.array(self._terms_um)
        self._time_s, self._terms_um = [], []
        return [] if len(time_s) < LEAST_RATE_HZ * SEARCH_S else self.search(time_s, terms_um)

    def search(self, time_s: FloatArray, terms_um: FloatArray) -> list[events.Event]:
        """Search a minute of terms (n, terms) at times (n,); a line of several possible frequencies
        is not told.
        """
        found = find_modes(time_s, terms_um)
        if found is None:
            return []
        utc_s, modes = self._begin_utc_s + float(time_s[-1]), self.followed.modes
        for mode in modes:
            mode.begin_search(utc_s)
        for line in (line for line in found if not line.aliases_hz):
            alike = (
                mode
                for mode in modes
                if mode.line is None and not mode.gone and line.is_like(mode.last)
            )
            known = min(
                alike,
                key=lambda mode: abs(line.frequency_hz - mode.last.frequency_hz),
                default=None,
            )
            free = next((k for k, mode in enumerate(modes) if mode.gone), len(modes))
            if known is None and free < MODES:
                modes[free : free + 1] = [known := FollowedMode(line)]
            if known is not None:
                known.add(line, utc_s)
        if not modes:
            return []
        lines = [mode.line for mode in modes]
        told = ", ".join(
            f"{line.frequency_hz:.2f} Hz {line.amplitude_nm:.1f} nm" for line in lines if line
        )
        heard = acquisition_events.Vibrations(
            [None if line is None else round(line.frequency_hz, 4) for line in lines],
            [None if line is None else round(line.amplitude_nm, 2) for line in lines],
            told or "none",
        )
        followed = [mode for mode in modes if mode.past and not mode.gone]
        return [heard, *self._judge_tension(followed, utc_s), *self._judge_strokes(followed)]

    def _judge_tension(self, modes: "Sequence[FollowedMode]", utc_s: float) -> list[events.Event]:
        """A notice when a mode has moved, and when none has within a week."""
        limit = MOVED / 2 if "film_tension" in self.followed.active_notices else MOVED
        moved = next((mode for mode in modes if abs(mode.moved[0]) > limit), None)
        says = ""
        if moved is not None:
            change, since_s, then_hz = moved.moved
            hours = max(1, round((utc_s - since_s) / 3600.0))
            says = (
                f"the mirror's vibration at {then_hz:.2f} Hz moved by {change:+.1%} within "
                f"{hours} h: the film's "
                f"tension by {2 * change:+.1%}; check clamping and pressure"
            )
        return self._notice(
            "film_tension", says, "no vibration of the mirror has moved within a week"
        )

    def _judge_strokes(self, modes: "Sequence[FollowedMode]") -> list[events.Event]:
        """A notice when the pump's strokes meet a mode, and when none has been heard there for some
        searches.
        """
        near_hz = _AT_STROKES * self._stroke_hz
        lines = [mode.last for mode in modes if mode.missed < _SEARCHES]
        driven = next(
            (line for line in lines if abs(line.frequency_hz - self._stroke_hz) < near_hz), None
        )
        says = (
            ""
            if driven is None
            else (
                f"the pump's strokes, {self._stroke_hz:g} Hz, drive the mirror's vibration at "
                f"{driven.frequency_hz:.2f} "
                f"Hz, {driven.amplitude_nm:.0f} nm; change the pump's speed or its mount"
            )
        )
        return self._notice(
            "pump_resonance", says, "no vibration of the mirror is at the pump's strokes"
        )

    def _notice(self, name: str, says: str, over: str) -> list[events.Event]:
        """What is new of a matter: that it begins, or that it is over."""
        if bool(says) == (name in self.followed.active_notices):
            return []
        if says:
            self.followed.active_notices.append(name)
        else:
            self.followed.active_notices.remove(name)
        return [events.Maintenance(name, says) if says else events.MaintenanceOver(name, over)]


@dataclass
class FollowedMode(StateNode):
    """A mode over the searches; times are UTC in seconds.

    Attributes
    ----------
    last : VibrationMode
    line : VibrationMode, optional
        The line of the last search; None where it was not found.
    missed : Count
        Searches since it was found.
    recent_hz : list[float]
    past : list[tuple[float, float]]
        Time and frequency, some a day, of a week.
    """

    last: VibrationMode
    line: VibrationMode | None = None
    missed: Count = 0
    recent_hz: list[float] = field(default_factory=list)
    past: list[tuple[float, float]] = field(default_factory=list)

    @property
    def gone(self) -> bool:
        """Whether its place may be another's: it was heard in passing only, or not for a week."""
        return self.missed >= _SEARCHES and not self.past

    @property
    def moved(self) -> tuple[float, float, float]:
        """The largest relative change within a week, from when, and from which frequency."""
        now_hz = float(np.median(self.recent_hz))
        changes = ((now_hz / then_hz - 1, at_s, then_hz) for at_s, then_hz in self.past)
        return max(changes, key=lambda change: abs(change[0]))

    def begin_search(self, utc_s: float) -> None:
        """Not heard yet; forget what is older than a week."""
        self.line, self.missed = None, self.missed + 1
        if self.past and utc_s - self.past[-1][0] >= _WEEK_S:
            self.recent_hz = []
        self.past = [(at_s, then_hz) for at_s, then_hz in self.past if utc_s - at_s < _WEEK_S]

    def add(self, line: VibrationMode, utc_s: float) -> None:
        """Take its line of a search."""
        self.line, self.last, self.missed = line, line, 0
        self.recent_hz = [*self.recent_hz, line.frequency_hz][-_SEARCHES:]
        if len(self.recent_hz) == _SEARCHES and (
            not self.past or utc_s - self.past[-1][0] >= _PAST_EVERY_S
        ):
            self.past.append((utc_s, float(np.median(self.recent_hz))))


@dataclass
class FollowedModes(StateNode):
    """What one follower passes on to the next.

    Attributes
    ----------
    modes : list[FollowedMode]
        Each keeps its place.
    active_notices : list[str]
        Codes of the notices that are active.
    """

    modes: list[FollowedMode] = field(default_factory=list)
    active_notices: list[str] = field(default_factory=list)
