"""Bands that a pulsed backlight leaves in the rows of a rolling shutter.

Each row sees another part of the pulses, so that the light of a picture is multiplied by waves
along its rows. Their frequencies stay, their amplitudes and phases are others in each frame. Where
bands are as wide as the fringes, a fit without them takes them for shape. What it leaves shows
them elsewhere: a wave found there joins the fit's unknowns.

`Bands` are those of frames of crossed fringes, one after the other. `band_removal.remove_bands`
finds them in the phase steps of a set: frame k shows g_k m_k, with the gain g_k = 1 + a_k w of its
rows, of which level, swing and phase leave P (g m), P the projector off their columns. Least
squares over the bins give a; the panel's harmonics and a flickering lamp are unknowns, too.
Derivation: section 9 of docs/explanation/metrology.md.
"""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from membrane_ctrl.metrology.numerics.grouped_sums import sum_by_group
from membrane_ctrl.model.arrays import FloatArray, IntArray, Singles

# Widths and frequencies are in bands over the picture's height.
_LEAST_BANDS = 4  # maps of the light's terms follow wider ones
WAVE_WIDTH = 2  # width of one wave in the spectrum: two of them closer than this are the same
_AROUND = 10  # half width of the range that a wave's power is compared with
MOST_BANDS = 6  # waves: the power of pulses falls as the fourth power of their harmonics
FREQUENCIES_PER_BIN = 16  # steps of the frequency in one band over the picture's height

# Least power of a wave over the median around it and of all: of one frame, and of the mean over
# some. Without bands it reaches 22 in a thousand frames. A fit leaves little of bands as wide as
# the fringes: 100 where figures were 13 sigma off.
_CLEAR = 30.0
_CLEAR_MEAN = 25.0
# The same of the mean after five frames, which has reached 40 % of its value: weak bands, too,
# spoil the light that the first frames give.
_CLEAR_FIRST = 6.0
_KEEPS = 0.9  # share of the former frames in the mean


class Bands:
    """The waves along the rows that frames have shown.

    Parameters
    ----------
    row : (n,) int array
        Row of each bin.

    Attributes
    ----------
    waves : (2 k, R) array
        Cosines, then sines, of the k known frequencies in the picture's R rows.
    """

    def __init__(self, row: IntArray) -> None:
        self.row = row
        self._place = np.arange(int(row.max()) + 1) - row.mean()
        self._rad_per_row = np.zeros(0)
        # Of each frequency, the sum of squares by which `refine` has determined it.
        self._determined = np.zeros(0)
        self.waves = np.zeros((0, self._place.size), np.float32)
        self._steady = np.ones(row.size, np.float32)
        # Mean over the frames of the clear power of each frequency.
        self._mean = np.zeros(self._place.size // 2 * FREQUENCIES_PER_BIN)

    def gain_of_bins(self, amplitudes: FloatArray) -> Singles:
        """What multiplies the light of each bin (n,), from the amplitudes (2 k,) of the waves."""
        if not amplitudes.size:
            return self._steady
        gain_of_rows = np.asarray(1 + amplitudes @ self.waves, np.float32)
        return gain_of_rows[self.row]

    def sum_over_rows(self, values: Singles) -> FloatArray:
        """Sums (k, R) over each row, of values (k, n)."""
        return np.asarray(sum_by_group(self.row, values, self._place.size))

    def add_wave_of_frame(self, rows: FloatArray) -> bool:
        """Whether the rest of a fit with all known waves shows one more, which is then added.

        `rows` (2, R) are the sums of `fitted_waves`.
        """
        clear = clear_power(row_power(rows[0]), _LEAST_BANDS)
        self._mean = _KEEPS * self._mean + (1 - _KEEPS) * clear
        return self._add_clearest_wave(np.maximum(clear / _CLEAR, self._mean / _CLEAR_MEAN))

    def add_wave_of_first_frames(self) -> bool:
        """Whether the first frames show one more wave together, which is then added."""
        return self._add_clearest_wave(self._mean / _CLEAR_FIRST)

    def _add_clearest_wave(self, clear: FloatArray) -> bool:
        """Add the clearest wave if it is clear enough and not known; returns whether it was added.

        `clear` is the power of each frequency over what a wave must have.
        """
        # Its frequency, which must be farther from the known ones than a line is wide.
        rows = self._place.size
        found_rad = 2 * np.pi * int(np.argmax(clear)) / (FREQUENCIES_PER_BIN * rows)
        is_other = np.abs(self._rad_per_row - found_rad) > 2 * np.pi * WAVE_WIDTH / rows
        if len(self._rad_per_row) == MOST_BANDS or not is_other.all() or np.max(clear) < 1:
            return False

        # The mean power is that of other waves from now on: begin again.
        self._mean *= 0
        self._rad_per_row = np.append(self._rad_per_row, found_rad)
        self._determined = np.append(self._determined, 0.0)
        self._evaluate_waves()
        return True

    def keep_first_waves(self, count: int) -> None:
        """Forget all waves but those of the first `count` of 2 k amplitudes."""
        self._rad_per_row = self._rad_per_row[: count // 2]
        self._determined = self._determined[: count // 2]
        self._evaluate_waves()

    def refine_frequencies(self, rows: FloatArray, amplitudes: FloatArray) -> None:
        """Move the frequencies by one step of least squares on what a fit leaves.

        Parameters
        ----------
        rows : (2, R) array
            Sums of `fitted_waves`, of the fit with these amplitudes.
        amplitudes : (2 k,) array
            Amplitudes of the cosines and sines.
        """
        cosine, sine = np.split(self.waves, 2)
        of_cosine, of_sine = np.split(amplitudes[:, None], 2)
        # Change of the waves per rad of change of a row's phase: d/df (a cos f r + b sin f r).
        change = self._place * (of_sine * cosine - of_cosine * sine)
        # Over all frames: the frequency stays if bands vanish.
        self._determined = self._determined + change**2 @ rows[1]
        step_rad = change @ rows[0] / np.maximum(self._determined, 1e-30)
        self._rad_per_row = self._rad_per_row + step_rad
        self._evaluate_waves()

    def _evaluate_waves(self) -> None:
        self.waves = row_waves(self._rad_per_row, self._place).astype(np.float32)


def row_power(rows: FloatArray) -> FloatArray:
    """Power (..., frequencies) along the rows (..., R).

    Frequencies are in steps of 1 / `FREQUENCIES_PER_BIN` bands over the R rows, up to R // 2 bands.
    """
    count = rows.shape[-1]
    spectrum = np.fft.rfft(rows, FREQUENCIES_PER_BIN * count)
    return np.abs(spectrum[..., : count // 2 * FREQUENCIES_PER_BIN]) ** 2


def fitted_waves(waves: FloatArray | Singles, rows: FloatArray) -> FloatArray:
    """Least squares for the amplitudes of waves along the rows.

    Parameters
    ----------
    waves : (2 k, R) array
        Cosines and sines.
    rows : (2, R) array
        Sums over the bins of each row: of light times rest, and of light squared.

    Returns
    -------
    (2 k,) array
        Amplitudes, relative to the light.
    """
    normal = (waves * rows[1]) @ waves.T
    return np.asarray(np.linalg.solve(normal, waves @ rows[0]), float)


def clear_power(power: FloatArray, least_bands: int) -> FloatArray:
    """Power of waves of the backlight over that of chance.

    A band is narrow in frequency, all else is broad. Section 9 of docs/explanation/metrology.md.

    Parameters
    ----------
    power : (m,) array
        Power by frequency, rising, `FREQUENCIES_PER_BIN` values for each wave over the picture.
    least_bands : int
        Least number of waves over the picture; wider ones are taken for shape or for a lamp.

    Returns
    -------
    (m,) array
        Power over the larger of two medians, that around the frequency and that of all; 0 for waves
        wider than 1 / `least_bands` of the picture.
    """
    means = power.reshape(-1, FREQUENCIES_PER_BIN).mean(axis=1)
    # The running median, by hand: scipy.ndimage would take 0.15 s to load.
    padded = np.pad(means, _AROUND, mode="symmetric")
    windows = sliding_window_view(padded, 2 * _AROUND + 1)
    of_neighbours = np.partition(windows, _AROUND, axis=1)[:, _AROUND]
    around = np.maximum(of_neighbours, np.median(means) + 1e-30)
    clear = power / np.repeat(around, FREQUENCIES_PER_BIN)
    clear[: least_bands * FREQUENCIES_PER_BIN] = 0.0
    return np.asarray(clear)


def row_waves(rad_per_row: FloatArray, place: FloatArray | IntArray) -> FloatArray:
    """Waves along the rows of a picture, as columns of a fit.

    Parameters
    ----------
    rad_per_row : (k,) array
        Frequencies.
    place : (rows,) array
        Number of each row.

    Returns
    -------
    (2 k, rows) array
        Cosines, then sines.
    """
    phase_rad = rad_per_row[:, None] * place
    return np.concatenate([np.cos(phase_rad), np.sin(phase_rad)])
