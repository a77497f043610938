"""Backlight bands found in the steps of one set, and divided out of its frames.

Derivation: section 9 of docs/explanation/metrology.md.
"""

from dataclasses import replace

import numpy as np

from membrane_ctrl.metrology.frame_checks.backlight_bands import (
    FREQUENCIES_PER_BIN,
    MOST_BANDS,
    WAVE_WIDTH,
    clear_power,
    fitted_waves,
    row_power,
    row_waves,
)
from membrane_ctrl.metrology.numerics.grouped_sums import sum_by_group
from membrane_ctrl.metrology.phase.frame_stack import Binned, FrameStack
from membrane_ctrl.metrology.phase.full_decoder import CONTRAST_SHARE
from membrane_ctrl.metrology.phase.pattern_sequence import AXES
from membrane_ctrl.model.arrays import FloatArray, IntArray

_FEWEST_STEPS = 4  # three leave no rest
_DARKEST = 0.2  # least light of a row over its mean
# Least power of a wave over that around it, in the mean over an axis' steps; 10 at most without
# bands.
_CLEAR_STEPS = 20.0
_FEWEST_BINS = 1_000
_ENOUGH_BINS = 15_000  # more only cost time
_SEARCHED_BINS = 60_000  # of all bins: among these are enough that see the fringes
_LEAST_SWING_PERCENTILE = 95  # the swing that `CONTRAST_SHARE` refers to
_HARMONICS = (2, 3, 4)  # of the fringes: the response of panel and camera
_TURNS = 3  # of a fit; the last one changes the largest bands by a thousandth
# Share of the largest eigenvalue below which amplitudes are not determined, and stay.
_SINGULAR = 1e-3
_NONE = np.zeros(0)
# Largest bands of a set that is not degraded: 5 % of their effect is left, which is 0.1 µm of
# figure at this size.
_GREAT = 0.05
# Limit of the bands' amplitude times the share of the rest that they do not explain: bands that
# wrong pictures seem to have explain little.
_UNEXPLAINED = 0.05


class _Steps:
    """The phase steps of one axis in n bins, and the bands of the N frames.

    Attributes
    ----------
    rad_per_row : (k,) array
        Frequencies of the bands.
    amplitudes : (N, 2 k) array
        Of cosines and sines in each frame, over the light.
    unexplained : float
        Largest amplitude times the share of the rest that the bands do not explain.
    """

    def __init__(
        self, stack: FrameStack, binned: Binned, frames: list[int], index: IntArray
    ) -> None:
        # The chosen bins: their rows in the picture, and their light (N, n) in each frame.
        self.frames = frames
        _, rows, columns = binned.means.shape
        self._row = index // columns
        self._rows = np.arange(rows)
        means = binned.means[frames].reshape(len(frames), -1)
        self._seen = np.take(means, index, axis=1)

        # Model of the steps: level, cosine and sine of a bin, and their least squares.
        self._shifts_rad = stack.shifts_rad(frames)
        self._design = stack.design(frames)
        self._inverse = np.linalg.pinv(stack.design(frames))

        # Begin without bands; what the steps leave then is what bands have to explain.
        self.unexplained = 0.0
        self.rad_per_row = _NONE
        self.amplitudes = np.zeros((len(frames), 0))
        self._fit()
        self._first_squares = max(float(np.sum(self._rest**2)), 1e-30)

    def row_gain(self, place: FloatArray | IntArray) -> FloatArray:
        """Factor (N, R) of the light of rows at these places (R,), in each frame."""
        bands = self.amplitudes @ row_waves(self.rad_per_row, place)
        return np.maximum(1 + bands, _DARKEST)

    def _fit(self) -> None:
        """Fit level and phasor of each bin to the light without the present bands.

        `_parts` (3, n) are level, cosine and sine; `_shown` (N, n) is what they show, `_lit` the
        same over the gain, `_rest` what they leave.
        """
        gain = self.row_gain(self._rows)[:, self._row]
        self._parts = self._inverse @ (self._seen / gain)
        self._shown = self._design @ self._parts
        self._rest = self._seen / gain - self._shown
        self._lit = self._shown / gain

    def _sum_rows(self, values: FloatArray) -> FloatArray:
        """Over each row (N, R), of values (N, n)."""
        return np.asarray(sum_by_group(self._row, values, self._rows.size))

    def residual_power(self) -> FloatArray:
        """Power of each frequency along the rows in what the steps leave, weighed with their light;
        the mean over the steps.
        """
        sums = self._sum_rows((self._rest - self._others) * self._shown)
        return np.asarray(row_power(sums).mean(axis=0))

    def light_difference(self, other: "_Steps") -> FloatArray:
        """Sums (2, R) of `fitted_waves` for the light by which the other axis differs."""
        level = self._parts[0]
        level_of_other = other._parts[0]
        scale = level @ level / (level_of_other @ level)
        difference = level_of_other * scale - level
        return self._sum_rows(np.stack([level * difference, level**2]))

    def share_along_rows(self) -> float:
        """1 if the fringes are along the rows, 0 if they cross them many times."""
        phasors = self._parts[1:]
        of_rows = np.sum(np.hypot(*self._sum_rows(phasors)))
        of_bins = np.sum(np.hypot(*phasors))
        return float(of_rows / of_bins)

    def solve(self, rad_per_row: FloatArray) -> float:
        """Fit the amplitudes of waves along the rows.

        The other unknowns, whose part of the rest is then known, are the flicker of each frame and
        the amplitudes of the fringes' harmonics.

        Parameters
        ----------
        rad_per_row : (k,) array
            Frequencies of the waves.

        Returns
        -------
        float
            `unexplained`.
        """
        count = len(self.frames)
        waves = row_waves(rad_per_row, self._rows)
        steady = np.ones(self._rows.size)
        off = np.eye(count) - self._design @ self._inverse  # the projector P

        # Fit, add what the rest shows of the amplitudes, and fit again.
        self.rad_per_row = rad_per_row
        self.amplitudes = np.zeros((count, len(waves)))
        turns = 1
        if len(waves):
            turns = _TURNS
        for _ in range(turns):
            self._fit()
            harmonics = self._free_harmonics(off)
            of_frames, of_harmonics = self._solve_unknowns(
                off, np.vstack([waves, steady]), harmonics
            )
            self.amplitudes += of_frames[:, :-1]
            flicker = of_frames[:, -1:]
            self._others = off @ (flicker * self._lit) + np.tensordot(of_harmonics, harmonics, 1)
        self._fit()

        # Bands that wrong pictures seem to have explain little of the rest.
        share_left = np.sum(self._rest**2) / self._first_squares
        self.unexplained = float(np.abs(self.amplitudes).max(initial=0.0) * share_left)
        return self.unexplained

    def _free_harmonics(self, off: FloatArray) -> FloatArray:
        """What the model of level and phasor leaves of the fringes' harmonics (h, N, n)."""
        _level, cosine, sine = self._parts
        swing = np.hypot(cosine, sine)
        psi_rad = np.arctan2(sine, cosine) + self._shifts_rad[:, None]
        harmonics = np.stack([swing * np.cos(n * psi_rad) for n in _HARMONICS])
        return np.asarray(off @ harmonics)

    def _solve_unknowns(
        self, off: FloatArray, waves: FloatArray, harmonics: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Least squares for the waves of each frame, and for the harmonics.

        Frame k leaves sum_j P_kj g_j m_j, so that the rows of the normal matrix need only the sums
        over each picture row of P_kj m_k m_j.

        Parameters
        ----------
        off : (N, N) array
            P.
        waves : (w, R) array
            Along the rows.
        harmonics : (h, N, n) array
            As `_free_harmonics` gives them.

        Returns
        -------
        of_frames, of_harmonics : (N, w) and (h,) arrays
        """
        count = len(self.frames)
        unknowns_of_frames = count * len(waves)

        # Normal equations of waves with waves.
        row_products = []
        for k in range(count):
            row_sums = self._sum_rows(self._lit[k] * self._lit)
            row_products.append(off[k][:, None] * row_sums)
        products = np.array(row_products)
        wave_matrix = np.einsum("jkr,pr,qr->jpkq", products, waves, waves)
        wave_matrix = wave_matrix.reshape(unknowns_of_frames, unknowns_of_frames)

        # Of waves with harmonics, and on the right-hand side of waves with the rest.
        fields = (*harmonics, self._rest)
        by_waves = np.array([self._sum_rows(self._lit * field) @ waves.T for field in fields])
        by_waves = by_waves.reshape(len(fields), -1)
        mixed = by_waves[:-1]
        wave_right = by_waves[-1]

        # Of harmonics with harmonics, and with the rest.
        flat = harmonics.reshape(len(harmonics), -1)
        matrix = np.block([[wave_matrix, mixed.T], [mixed, flat @ flat.T]])
        right = np.append(wave_right, flat @ self._rest.ravel())

        # Solved with a unit diagonal; an unknown without any effect stays 0.
        diagonal = np.diag(matrix)
        scale = np.sqrt(np.maximum(diagonal, 1e-12 * diagonal.max()))
        inverse = np.linalg.pinv(matrix / np.outer(scale, scale), _SINGULAR, hermitian=True)
        found = inverse @ (right / scale) / scale
        of_frames = found[:unknowns_of_frames].reshape(count, -1)
        of_harmonics = found[unknowns_of_frames:]
        return of_frames, of_harmonics


def remove_bands(
    stack: FrameStack, binned: Binned, known: FloatArray = _NONE
) -> tuple[FrameStack, Binned, FloatArray]:
    """Find the bands of a set and divide them out.

    Parameters
    ----------
    stack, binned : FrameStack, Binned
        The set, and its frames as means over bins.
    known : (k,) array
        Frequencies to begin with, rad per row of bins.

    Returns
    -------
    stack : FrameStack
        The set with the gain of its rows.
    binned : Binned
        The bins without bands.
    rad_per_row : (k,) array
        The bands' frequencies, `known` the first. All are unchanged, and these empty, where no
        bands are seen, and where an axis has three steps, which leave nothing that shows them.
    """
    axes = [[k for k in stack.sinusoids(axis) if k not in stack.unusable] for axis in AXES]
    if min(map(len, axes)) < _FEWEST_STEPS:
        return stack, binned, _NONE
    index = _with_fringes(binned, axes)
    if index.size < _FEWEST_BINS:
        return stack, binned, _NONE

    # Frequencies are searched in the axis whose fringes cross the rows: fringes along the rows look
    # like bands.
    x = _Steps(stack, binned, axes[0], index)
    y = _Steps(stack, binned, axes[1], index)
    across, other = sorted([x, y], key=_Steps.share_along_rows)
    rows = np.arange(binned.means.shape[1])
    across.solve(known)
    while True:
        found = _add_frequency(across.rad_per_row, across.residual_power(), rows)
        if found.size == across.rad_per_row.size:
            break
        across.solve(found)
    if not found.size or max(across.unexplained, other.solve(found)) > _UNEXPLAINED:
        return stack, binned, _NONE

    # Bands common to all steps of an axis bend none of its phases, but in the light of the other
    # axis the film would seem to move (`light_and_film.estimate_light_and_film`).
    y.amplitudes += fitted_waves(row_waves(found, rows), x.light_difference(y))

    # Bins and rows of pixels are divided by the gain.
    first_row = (1 - 1 / binned.bin_px) / 2
    pixel_rows = np.arange(stack.size_px[0]) / binned.bin_px - first_row  # in bins
    gain = np.ones((len(stack.patterns), pixel_rows.size))
    means = binned.means.copy()
    for steps in (x, y):
        gain[steps.frames] = steps.row_gain(pixel_rows)
        means[steps.frames] /= steps.row_gain(rows)[..., None].astype(np.float32)
    return replace(stack, gain=gain), replace(binned, means=means), found


def describe_bands(gain: FloatArray | None) -> str:
    """Reason for which a set with such gains (frames, rows) is degraded; empty if it is not."""
    if gain is None:
        return ""
    most = float(np.abs(gain - 1).max())
    if most <= _GREAT:
        return ""
    return f"bands of {most:.0%} of the light along the rows: expose for whole backlight pulses"


def _add_frequency(rad_per_row: FloatArray, power: FloatArray, rows: IntArray) -> FloatArray:
    """Frequencies (k,) or (k + 1,): one more if the power shows a wave that is none of them."""
    clear = clear_power(power, 1)
    if len(rad_per_row) == MOST_BANDS or np.max(clear) < _CLEAR_STEPS:
        return rad_per_row
    # The clearest band, and within it the frequency with most power.
    is_near = np.abs(np.arange(clear.size) - np.argmax(clear)) <= FREQUENCIES_PER_BIN
    peak = np.argmax(power * is_near)
    found_rad = 2 * np.pi * int(peak) / (FREQUENCIES_PER_BIN * rows.size)
    is_known = np.abs(rad_per_row - found_rad) < 2 * np.pi * WAVE_WIDTH / rows.size
    if is_known.any():
        return rad_per_row
    return np.append(rad_per_row, found_rad)


def _with_fringes(binned: Binned, axes: list[list[int]]) -> IntArray:
    """Bins (n,), enough of those in which both axes swing and nothing is saturated."""
    count = len(binned.means)
    stride = max(1, binned.means[0].size // _SEARCHED_BINS)
    means = binned.means.reshape(count, -1)[:, ::stride]
    swing = np.minimum(*[np.ptp(means[frames], axis=0) for frames in axes])
    least_swing = CONTRAST_SHARE * np.percentile(swing, _LEAST_SWING_PERCENTILE)
    clipped = binned.saturated.reshape(count, -1)[:, ::stride]
    is_saturated = clipped[[*axes[0], *axes[1]]].any(axis=0)
    usable: IntArray = stride * np.flatnonzero((swing > least_swing) & ~is_saturated)
    return usable[:: max(1, usable.size // _ENOUGH_BINS)]
