"""The frames of a live cycle as sums over bins, without bands and without previous pictures.

A frame is summed once; everything after it works on bins (section 1 of
docs/explanation/metrology.md). Two errors of the light are removed from the sums: bands of a pulsed
backlight (section 9) and the share of the previous picture (section 10). A full cycle finds them, a
fringes-only cycle uses what the last full one found.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from firmware_iface.optical_roles import Pattern
from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.metrology.frame_checks import band_removal, image_lag
from membrane_ctrl.metrology.phase import bin_sums, pattern_sequence
from membrane_ctrl.metrology.phase.clip_levels import ClipLevels, find_clip_levels
from membrane_ctrl.metrology.phase.frame_stack import Binned, FrameStack
from membrane_ctrl.model.arrays import (
    AnyArray,
    BoolArray,
    FloatArray,
    Image,
    IntArray,
    Singles,
)


class CycleSums:
    """Sums over bins of the frames of the present cycle.

    Parameters
    ----------
    optics : OpticsConfig
        Camera and pattern.
    bin_px : int
        Side of the bins.
    shifts_rad : (2, N) array
        Phase steps of x and of y.

    Attributes
    ----------
    lag : ImageLag
        Share of the previous picture, as the last full cycle showed it.
    doubt : str
        Why the present cycle is degraded by its light, for people; empty if it is not.
    """

    def __init__(self, optics: OpticsConfig, bin_px: int, shifts_rad: FloatArray) -> None:
        self._optics = optics
        self._bin_px = bin_px
        self._shifts_rad = shifts_rad
        self._slots = pattern_sequence.FullSlots(optics.pattern.steps)
        self._full_scale_adu = 2**optics.camera.bits - 1
        size = (optics.camera.height_px, optics.camera.width_px)
        self._binner = bin_sums.Binner(*size, bin_px, self._full_scale_adu, self._slots.count)
        fringes = pattern_sequence.fringe_sequence(optics.pattern)
        self._patterns = tuple(
            replace(pattern, shift_rad=float(shift))
            for pattern, shift in zip(fringes, shifts_rad.ravel(), strict=True)
        )
        # Frequencies of the bands that the last full cycle found.
        self._bands_rad = np.zeros(0)
        self.lag = image_lag.ImageLag.unknown()
        self.doubt = ""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of bins."""
        rows, columns = self._binner.saturated.shape
        return rows, columns

    def sum_full(self, frames: Sequence[Image]) -> None:
        """Sum the frames of a full cycle, and remove the bands that they show.

        Parameters
        ----------
        frames : sequence of (height, width) arrays
            In the order of `pattern_sequence.full_sequence`.

        Raises
        ------
        ValueError
            For frames of another size or type.
        """
        sinusoids = np.r_[self._slots.sinusoids].tolist()
        self._binner.clear_saturation()
        shown = [frames[k] for k in sinusoids]
        self._binner.white_adu = find_clip_levels(shown, self._full_scale_adu).white_adu
        self._binner.sum_frames(frames, range(len(frames)), watched=sinusoids)
        self._remove_bands(np.zeros(0))

    def sum_fringes(self, frames: Sequence[Image]) -> None:
        """Sum the frames of a fringes-only cycle, and remove bands and lag if the last full cycle
        had them.

        Parameters
        ----------
        frames : sequence of (height, width) arrays
            In the order of `pattern_sequence.fringe_sequence`.

        Raises
        ------
        ValueError
            For frames of another size or type.
        """
        self._binner.clear_saturation()
        self._binner.sum_frames(frames, np.r_[self._slots.sinusoids].tolist())
        if self._bands_rad.size:
            self._remove_bands(self._bands_rad)
        self._remove_lag_of_fringes()

    def of_sinusoids(self) -> list[AnyArray]:
        """Bin sums (N, bins) of the sinusoids of x and of y."""
        return [
            self._binner.sums[slots].reshape(self._slots.steps, -1)
            for slots in self._slots.sinusoids
        ]

    def take_means(self, index: IntArray) -> Singles:
        """Means (frames, n) of some bins in all frames of a full cycle."""
        # in single precision, which holds every sum exactly
        means = np.empty((self._slots.count, index.size), np.float32)
        sums = self._binner.sums[: self._slots.count].reshape(self._slots.count, -1)
        for of_frame, sums_of_frame in zip(means, sums, strict=True):
            of_frame[:] = np.take(sums_of_frame, index)
        means /= np.float32(self._bin_px**2)
        return means

    def find_saturated(self, index: IntArray) -> BoolArray:
        """Which (n,) of some bins have a clipped pixel in a sinusoid."""
        return np.asarray(self._binner.saturated.ravel()[index] > 0)

    def mean_light(self) -> FloatArray:
        """Mean light (rows, columns) of the bins over the sinusoids."""
        sinusoids = self._binner.sums[np.r_[self._slots.sinusoids]]
        return np.asarray(sinusoids.mean(axis=0) / self._bin_px**2)

    def remove_lag_of_full(
        self, index: IntArray, places_px: FloatArray, phase_rad: FloatArray
    ) -> None:
        """Find the share of the previous picture in the frames of a full cycle, and remove it.

        The first frame has no previous picture: its pattern is on the screen while the former cycle
        is computed.

        Parameters
        ----------
        index : (n,) int array
            Bins that see the pattern.
        places_px : (2, n) array
            Their columns and rows.
        phase_rad : (2, n) array
            Their absolute phases.
        """
        # The patterns of the cycle with the phase steps that were taken.
        patterns = list(pattern_sequence.full_sequence(self._optics.pattern))
        for slots, shifts in zip(self._slots.sinusoids, self._shifts_rad, strict=True):
            for slot, shift in zip(range(slots.start, slots.stop), shifts, strict=True):
                patterns[slot] = replace(patterns[slot], shift_rad=float(shift))
        stack = self._stack_without_frames(tuple(patterns))

        # A sample of the bins shows the shares. Saturated bins are known of the sinusoids; other
        # frames do not need them.
        some = image_lag.choose_lag_bins(index)
        bins = index[some]
        means = self.take_means(bins)
        is_saturated = np.broadcast_to(self.find_saturated(bins), means.shape)
        levels = ClipLevels(self._binner.white_adu)
        sample = Binned(self._bin_px, means, is_saturated, levels)
        self.lag = image_lag.find_image_lag(stack, sample, phase_rad[:, some], places_px[:, some])

        # All bins are corrected.
        if self.lag.corrected:
            binned = self._mean_of_bins(self._binner.sums[: self._slots.count])
            corrected = image_lag.remove_image_lag(stack, binned, self.lag)
            slots_of_fringes = np.r_[self._slots.sinusoids]
            self._binner.sums[slots_of_fringes] = np.rint(
                corrected.means[slots_of_fringes] * self._bin_px**2
            )
        self.doubt = self.doubt or image_lag.describe_image_lag(self.lag)

    def _remove_bands(self, known: FloatArray) -> None:
        """Remove bands of the backlight from the sums of the sinusoids.

        `known` are the frequencies that the last full cycle found; empty in a full cycle.
        """
        slots = np.r_[self._slots.sinusoids]
        binned = self._mean_of_bins(self._binner.sums[slots])
        stack = self._stack_without_frames(self._patterns)
        stack, binned, found = band_removal.remove_bands(stack, binned, known)
        self._bands_rad = known if known.size else found
        self.doubt = band_removal.describe_bands(stack.gain)
        if known.size and not found.size:
            self.doubt = (
                "bands of the backlight could not be separated from other changes in this cycle"
            )
        elif found.size:
            # Sums are integers: the corrected ones are rounded.
            self._binner.sums[slots] = np.rint(binned.means * self._bin_px**2)

    def _remove_lag_of_fringes(self) -> None:
        """Remove the share of the previous picture that the last full cycle found."""
        if not self.lag.corrected:
            return
        slots = np.r_[self._slots.sinusoids]
        stack = self._stack_without_frames(self._patterns)
        binned = self._mean_of_bins(self._binner.sums[slots])
        corrected = image_lag.remove_image_lag(stack, binned, self.lag)
        self._binner.sums[slots] = np.rint(corrected.means * self._bin_px**2)

    def _stack_without_frames(self, patterns: tuple[Pattern, ...]) -> FrameStack:
        """The patterns of a cycle, of which only the bins are needed."""
        none = np.empty((len(patterns), self._optics.camera.height_px, 0), np.uint8)
        return FrameStack(none, patterns, np.full(len(patterns), math.nan), {})

    def _mean_of_bins(self, sums: AnyArray) -> Binned:
        """Sums of frames as means."""
        # in single precision, which holds every sum exactly: a third of the time
        means = sums.astype(np.float32)
        means /= np.float32(self._bin_px**2)
        saturated = np.broadcast_to(self._binner.saturated > 0, means.shape)
        return Binned(self._bin_px, means, saturated, ClipLevels(self._binner.white_adu))
