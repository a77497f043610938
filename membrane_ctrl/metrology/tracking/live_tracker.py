"""Tracking in a hold: a full cycle anchors it, every frame of the crossed pattern is a figure,
steps renew the light.

The controller's inputs are recorded exactly, twenty figures a second of them: numbers are rounded
to what their noise leaves of them, and the covariance stays the same for many frames.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from firmware_iface.roles import Pattern
from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.cycle import live_reconstructor
from membrane_ctrl.metrology.figure import pixel_figure
from membrane_ctrl.metrology.frame_checks import checked_set, frame_evidence
from membrane_ctrl.metrology.phase import frame_stack, pattern_sequence
from membrane_ctrl.metrology.reconstruction import slope_noise
from membrane_ctrl.metrology.tracking.crossed_scene import scene_of
from membrane_ctrl.metrology.tracking.frame_fit import ENOUGH_STEPS
from membrane_ctrl.metrology.tracking.tracked_frame import TrackedFrame
from membrane_ctrl.metrology.tracking.tracker import Tracker
from membrane_ctrl.metrology.vibrations.mode_search import (
    LEAST_RATE_HZ,
    MOVED,
    SEARCH_S,
    VibrationMode,
    find_modes,
)
from membrane_ctrl.model import events, run_events
from membrane_ctrl.model.arrays import ArrayLike, FloatArray, Image
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.state_tree import Count, StateNode

# A gust may lose the order of a few frames, which the next ones have again.
LOST_S = 1.0
# A new covariance is 100 times a figure in the record: one for each step of the pattern.
COVARIANCE_S = 10.0
# A hand or a lamp goes away by itself, and meanwhile a full cycle would be rejected too.
REJECTED_S = 10.0
# The interval between frames is longer in two of three steps: vibrations faster than half the frame
# rate then have different aliases (`modes`).
_SLOWER = (1.0, 1.09, 1.17)
MODES = 8  # that a hold follows
_SEARCHES = 5  # whose median is a mode's frequency; a line heard in fewer passes by
_AT_STROKES = 0.01  # relative
_DAY_S = 86_400.0
_PAST_EVERY_S, _WEEK_S = _DAY_S / 4, 8 * _DAY_S  # a shift that takes a whole week is within it
_UM, _SHARE, _TIME_S = 3, 4, 6  # decimals: a nanometre, a hundredth of a per cent, a microsecond


class LiveTracker:
    """Figures of full cycles and of single crossed frames, for a cycle of measurements
    (`acquisition.cycle`).

    Parameters
    ----------
    optics : OpticsConfig
        Geometry, camera, pattern and mirror.
    cycles : LiveReconstructor
        Gives the figure of full cycles.
    periods : int
        Of the crossed fringes, over the pattern.
    step_s : float
        Interval between steps of the crossed fringes; the first five frames after a full cycle are
        steps.
    exposure_s : float
        Exposure time: a frame's figure is that of its middle.
    """

    def __init__(
        self,
        optics: OpticsConfig,
        cycles: live_reconstructor.LiveReconstructor,
        periods: int,
        step_s: float,
        exposure_s: float = 0.0,
    ) -> None:
        self._optics, self._cycles = optics, cycles
        self.patterns = crossed_patterns(periods)
        self._step_s, self._exposure_s = step_s, exposure_s
        self._tracker: Tracker | None = None
        self._urad_per_rad = math.nan
        self._step, self._stepped_s = 0, -math.inf
        self._covariance_um2, self._covariance_until_s = np.empty((0, 0)), -math.inf
        self._lost_since_s = self._rejected_since_s = math.inf

    @property
    def pattern(self) -> Pattern:
        """What the next crossed frame must show."""
        return self.patterns[self._step % ENOUGH_STEPS]

    @property
    def slower(self) -> float:
        """How much longer than usual the interval to the next frame is."""
        return _SLOWER[self._step % len(_SLOWER)]

    def full(
        self, frames: Sequence[Image], time_s: ArrayLike, displacement_um: ArrayLike
    ) -> ShapeEstimate:
        """The figure of a full cycle, which anchors the frames after it. As
        `LiveReconstructor.full`.
        """
        estimate = self._cycles.full(frames, time_s, displacement_um)
        self._tracker = None
        if estimate.verdict == "rejected":
            return estimate
        try:
            self._tracker = self._anchored(frames, np.asarray(displacement_um, float))
        except (frame_evidence.NoFigureError, ValueError) as error:
            times, readings = np.asarray(time_s, float), np.asarray(displacement_um, float)
            return live_reconstructor.rejected(
                "full", times, readings, f"no anchor for tracking: {error}"
            )
        self._step, self._stepped_s, self._covariance_until_s = 0, -math.inf, -math.inf
        self._lost_since_s = self._rejected_since_s = math.inf
        return estimate

    def fringes(
        self, frames: Sequence[Image], time_s: ArrayLike, displacement_um: ArrayLike
    ) -> ShapeEstimate:
        """The figure of one frame of `pattern`. An estimate with `tracking_lost` asks for a full
        cycle.
        """
        at_s = round(float(np.asarray(time_s)[0]) + self._exposure_s / 2, _TIME_S)
        reading_um = round(float(np.asarray(displacement_um)[0]), _UM)
        if self._tracker is None:
            none = np.array([at_s]), np.array([reading_um])
            return live_reconstructor.rejected(
                "track", *none, live_reconstructor.NOTHING_TO_FOLLOW, tracking_lost=True
            )
        shown = self.pattern
        found = self._tracker.follow(
            frames[0], (shown.shift_rad, shown.shift_y_rad), at_s, reading_um
        )
        if found.verdict != "rejected":
            self._next_step(at_s)
            if at_s >= self._covariance_until_s:
                self._covariance_um2, self._covariance_until_s = (
                    found.covariance_um2,
                    at_s + COVARIANCE_S,
                )
            found = replace(found, covariance_um2=self._covariance_um2)
        return _estimate(found, reading_um, self._astray(found), self._urad_per_rad)

    def prepare(self) -> None:
        """Do ahead what the next frame needs, while its pattern settles."""
        if self._tracker is not None:
            self._tracker.prepare((self.pattern.shift_rad, self.pattern.shift_y_rad))

    def _anchored(self, frames: Sequence[Image], displacement_um: FloatArray) -> Tracker:
        """A tracker that begins with the figure of a full cycle. Raises NoFigureError,
        ValueError.
        """
        optics = self._optics
        known = displacement_um[np.isfinite(displacement_um)]
        if optics.geometry.reference_displacement_um is None and known.size:
            geometry = optics.geometry.model_copy(
                update={"reference_displacement_um": float(known[0])}
            )
            optics = self._optics = optics.model_copy(update={"geometry": geometry})
        patterns = tuple(pattern_sequence.full_sequence(optics.pattern))
        pictures: Any = np.asarray(frames)  # of one kind, as the frames are
        stack = frame_stack.FrameStack(pictures, patterns, displacement_um, {})
        seen = checked_set.check(stack, optics)
        period_mm = optics.pattern.periods * optics.pattern.period_mm / self.pattern.index
        scene = scene_of(optics, seen, pixel_figure.bin_figure(optics, seen), period_mm)
        gain = slope_noise.slope_per_screen(
            scene.tracer.geometry, scene.surface.radius_mm, scene.surface.sag_mm
        )
        self._urad_per_rad = 1e6 * float(np.sqrt(np.sum(gain) / 2)) / scene.rad_per_mm
        camera = optics.camera
        size_px = camera.height_px, camera.width_px
        return Tracker(scene, size_px, 2**camera.bits - 1, camera.noise_adu, stack.mean_reading_um)

    def _next_step(self, now_s: float) -> None:
        """Step the pattern if it is time."""
        if self._step < ENOUGH_STEPS or now_s - self._stepped_s >= self._step_s:
            self._step, self._stepped_s = self._step + 1, now_s

    def _astray(self, found: TrackedFrame) -> bool:
        """Whether the mirror must be found again by a full cycle."""
        if found.verdict != "rejected":
            self._rejected_since_s = math.inf
        self._rejected_since_s = min(self._rejected_since_s, found.time_s)
        self._lost_since_s = min(self._lost_since_s, found.time_s) if found.lost else math.inf
        return found.time_s - self._lost_since_s >= LOST_S or (
            found.verdict == "rejected" and found.time_s - self._rejected_since_s >= REJECTED_S
        )


def crossed_patterns(periods: int) -> tuple[Pattern, ...]:
    """The steps of the crossed pattern: 72 degrees in x and 144 in y separate the axes."""
    turn = 2 * math.pi
    return tuple(
        Pattern(
            "crossed",
            "",
            periods,
            turn * k / ENOUGH_STEPS,
            shift_y_rad=turn * (2 * k % ENOUGH_STEPS) / ENOUGH_STEPS,
        )
        for k in range(ENOUGH_STEPS)
    )


def _estimate(
    found: TrackedFrame, reading_um: float, tracking_lost: bool, urad: float
) -> ShapeEstimate:
    """The figure of a frame as control and recorder take it; `urad` of slope turn the phases by 1
    rad.
    """
    return ShapeEstimate(
        time_s=found.time_s,
        kind="track",
        coeffs_um=np.round(found.coeffs_um, _UM)
        + 0.0,  # a minus zero is no whole number to the recorder
        hencky_um=round(found.hencky_um, _UM),
        covariance_um2=found.covariance_um2,
        sag_um=round(found.sag_um, _UM + 1),  # a camera that repeats itself is known by equal sags
        sag_sigma_um=round(found.sag_sigma_um, _UM + 1),
        displacement_um=reading_um,
        slope_residual_urad=round(found.rest_share * urad, 2),
        valid_fraction=round(found.used_share, _SHARE),
        modulation_median_adu=round(found.swing_adu, 1),
        saturated_fraction=round(found.saturated_share, _SHARE),
        verdict=found.verdict,
        reason=found.reason,
        tracking_lost=tracking_lost,
    )


class Stethoscope:
    """The mirror's vibrations while it is held, searched in each minute of tracked figures.

    Eight modes are followed. One that moves by 1 % within a week tells of another tension; one
    within 1 % of `stroke_hz`, the pump's strokes (0: unknown), is driven by them. `begin_utc_s` is
    time 0 of the figures; `known` is what an earlier listener has heard, and the notices of this
    run that stand.
    """

    def __init__(
        self, stroke_hz: float = 0.0, begin_utc_s: float = 0.0, known: "Heard | None" = None
    ) -> None:
        self._time_s: list[float] = []
        self._terms_um: list[FloatArray] = []
        self._stroke_hz, self._begin_utc_s = stroke_hz, begin_utc_s
        self.heard = known or Heard()

    def after(self, estimate: ShapeEstimate) -> list[events.Event]:
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
        utc_s, modes = self._begin_utc_s + float(time_s[-1]), self.heard.modes
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
                modes[free : free + 1] = [known := HeardMode(line)]
            if known is not None:
                known.add(line, utc_s)
        if not modes:
            return []
        lines = [mode.line for mode in modes]
        told = ", ".join(
            f"{line.frequency_hz:.2f} Hz {line.amplitude_nm:.1f} nm" for line in lines if line
        )
        heard = run_events.Vibrations(
            [None if line is None else round(line.frequency_hz, 4) for line in lines],
            [None if line is None else round(line.amplitude_nm, 2) for line in lines],
            told or "none",
        )
        followed = [mode for mode in modes if mode.past and not mode.gone]
        return [heard, *self._tension(followed, utc_s), *self._strokes(followed)]

    def _tension(self, modes: "Sequence[HeardMode]", utc_s: float) -> list[events.Event]:
        """A notice when a mode has moved, and when none has within a week."""
        limit = MOVED / 2 if "film_tension" in self.heard.said else MOVED
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

    def _strokes(self, modes: "Sequence[HeardMode]") -> list[events.Event]:
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
        if bool(says) == (name in self.heard.said):
            return []
        if says:
            self.heard.said.append(name)
        else:
            self.heard.said.remove(name)
        return [events.Maintenance(name, says) if says else events.MaintenanceOver(name, over)]


@dataclass
class HeardMode(StateNode):
    """A mode over the searches; times are UTC in seconds."""

    last: VibrationMode
    line: VibrationMode | None = None  # of the last search; None where it was not heard
    missed: Count = 0  # searches since it was heard
    recent_hz: list[float] = field(default_factory=list)
    past: list[tuple[float, float]] = field(
        default_factory=list
    )  # time and frequency, some a day, of a week

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
class Heard(StateNode):
    """What a listener knows, for the next one."""

    modes: list[HeardMode] = field(default_factory=list)  # each keeps its place
    said: list[str] = field(default_factory=list)  # notices that stand
