"""Tracking in a hold: a full cycle anchors it, every frame of the crossed pattern is a figure, steps renew the light.

The controller's inputs are recorded exactly, twenty figures a second of them: numbers are rounded to what their noise
leaves of them, and the covariance stays the same for many frames.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from firmware_iface.roles import Pattern
from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology import bins, checked, full, live, phase
from membrane_ctrl.metrology.frames import evidence, frame_stack
from membrane_ctrl.metrology.track.fit import ENOUGH_STEPS
from membrane_ctrl.metrology.track.modes import LEAST_RATE_HZ, MOVED, SEARCH_S, VibrationMode, find_modes
from membrane_ctrl.metrology.track.scene import scene_of
from membrane_ctrl.metrology.track.tracked import TrackedFrame
from membrane_ctrl.metrology.track.tracker import Tracker
from membrane_ctrl.model import events, run_events
from membrane_ctrl.model.arrays import ArrayLike, FloatArray, Image
from membrane_ctrl.model.shape_estimate import ShapeEstimate

# A gust may lose the order of a few frames, which the next ones have again.
LOST_S = 1.0
# A new covariance is 100 times a figure in the record: one for each step of the pattern.
COVARIANCE_S = 10.0
# A hand or a lamp goes away by itself, and meanwhile a full cycle would be rejected too.
REJECTED_S = 10.0
# The interval between frames is longer in two of three steps: vibrations faster than half the frame rate then have
# different aliases (`modes`).
_SLOWER = (1.0, 1.09, 1.17)
MODES = 8  # that a hold follows
_SEARCHES = 5  # whose median is a mode's frequency
_UM, _SHARE, _TIME_S = 3, 4, 6  # decimals: a nanometre, a hundredth of a per cent, a microsecond


class LiveTracker:
    """Figures of full cycles and of single crossed frames, for a cycle of measurements (`acquisition.cycle`).

    Parameters
    ----------
    optics : OpticsConfig
        Geometry, camera, pattern and mirror.
    cycles : LiveReconstructor
        Gives the figure of full cycles.
    periods : int
        Of the crossed fringes, over the pattern.
    step_s : float
        Interval between steps of the crossed fringes; the first five frames after a full cycle are steps.
    exposure_s : float
        Exposure time: a frame's figure is that of its middle.
    """

    def __init__(
        self,
        optics: OpticsConfig,
        cycles: live.LiveReconstructor,
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

    def full(self, frames: Sequence[Image], time_s: ArrayLike, displacement_um: ArrayLike) -> ShapeEstimate:
        """The figure of a full cycle, which anchors the frames after it. As `LiveReconstructor.full`."""
        estimate = self._cycles.full(frames, time_s, displacement_um)
        self._tracker = None
        if estimate.verdict == "rejected":
            return estimate
        try:
            self._tracker = self._anchored(frames, np.asarray(displacement_um, float))
        except (evidence.NoFigureError, ValueError) as error:
            times, readings = np.asarray(time_s, float), np.asarray(displacement_um, float)
            return live.rejected("full", times, readings, f"no anchor for tracking: {error}")
        self._step, self._stepped_s, self._covariance_until_s = 0, -math.inf, -math.inf
        self._lost_since_s = self._rejected_since_s = math.inf
        return estimate

    def fringes(self, frames: Sequence[Image], time_s: ArrayLike, displacement_um: ArrayLike) -> ShapeEstimate:
        """The figure of one frame of `pattern`. An estimate with `tracking_lost` asks for a full cycle."""
        at_s = round(float(np.asarray(time_s)[0]) + self._exposure_s / 2, _TIME_S)
        reading_um = round(float(np.asarray(displacement_um)[0]), _UM)
        if self._tracker is None:
            none = np.array([at_s]), np.array([reading_um])
            return live.rejected("track", *none, live.NOTHING_TO_FOLLOW, tracking_lost=True)
        shown = self.pattern
        found = self._tracker.follow(frames[0], (shown.shift_rad, shown.shift_y_rad), at_s, reading_um)
        if found.verdict != "rejected":
            self._next_step(at_s)
            if at_s >= self._covariance_until_s:
                self._covariance_um2, self._covariance_until_s = found.covariance_um2, at_s + COVARIANCE_S
            found = replace(found, covariance_um2=self._covariance_um2)
        return _estimate(found, reading_um, self._astray(found), self._urad_per_rad)

    def prepare(self) -> None:
        """Do ahead what the next frame needs, while its pattern settles."""
        if self._tracker is not None:
            self._tracker.prepare((self.pattern.shift_rad, self.pattern.shift_y_rad))

    def _anchored(self, frames: Sequence[Image], displacement_um: FloatArray) -> Tracker:
        """A tracker that begins with the figure of a full cycle. Raises NoFigureError, ValueError."""
        optics = self._optics
        known = displacement_um[np.isfinite(displacement_um)]
        if optics.geometry.reference_displacement_um is None and known.size:
            geometry = optics.geometry.model_copy(update={"reference_displacement_um": float(known[0])})
            optics = self._optics = optics.model_copy(update={"geometry": geometry})
        patterns = tuple(phase.full_sequence(optics.pattern))
        pictures: Any = np.asarray(frames)  # of one kind, as the frames are
        stack = frame_stack.FrameStack(pictures, patterns, displacement_um, {})
        seen = checked.check(stack, optics)
        period_mm = optics.pattern.periods * optics.pattern.period_mm / self.pattern.index
        scene = scene_of(optics, seen, full.bin_figure(optics, seen), period_mm)
        gain = bins.slope_per_screen(scene.tracer.geometry, scene.surface.radius_mm, scene.surface.sag_mm)
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
            "crossed", "", periods, turn * k / ENOUGH_STEPS, shift_y_rad=turn * (2 * k % ENOUGH_STEPS) / ENOUGH_STEPS
        )
        for k in range(ENOUGH_STEPS)
    )


def _estimate(found: TrackedFrame, reading_um: float, tracking_lost: bool, urad: float) -> ShapeEstimate:
    """The figure of a frame as control and recorder take it; `urad` of slope turn the phases by 1 rad."""
    return ShapeEstimate(
        time_s=found.time_s,
        kind="track",
        coeffs_um=np.round(found.coeffs_um, _UM) + 0.0,  # a minus zero is no whole number to the recorder
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

    The first eight modes are followed. One that moves by 1 % from its first searches tells of another tension; one
    within 1 % of `stroke_hz`, the pump's strokes (0: unknown), is driven by them.
    """

    def __init__(self, stroke_hz: float = 0.0) -> None:
        self._time_s: list[float] = []
        self._terms_um: list[FloatArray] = []
        self._modes: list[_Heard] = []
        self._stroke_hz = stroke_hz
        self._said: set[str] = set()

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
        """Search a minute of terms (n, 36) at times (n,); a line of several possible frequencies is not told."""
        found = find_modes(time_s, terms_um)
        if found is None:
            return []
        for mode in self._modes:
            mode.line = None
        for line in (line for line in found if not line.aliases_hz):
            known = next((mode for mode in self._modes if mode.line is None and line.is_like(mode.last)), None)
            if known is None and len(self._modes) < MODES:
                self._modes.append(known := _Heard(line))
            if known is not None:
                known.add(line)
        if not self._modes:
            return []
        lines = [mode.line for mode in self._modes]
        told = ", ".join(f"{line.frequency_hz:.2f} Hz {line.amplitude_nm:.1f} nm" for line in lines if line)
        heard = run_events.Vibrations(
            [None if line is None else round(line.frequency_hz, 4) for line in lines],
            [None if line is None else round(line.amplitude_nm, 2) for line in lines],
            told or "none",
        )
        return [heard, *self._tension(), *self._strokes()]

    def _tension(self) -> list[events.Event]:
        """A notice when the first mode has moved, and when all are back."""
        limit = MOVED / 2 if "film_tension" in self._said else MOVED
        moved = next((mode for mode in self._modes if abs(mode.moved) > limit), None)
        says = "" if moved is None else (
            f"the mirror's vibration at {moved.usual_hz:.2f} Hz moved by {moved.moved:+.1%}: the film's tension by "
            f"{2 * moved.moved:+.1%}; check clamping and pressure"
        )  # fmt: skip
        return self._notice("film_tension", says, "the mirror's vibrations are where they were")

    def _strokes(self) -> list[events.Event]:
        """A notice when the pump's strokes meet a mode, and when none is there any more."""
        near_hz = MOVED * self._stroke_hz
        lines = [mode.line for mode in self._modes if mode.line is not None]
        driven = next((line for line in lines if abs(line.frequency_hz - self._stroke_hz) < near_hz), None)
        says = "" if driven is None else (
            f"the pump's strokes, {self._stroke_hz:g} Hz, drive the mirror's vibration at {driven.frequency_hz:.2f} "
            f"Hz, {driven.amplitude_nm:.0f} nm; change the pump's speed or its mount"
        )  # fmt: skip
        return self._notice("pump_resonance", says, "no vibration of the mirror is at the pump's strokes")

    def _notice(self, name: str, says: str, over: str) -> list[events.Event]:
        """What is new of a matter: that it begins, or that it is over."""
        if bool(says) == (name in self._said):
            return []
        self._said ^= {name}
        return [events.Maintenance(name, says) if says else events.MaintenanceOver(name, over)]


@dataclass
class _Heard:
    """A mode over the searches."""

    last: VibrationMode
    line: VibrationMode | None = None  # of the last search; None where it was not heard
    all_hz: list[float] = field(default_factory=list)

    def add(self, line: VibrationMode) -> None:
        """Take its line of a search."""
        self.line = self.last = line
        self.all_hz.append(line.frequency_hz)

    @property
    def usual_hz(self) -> float:
        """Frequency of the first searches."""
        return float(np.median(self.all_hz[:_SEARCHES]))

    @property
    def moved(self) -> float:
        """Relative change since, once there are enough searches."""
        return float(np.median(self.all_hz[-_SEARCHES:])) / self.usual_hz - 1
