"""Bands that a pulsed backlight leaves in the rows of a rolling shutter.

Each row sees another part of the pulses, so that the light of a picture is multiplied by waves
along its rows. Their frequencies stay, their amplitudes and phases are others in each frame. Where
bands are as wide as the fringes, a fit without them takes them for shape. What it leaves shows
them elsewhere: a wave found there joins the fit's unknowns.

`Bands` are those of frames of crossed fringes. `without_bands` finds them in the phase steps of a
set: frame k shows g_k m_k, with the gain g_k = 1 + a_k w of its rows, of which level, swing and
phase leave P (g m), P the projector off their columns. Least squares over the bins give a; the
panel's harmonics and a flickering lamp are unknowns, too.
"""

import numpy as np
from scipy import ndimage

from membrane_ctrl.metrology.numerics.grouped_sums import sums_by
from membrane_ctrl.model.arrays import FloatArray, IntArray, Singles

_LEAST_BANDS = 4  # in the picture: maps of the terms follow wider ones
# Power over the median around it and of all, of one frame and of the mean over some. Without bands
# it reaches 22 in a thousand frames. Of bands as wide as the fringes a fit leaves little: 100 where
# figures were 13
# sigma off.
_CLEAR, _CLEAR_MEAN = 30.0, 25.0
# of four tenths of a mean, which five frames make: weak bands, too, spoil the light they give
_CLEAR_FIRST = 6.0
_KEEPS = 0.9  # share of the former frames in the mean
WAVE_WIDTH, _AROUND = (
    2,
    10,
)  # bands in the picture: a wave's own width, and where the power around it is judged
MOST_BANDS = 6  # waves: the power of pulses falls as the fourth power of their harmonics
FREQUENCIES_PER_BIN = 16  # steps of the frequency in one over the picture's height


class Bands:
    """The waves along the rows that frames have shown; `row` (n,) is that of each bin."""

    def __init__(self, row: IntArray) -> None:
        self.row = row
        self._place = np.arange(int(row.max()) + 1) - row.mean()
        self._rad_per_row = self._told = np.zeros(0)
        self.waves = np.zeros((0, self._place.size), np.float32)  # (2 k, R): cosines, sines
        self._steady, self._mean = (
            np.ones(row.size, np.float32),
            np.zeros(self._place.size // 2 * FREQUENCIES_PER_BIN),
        )

    def gain(self, amplitudes: FloatArray) -> Singles:
        """What multiplies the light of each bin (n,)."""
        return (
            np.asarray(1 + amplitudes @ self.waves, np.float32)[self.row]
            if amplitudes.size
            else self._steady
        )

    def sums(self, values: Singles) -> FloatArray:
        """Over each row (k, R), of values (k, n)."""
        return np.asarray(sums_by(self.row, values, self._place.size))

    def search(self, rows: FloatArray) -> bool:
        """Whether sums (2, R), as of `fitted_waves`, of a fit with
        all known waves show one more.
        """
        clear = clear_power(row_power(rows[0]), _LEAST_BANDS)
        self._mean = _KEEPS * self._mean + (1 - _KEEPS) * clear
        return self._add(np.maximum(clear / _CLEAR, self._mean / _CLEAR_MEAN))

    def recall(self) -> bool:
        """Whether the first frames show one more wave together."""
        return self._add(self._mean / _CLEAR_FIRST)

    def _add(self, clear: FloatArray) -> bool:
        """Whether the clearest wave is one, by its power over what it must have,
        and was not known.
        """
        found_rad = 2 * np.pi * int(np.argmax(clear)) / (FREQUENCIES_PER_BIN * self._place.size)
        apart = np.abs(self._rad_per_row - found_rad) > 2 * np.pi * WAVE_WIDTH / self._place.size
        if len(apart) == MOST_BANDS or not apart.all() or np.max(clear) < 1:
            return False
        self._mean *= 0
        self._rad_per_row, self._told = (
            np.append(self._rad_per_row, found_rad),
            np.append(self._told, 0.0),
        )
        self._draw()
        return True

    def keep(self, count: int) -> None:
        """Forget all waves but the first `count` of 2 k rows."""
        self._rad_per_row, self._told = self._rad_per_row[: count // 2], self._told[: count // 2]
        self._draw()

    def refine(self, rows: FloatArray, amplitudes: FloatArray) -> None:
        """Turn the frequencies to what sums (2, R), as of `fitted_waves`, of the fit with these
        amplitudes show.
        """
        (cosine, sine), (along, across) = np.split(self.waves, 2), np.split(amplitudes[:, None], 2)
        change = self._place * (across * cosine - along * sine)
        self._told = (
            self._told + change**2 @ rows[1]
        )  # of all frames: where bands vanish, the frequency stays
        self._rad_per_row = self._rad_per_row + change @ rows[0] / np.maximum(self._told, 1e-30)
        self._draw()

    def _draw(self) -> None:
        self.waves = row_waves(self._rad_per_row, self._place).astype(np.float32)


def row_power(rows: FloatArray) -> FloatArray:
    """Of the frequencies along the rows (..., R)."""
    return (
        np.abs(
            np.fft.rfft(rows, FREQUENCIES_PER_BIN * rows.shape[-1])[
                ..., : rows.shape[-1] // 2 * FREQUENCIES_PER_BIN
            ]
        )
        ** 2
    )


def fitted_waves(waves: FloatArray | Singles, rows: FloatArray) -> FloatArray:
    """Amplitudes (2 k,) of waves (2 k, R) from sums (2, R) of light times rest, and of light
    squared.
    """
    return np.asarray(np.linalg.solve((waves * rows[1]) @ waves.T, waves @ rows[0]), float)


def clear_power(power: FloatArray, least_bands: int) -> FloatArray:
    """Power over the median around it and of all; 0 for waves that are too wide."""
    means = power.reshape(-1, FREQUENCIES_PER_BIN).mean(axis=1)
    around = np.maximum(ndimage.median_filter(means, 2 * _AROUND + 1), np.median(means) + 1e-30)
    clear = power / np.repeat(around, FREQUENCIES_PER_BIN)
    clear[: least_bands * FREQUENCIES_PER_BIN] = 0.0
    return np.asarray(clear)


def row_waves(rad_per_row: FloatArray, place: FloatArray | IntArray) -> FloatArray:
    """Cosines, then sines (2 k, rows) of k frequencies."""
    turns = rad_per_row[:, None] * place
    return np.concatenate([np.cos(turns), np.sin(turns)])
