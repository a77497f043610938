"""Tracking in a hold: a full cycle anchors it, then every frame of the crossed pattern is a
figure.

The controller's inputs are recorded exactly, twenty figures a second of them: numbers are rounded
to what their noise leaves of them, and the covariance stays the same for many frames.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from firmware_iface.roles import Pattern
from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.cycle import live_reconstructor
from membrane_ctrl.metrology.figure import bin_figure
from membrane_ctrl.metrology.frame_checks import bin_view, set_check
from membrane_ctrl.metrology.phase import frame_stack, pattern_sequence
from membrane_ctrl.metrology.reconstruction import slope_noise
from membrane_ctrl.metrology.tracking.scene_from_reference import make_scene
from membrane_ctrl.metrology.tracking.step_solution import ENOUGH_STEPS
from membrane_ctrl.metrology.tracking.tracked_frame import TrackedFrame
from membrane_ctrl.metrology.tracking.tracker import Tracker
from membrane_ctrl.model.arrays import ArrayLike, FloatArray, Image
from membrane_ctrl.model.shape_estimate import ShapeEstimate

# A gust may lose the order of a few frames, which the next ones have again.
LOST_S = 1.0
# A new covariance is 100 times a figure in the record: one for each step of the pattern.
COVARIANCE_S = 10.0
# A hand or a lamp goes away by itself, and meanwhile a full cycle would be rejected too.
REJECTED_S = 10.0
# The interval between frames is longer in two of three steps: vibrations faster than half the frame
# rate then have different aliases (`modes`).
_SLOWER = (1.0, 1.09, 1.17)
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
        except (bin_view.NoFigureError, ValueError) as error:
            times, readings = np.asarray(time_s, float), np.asarray(displacement_um, float)
            return live_reconstructor.make_rejected_cycle(
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
            return live_reconstructor.make_rejected_cycle(
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
        return _make_estimate(found, reading_um, self._astray(found), self._urad_per_rad)

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
        seen = set_check.check_set(stack, optics)
        period_mm = optics.pattern.periods * optics.pattern.period_mm / self.pattern.index
        scene = make_scene(optics, seen, bin_figure.bin_figure(optics, seen), period_mm)
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


def _make_estimate(
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
        sag_sigma_um=round(found.steady_sag_sigma_um, _UM + 1),
        displacement_um=reading_um,
        slope_residual_urad=round(found.rest_share * urad, 2),
        valid_fraction=round(found.used_share, _SHARE),
        modulation_median_adu=round(found.swing_adu, 1),
        saturated_fraction=round(found.saturated_share, _SHARE),
        verdict=found.verdict,
        reason=found.reason,
        tracking_lost=tracking_lost,
    )
