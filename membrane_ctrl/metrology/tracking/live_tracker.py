"""Tracking in a hold: a full cycle is the reference, then every frame of the crossed pattern gives
a figure.

The controller's inputs are recorded exactly, twenty figures a second of them: numbers are rounded
to what their noise leaves of them, and the covariance stays the same for many frames.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from firmware_iface.optical_roles import Pattern
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

# A full cycle is needed after frames without fringe orders for this long: a gust may lose the order
# of a few frames, and the next ones have it again.
LOST_S = 1.0
# A full cycle is needed after rejected frames for this long: a hand or a lamp goes away by itself,
# and meanwhile a full cycle would be rejected too.
REJECTED_S = 10.0
# Interval between new covariances: in the record, one takes as much space as 100 figures.
COVARIANCE_S = 10.0
# Factors of the interval between frames: with three rates, vibrations faster than half the frame
# rate have different aliases (`vibrations.mode_search`).
_INTERVAL_FACTORS = (1.0, 1.09, 1.17)
# Decimals of recorded numbers.
_UM_DECIMALS = 3  # a nanometre
_SHARE_DECIMALS = 4  # a hundredth of a per cent
_TIME_DECIMALS = 6  # a microsecond


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
        self._optics = optics
        self._cycles = cycles
        self.patterns = crossed_patterns(periods)
        self._step_s = step_s
        self._exposure_s = exposure_s
        self._tracker: Tracker | None = None
        self._urad_per_rad = math.nan  # slope that turns the phases by 1 rad
        self._covariance_um2 = np.empty((0, 0))
        self._begin()

    def _begin(self) -> None:
        """Begin with the first step of the pattern, and with frames that are not lost."""
        self._step = 0
        self._stepped_s = -math.inf
        self._covariance_until_s = -math.inf
        self._lost_since_s = math.inf
        self._rejected_since_s = math.inf

    @property
    def pattern(self) -> Pattern:
        """What the next crossed frame must show."""
        return self.patterns[self._step % ENOUGH_STEPS]

    @property
    def interval_factor(self) -> float:
        """Interval to the next frame over the shortest one."""
        return _INTERVAL_FACTORS[self._step % len(_INTERVAL_FACTORS)]

    def measure_full(
        self, frames: Sequence[Image], time_s: ArrayLike, displacement_um: ArrayLike
    ) -> ShapeEstimate:
        """Measure the figure of a full cycle, which becomes the reference of the frames after it.

        Parameters
        ----------
        frames : sequence of (H, W) arrays
            One for each pattern of a full cycle, in their order; of the camera's depth.
        time_s : (n,) array
            Middle of each exposure.
        displacement_um : (n,) array
            The laser's reading then; NaN if missing.

        Returns
        -------
        ShapeEstimate
            Rejected, too, if its bins can be no reference for the frames after it.
        """
        estimate = self._cycles.measure_full(frames, time_s, displacement_um)
        self._tracker = None
        if estimate.verdict == "rejected":
            return estimate
        try:
            self._tracker = self._make_tracker(frames, np.asarray(displacement_um, float))
        except (bin_view.NoFigureError, ValueError) as error:
            return live_reconstructor.make_rejected_cycle(
                "full",
                np.asarray(time_s, float),
                np.asarray(displacement_um, float),
                f"no anchor for tracking: {error}",
            )
        self._begin()
        return estimate

    def measure_fringes(
        self, frames: Sequence[Image], time_s: ArrayLike, displacement_um: ArrayLike
    ) -> ShapeEstimate:
        """Measure the figure of one frame of `pattern`.

        Parameters
        ----------
        frames : sequence of one (height, width) array
        time_s, displacement_um : (1,) arrays
            Start of the exposure, and laser reading during it; NaN without one.

        Returns
        -------
        ShapeEstimate
            With `tracking_lost` if a full cycle must follow.
        """
        at_s = round(float(np.asarray(time_s)[0]) + self._exposure_s / 2, _TIME_DECIMALS)
        reading_um = round(float(np.asarray(displacement_um)[0]), _UM_DECIMALS)
        if self._tracker is None:
            return live_reconstructor.make_rejected_cycle(
                "track",
                np.array([at_s]),
                np.array([reading_um]),
                live_reconstructor.NOTHING_TO_FOLLOW,
                tracking_lost=True,
            )
        shown = self.pattern
        found = self._tracker.track_frame(
            frames[0], (shown.shift_rad, shown.shift_y_rad), at_s, reading_um
        )
        if found.verdict != "rejected":
            self._advance_pattern(at_s)
            if at_s >= self._covariance_until_s:
                self._covariance_um2 = found.covariance_um2
                self._covariance_until_s = at_s + COVARIANCE_S
            found = replace(found, covariance_um2=self._covariance_um2)
        needs_full_cycle = self._update_losses(found)
        return _make_estimate(found, reading_um, needs_full_cycle, self._urad_per_rad)

    def prepare(self) -> None:
        """Compute in advance what the next frame needs, while its pattern settles."""
        if self._tracker is not None:
            self._tracker.prepare((self.pattern.shift_rad, self.pattern.shift_y_rad))

    def _make_tracker(self, frames: Sequence[Image], displacement_um: FloatArray) -> Tracker:
        """A tracker whose reference is a full cycle.

        Raises NoFigureError or ValueError if the cycle gives no scene for the crossed pattern.
        """
        # A geometry without a reference belongs to the first laser reading of the hold.
        optics = self._optics
        known = displacement_um[np.isfinite(displacement_um)]
        if optics.geometry.reference_displacement_um is None and known.size:
            geometry = optics.geometry.model_copy(
                update={"reference_displacement_um": float(known[0])}
            )
            optics = optics.model_copy(update={"geometry": geometry})
            self._optics = optics

        # The cycle as a capture set: checked, measured, and turned into a scene.
        patterns = tuple(pattern_sequence.full_sequence(optics.pattern))
        pictures: Any = np.asarray(frames)  # of one kind, as the frames are
        stack = frame_stack.FrameStack(pictures, patterns, displacement_um, {})
        checked = set_check.check_set(stack, optics)
        figure = bin_figure.bin_figure(optics, checked)
        period_mm = optics.pattern.periods * optics.pattern.period_mm / self.pattern.index
        scene = make_scene(optics, checked, figure, period_mm)

        gain = slope_noise.slope_per_screen(
            scene.tracer.geometry, scene.surface.radius_mm, scene.surface.sag_mm
        )
        self._urad_per_rad = 1e6 * float(np.sqrt(np.sum(gain) / 2)) / scene.rad_per_mm
        camera = optics.camera
        size_px = camera.height_px, camera.width_px
        return Tracker(
            scene,
            size_px,
            2**camera.bits - 1,
            camera.noise_adu,
            stack.mean_reading_um,
            checked.image.describe(),
        )

    def _advance_pattern(self, now_s: float) -> None:
        """Go to the next step of the pattern if it is time; the first five follow each other."""
        if self._step < ENOUGH_STEPS or now_s - self._stepped_s >= self._step_s:
            self._step += 1
            self._stepped_s = now_s

    def _update_losses(self, found: TrackedFrame) -> bool:
        """Update since when frames are lost or rejected; return whether a full cycle is needed."""
        is_rejected = found.verdict == "rejected"
        if not is_rejected:
            self._rejected_since_s = math.inf
        self._rejected_since_s = min(self._rejected_since_s, found.time_s)
        if found.lost:
            self._lost_since_s = min(self._lost_since_s, found.time_s)
        else:
            self._lost_since_s = math.inf
        lost_for_long = found.time_s - self._lost_since_s >= LOST_S
        rejected_for_long = is_rejected and found.time_s - self._rejected_since_s >= REJECTED_S
        return lost_for_long or rejected_for_long


def crossed_patterns(periods: int) -> tuple[Pattern, ...]:
    """Return the five steps of the crossed pattern, `periods` fringes over the screen's pattern.

    72 degrees in x and 144 degrees in y from step to step separate the axes.
    """
    turn = 2 * math.pi
    patterns = []
    for k in range(ENOUGH_STEPS):
        shift_x_rad = turn * k / ENOUGH_STEPS
        shift_y_rad = turn * (2 * k % ENOUGH_STEPS) / ENOUGH_STEPS
        patterns.append(Pattern("crossed", "", periods, shift_x_rad, shift_y_rad=shift_y_rad))
    return tuple(patterns)


def _make_estimate(
    found: TrackedFrame, reading_um: float, tracking_lost: bool, urad_per_rad: float
) -> ShapeEstimate:
    """The figure of a frame for control and recorder, rounded to what its noise leaves of it.

    `urad_per_rad` is the slope that turns the phases by 1 rad.
    """
    # Adding 0 turns a minus zero into a zero, which is a whole number to the recorder.
    coeffs_um = np.round(found.coeffs_um, _UM_DECIMALS) + 0.0
    return ShapeEstimate(
        time_s=found.time_s,
        kind="track",
        coeffs_um=coeffs_um,
        hencky_um=round(found.hencky_um, _UM_DECIMALS),
        covariance_um2=found.covariance_um2,
        # One digit more: equal sags show a camera that repeats a frame.
        sag_um=round(found.sag_um, _UM_DECIMALS + 1),
        sag_change_sigma_um=round(found.sag_change_sigma_um, _UM_DECIMALS + 1),
        displacement_um=reading_um,
        slope_residual_urad=round(found.rest_share * urad_per_rad, 2),
        valid_fraction=round(found.used_share, _SHARE_DECIMALS),
        modulation_median_adu=round(found.swing_adu, 1),
        saturated_fraction=round(found.saturated_share, _SHARE_DECIMALS),
        verdict=found.verdict,
        reason=found.reason,
        tracking_lost=tracking_lost,
    )
