"""A figure with every frame: the window holds the newest frame of each phase step, whatever their ages.

The phasor of a bin is linear in its frames, so a new frame replaces the bin sums of its own step and nothing else has
to be read again. The steps are then unequal in time, which the motion correction takes care of: all of them are
brought to the mean displacement of the window, as in a cycle (see `motion`). Without a laser the film must stand
still over the length of the window.
"""

from collections.abc import Sequence

import numpy as np

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology import live, phasor
from membrane_ctrl.metrology.uncertainty.geometry_spread import GeometrySpread
from membrane_ctrl.model.arrays import ArrayLike, FloatArray
from membrane_ctrl.model.shape_estimate import ShapeEstimate


class SlidingWindow(live.LiveReconstructor):
    """The live reconstruction, renewed by each frame.

    Begin with `full`; then `frame` for each fringe frame, in any order. After a verdict whose reason starts with
    "tracking lost" take a full cycle again. Whole fringes-only cycles (`fringes`) may be mixed in.
    """

    def __init__(
        self,
        optics: OpticsConfig,
        bin_px: int = 4,
        *,
        laser_noise_um: float = 0.3,
        shifts_rad: ArrayLike | None = None,
        spread: GeometrySpread | None = None,
    ) -> None:
        super().__init__(optics, bin_px, laser_noise_um=laser_noise_um, shifts_rad=shifts_rad, spread=spread)
        self._fringe_slots: list[int] = np.r_[self._slots.sinusoids].tolist()
        count = len(self._fringe_slots)
        self._times, self._readings = np.full(count, np.nan), np.full(count, np.nan)
        self._burnt = np.zeros((count, *self._binner.saturated.shape), bool)
        self._burnt_frames = np.zeros(count, bool)

    def full(self, frames: Sequence[phasor.Image], time_s: ArrayLike, displacement_um: ArrayLike) -> ShapeEstimate:
        """One full cycle, whose sinusoids fill the window; else as `LiveReconstructor.full`."""
        estimate = super().full(frames, time_s, displacement_um)
        times, readings = (np.asarray(column, float)[self._fringe_slots] for column in (time_s, displacement_um))
        self._fill(times, readings)
        return estimate

    def fringes(self, frames: Sequence[phasor.Image], time_s: ArrayLike, displacement_um: ArrayLike) -> ShapeEstimate:
        """One fringes-only cycle, which fills the window; else as `LiveReconstructor.fringes`."""
        estimate = super().fringes(frames, time_s, displacement_um)
        self._fill(np.asarray(time_s, float), np.asarray(displacement_um, float))
        return estimate

    def frame(
        self, image: phasor.Image, step: int, time_s: float, displacement_um: float = float("nan")
    ) -> ShapeEstimate:
        """Renew the estimate with one frame.

        Raises ValueError for an unknown step, or an image of wrong size or type.

        Parameters
        ----------
        image : (height, width) uint8 or uint16 array
            The frame.
        step : int
            What it shows: its place in `patterns.fringe_sequence`, 0..2N-1.
        time_s, displacement_um : float
            Of its exposure; NaN without a laser reading.

        Returns
        -------
        ShapeEstimate
            `time_s` and `displacement_um` are means over the window: half a window behind the frame.
        """
        if not 0 <= step < len(self._fringe_slots):
            raise ValueError(f"step {step} is not one of the {len(self._fringe_slots)} of a fringes-only cycle")
        self._binner.clear()
        self._binner.add([image], [self._fringe_slots[step]])
        self._times[step], self._readings[step] = time_s, displacement_um
        self._note_saturation(step)
        if self._tracked is None:
            reason = "tracking lost: no accepted full cycle to follow"
            return live._rejected("fringes", self._times, self._readings, reason)
        return self._follow("fringes", self._tracked, self._times, self._readings)

    def _fill(self, times: FloatArray, readings: FloatArray) -> None:
        """The window after a cycle: what is saturated in it counts for every step until that step is renewed."""
        self._times, self._readings = times.copy(), readings.copy()
        self._burnt[:] = self._binner.saturated > 0
        self._burnt_frames[:] = self._burnt[0].any()

    def _note_saturation(self, step: int) -> None:
        """Leave in the binner the bins that are saturated in any frame of the window."""
        np.greater(self._binner.saturated, 0, out=self._burnt[step])
        self._burnt_frames[step] = self._burnt[step].any()
        if self._burnt_frames.any():
            self._binner.saturated[:] = self._burnt.any(axis=0)
