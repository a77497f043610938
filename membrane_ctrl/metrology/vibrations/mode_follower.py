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
# Searches whose median is a mode's frequency; a line that fewer of them find is transient.
_SEARCHES = 5
_AT_STROKES = 0.01  # relative distance from the pump's strokes at which they drive a mode
_DAY_S = 86_400.0
_PAST_EVERY_S = _DAY_S / 4  # between stored frequencies
_WEEK_S = 8 * _DAY_S  # stored frequencies last so long: a shift that takes a whole week is included


class VibrationFollower:
    """The mirror's vibrations while it is held, searched in each minute of tracked figures.

    Eight modes are followed. One that moves by 1 % within a week shows another tension of the film;
    one within 1 % of the pump's strokes is driven by them.

    Parameters
    ----------
    stroke_hz : float
        The pump's strokes; 0: unknown.
    begin_utc_s : float
        Time 0 of the figures.
    known : FollowedModes, optional
        Modes of an earlier follower, and the notices of this run that are active.
    """

    def __init__(
        self, stroke_hz: float = 0.0, begin_utc_s: float = 0.0, known: "FollowedModes | None" = None
    ) -> None:
        self._time_s: list[float] = []
        self._terms_um: list[FloatArray] = []
        self._stroke_hz = stroke_hz
        self._begin_utc_s = begin_utc_s
        self.followed = known or FollowedModes()

    def add_estimate(self, estimate: ShapeEstimate) -> list[events.Event]:
        """Add a figure; once a minute, search and return the events of that."""
        if estimate.kind != "track" or estimate.verdict == "rejected":
            return []
        self._time_s.append(estimate.time_s)
        self._terms_um.append(estimate.coeffs_um)
        if estimate.time_s - self._time_s[0] < SEARCH_S:
            return []
        time_s = np.array(self._time_s)
        terms_um = np.array(self._terms_um)
        self._time_s = []
        self._terms_um = []
        if len(time_s) < LEAST_RATE_HZ * SEARCH_S:
            return []
        return self.search_minute(time_s, terms_um)

    def search_minute(self, time_s: FloatArray, terms_um: FloatArray) -> list[events.Event]:
        """Search a minute of terms.

        Parameters
        ----------
        time_s : (n,) array
            Times of the frames.
        terms_um : (n, terms) array
            Terms of each.

        Returns
        -------
        list of Event
            Nothing if no mode has ever been found. A line of several possible frequencies is not
            reported.
        """
        found = find_modes(time_s, terms_um)
        if found is None:
            return []

        # Each line belongs to a mode that is followed, or begins one.
        utc_s = self._begin_utc_s + float(time_s[-1])
        modes = self.followed.modes
        for mode in modes:
            mode.begin_search(utc_s)
        for line in found:
            if not line.aliases_hz:
                self._assign_line(line, utc_s)
        if not modes:
            return []

        # Only modes with a past are judged.
        settled = [mode for mode in modes if mode.past and not mode.is_replaceable]
        return [
            _make_vibrations_event(modes),
            *self._judge_tension(settled, utc_s),
            *self._judge_strokes(settled),
        ]

    def _assign_line(self, line: VibrationMode, utc_s: float) -> None:
        """Add a line to the mode that it is like, or to a free place."""
        modes = self.followed.modes

        # The nearest mode that is like the line.
        candidates = [
            mode
            for mode in modes
            if mode.line is None and not mode.is_replaceable and line.is_like(mode.last)
        ]
        if candidates:
            nearest = min(
                candidates, key=lambda mode: abs(line.frequency_hz - mode.last.frequency_hz)
            )
            nearest.add(line, utc_s)
            return

        # Else a new mode, in the place of one that is gone.
        free = next((k for k, mode in enumerate(modes) if mode.is_replaceable), len(modes))
        if free < MODES:
            mode = FollowedMode(line)
            mode.add(line, utc_s)
            modes[free : free + 1] = [mode]

    def _judge_tension(self, modes: "Sequence[FollowedMode]", utc_s: float) -> list[events.Event]:
        """A notice when a mode has moved, and when none has within a week."""
        is_active = "film_tension" in self.followed.active_notices
        limit = MOVED
        if is_active:
            limit = MOVED / 2
        moved = next((mode for mode in modes if abs(mode.largest_change[0]) > limit), None)
        sentence = ""
        if moved is not None:
            change, since_s, then_hz = moved.largest_change
            hours = max(1, round((utc_s - since_s) / 3600.0))
            sentence = (
                f"the mirror's vibration at {then_hz:.2f} Hz moved by {change:+.1%} within "
                f"{hours} h: the film's tension by {2 * change:+.1%}; check clamping and pressure"
            )
        return self._notice(
            "film_tension", sentence, "no vibration of the mirror has moved within a week"
        )

    def _judge_strokes(self, modes: "Sequence[FollowedMode]") -> list[events.Event]:
        """A notice when the pump's strokes meet a mode, and when none has been found there for some
        searches.
        """
        near_hz = _AT_STROKES * self._stroke_hz
        lines = [mode.last for mode in modes if mode.missed < _SEARCHES]
        driven = next(
            (line for line in lines if abs(line.frequency_hz - self._stroke_hz) < near_hz), None
        )
        sentence = ""
        if driven is not None:
            sentence = (
                f"the pump's strokes, {self._stroke_hz:g} Hz, drive the mirror's vibration at "
                f"{driven.frequency_hz:.2f} Hz, {driven.amplitude_nm:.0f} nm; change the pump's "
                "speed or its mount"
            )
        return self._notice(
            "pump_resonance", sentence, "no vibration of the mirror is at the pump's strokes"
        )

    def _notice(self, name: str, sentence: str, over: str) -> list[events.Event]:
        """The event of a notice that begins (`sentence`) or ends (`over`); nothing in between.

        It is active while `sentence` is not empty.
        """
        active_notices = self.followed.active_notices
        was_active = name in active_notices
        if sentence and not was_active:
            active_notices.append(name)
            return [events.Maintenance(name, sentence)]
        if was_active and not sentence:
            active_notices.remove(name)
            return [events.MaintenanceOver(name, over)]
        return []


def _make_vibrations_event(modes: "Sequence[FollowedMode]") -> acquisition_events.Vibrations:
    """The lines of the last search, each at the place of its mode."""
    lines = [mode.line for mode in modes]
    text = ", ".join(
        f"{line.frequency_hz:.2f} Hz {line.amplitude_nm:.1f} nm" for line in lines if line
    )
    return acquisition_events.Vibrations(
        [None if line is None else round(line.frequency_hz, 4) for line in lines],
        [None if line is None else round(line.amplitude_nm, 2) for line in lines],
        text or "none",
    )


@dataclass
class FollowedMode(StateNode):
    """A mode over the searches; times are UTC in seconds.

    Attributes
    ----------
    last : VibrationMode
        Its newest line.
    line : VibrationMode, optional
        The line of the last search; None where it was not found.
    missed : Count
        Searches since it was found.
    recent_hz : list of float
        Frequencies of the newest lines.
    past : list of (float, float)
        Time and frequency, four a day, of a week.
    """

    last: VibrationMode
    line: VibrationMode | None = None
    missed: Count = 0
    recent_hz: list[float] = field(default_factory=list)
    past: list[tuple[float, float]] = field(default_factory=list)

    @property
    def is_replaceable(self) -> bool:
        """Whether another mode may take its place: it was transient, or not found for a week."""
        return self.missed >= _SEARCHES and not self.past

    @property
    def largest_change(self) -> tuple[float, float, float]:
        """The largest relative change within a week, its time (UTC, s), and the frequency then
        (Hz).
        """
        now_hz = float(np.median(self.recent_hz))
        changes = ((now_hz / then_hz - 1, at_s, then_hz) for at_s, then_hz in self.past)
        return max(changes, key=lambda change: abs(change[0]))

    def begin_search(self, utc_s: float) -> None:
        """Count it as not found until a line is added; forget what is older than a week."""
        self.line = None
        self.missed += 1
        if self.past and utc_s - self.past[-1][0] >= _WEEK_S:
            self.recent_hz = []
        self.past = [(at_s, then_hz) for at_s, then_hz in self.past if utc_s - at_s < _WEEK_S]

    def add(self, line: VibrationMode, utc_s: float) -> None:
        """Add its line of a search.

        Parameters
        ----------
        line : VibrationMode
        utc_s : float
            Time of the search.
        """
        self.line = line
        self.last = line
        self.missed = 0
        self.recent_hz = [*self.recent_hz, line.frequency_hz][-_SEARCHES:]
        if len(self.recent_hz) < _SEARCHES:
            return
        if not self.past or utc_s - self.past[-1][0] >= _PAST_EVERY_S:
            self.past.append((utc_s, float(np.median(self.recent_hz))))


@dataclass
class FollowedModes(StateNode):
    """What one follower passes on to the next.

    Attributes
    ----------
    modes : list of FollowedMode
        Each keeps its place.
    active_notices : list of str
        Codes of the notices that are active.
    """

    modes: list[FollowedMode] = field(default_factory=list)
    active_notices: list[str] = field(default_factory=list)
