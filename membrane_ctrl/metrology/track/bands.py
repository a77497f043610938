"""Bands that a pulsed backlight leaves in the rows of a rolling shutter.

Each row sees another part of the pulses, so that the light of a picture is multiplied by waves along its rows. Their
frequencies stay, their amplitudes and phases are others in each frame. Where bands are as wide as the fringes, a fit
without them takes them for shape. What it leaves shows them elsewhere: a wave found there joins the fit's unknowns.
"""

import numpy as np
from scipy import ndimage

from membrane_ctrl.model.arrays import FloatArray, IntArray, Singles

_LEAST_BANDS = 4  # in the picture: maps of 36 terms follow wider ones
# Power over the median around it and of all, of one frame and of the mean over some: bands have 100 and more. What
# fringes and rounding leave has 10, and scatters from frame to frame.
_CLEAR, _CLEAR_MEAN = 150.0, 25.0
_CLEAR_FIRST = (
    6.0  # of what five frames have begun (four tenths of a mean): weak bands, too, spoil the light they give
)
_KEEPS = 0.9  # share of the former frames in the mean
_WIDE, _AROUND = 2, 10  # bands in the picture: a wave's own width, and where the power around it is judged
_MOST = 6  # waves: the power of pulses falls as the fourth power of their harmonics
_FINER = 16  # steps of the frequency in one over the picture's height


class Bands:
    """The waves along the rows that frames have shown.

    Parameters
    ----------
    row : (n,) array
        Of each bin.
    """

    def __init__(self, row: IntArray) -> None:
        self.row = row
        self._place = np.arange(int(row.max()) + 1) - row.mean()
        self._rad_per_row = self._told = np.zeros(0)
        self.waves = np.zeros((0, self._place.size), np.float32)  # (2 k, R): cosines, sines
        self._steady, self._mean = np.ones(row.size, np.float32), np.zeros(self._place.size // 2 * _FINER)

    def gain(self, amplitudes: FloatArray) -> Singles:
        """What multiplies the light of each bin (n,)."""
        return np.asarray(1 + amplitudes @ self.waves, np.float32)[self.row] if amplitudes.size else self._steady

    def sums(self, values: Singles) -> FloatArray:
        """Over each row (k, R), of values (k, n)."""
        return np.stack([np.bincount(self.row, one, self._place.size) for one in values])

    def solved(self, rows: FloatArray) -> FloatArray:
        """Amplitudes (2 k,) from sums (2, R) of light times rest, and of light squared, of a fit without bands."""
        return np.asarray(np.linalg.solve((self.waves * rows[1]) @ self.waves.T, self.waves @ rows[0]), float)

    def search(self, rows: FloatArray) -> bool:
        """Whether what a fit leaves shows one more wave; sums (2, R) as in `solved`, of a fit with all known ones."""
        size = _FINER * self._place.size
        power = np.abs(np.fft.rfft(rows[0], size)[: self._place.size // 2 * _FINER]) ** 2
        means = power.reshape(-1, _FINER).mean(axis=1)
        around = np.maximum(ndimage.median_filter(means, 2 * _AROUND + 1), np.median(means) + 1e-30)
        clear = power / np.repeat(around, _FINER)
        clear[: _LEAST_BANDS * _FINER] = 0.0
        self._mean = _KEEPS * self._mean + (1 - _KEEPS) * clear
        return self._add(np.maximum(clear / _CLEAR, self._mean / _CLEAR_MEAN))

    def recall(self) -> bool:
        """Whether the first frames show one more wave together."""
        return self._add(self._mean / _CLEAR_FIRST)

    def _add(self, clear: FloatArray) -> bool:
        """Whether the clearest wave is one, by its power over what it must have, and was not known."""
        found_rad = 2 * np.pi * int(np.argmax(clear)) / (_FINER * self._place.size)
        apart = np.abs(self._rad_per_row - found_rad) > 2 * np.pi * _WIDE / self._place.size
        if len(apart) == _MOST or not apart.all() or np.max(clear) < 1:
            return False
        self._mean *= 0
        self._rad_per_row, self._told = np.append(self._rad_per_row, found_rad), np.append(self._told, 0.0)
        self._draw()
        return True

    def keep(self, count: int) -> None:
        """Forget all waves but the first `count` of 2 k rows."""
        self._rad_per_row, self._told = self._rad_per_row[: count // 2], self._told[: count // 2]
        self._draw()

    def refine(self, rows: FloatArray, amplitudes: FloatArray) -> None:
        """Turn the frequencies to what a fit leaves; sums (2, R) as in `solved`, of the fit with these amplitudes."""
        (cosine, sine), (along, across) = np.split(self.waves, 2), np.split(amplitudes[:, None], 2)
        change = self._place * (across * cosine - along * sine)
        self._told = self._told + change**2 @ rows[1]  # of all frames: where bands vanish, the frequency stays
        self._rad_per_row = self._rad_per_row + change @ rows[0] / np.maximum(self._told, 1e-30)
        self._draw()

    def _draw(self) -> None:
        turns = self._rad_per_row[:, None] * self._place
        self.waves = np.concatenate([np.cos(turns), np.sin(turns)]).astype(np.float32)
