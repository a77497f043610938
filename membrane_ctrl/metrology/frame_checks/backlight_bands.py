"""Bands that a pulsed backlight leaves in the rows of a rolling shutter.

Each row sees another part of the pulses, so that the light of a picture is multiplied by waves
along its rows. Their frequencies stay, their amplitudes and phases are others in each frame. Where
bands are as wide as the fringes, a fit without them takes them for shape. What it leaves shows them
elsewhere: a wave found there joins the fit's unknowns.

`Bands` are those of frames of crossed fringes. `without_bands` finds them in the phase steps of a
set: frame k shows g_k m_k, with the gain g_k = 1 + a_k w of its rows, of which level, swing and
phase leave P (g m), P the projector off their columns. Least squares over the bins give a; the
panel's harmonics and a flickering lamp are unknowns, too.
"""

from dataclasses import replace

import numpy as np
from scipy import ndimage

from membrane_ctrl.metrology.numerics.grouped_sums import sums_by
from membrane_ctrl.metrology.phase.frame_stack import Binned, FrameStack
from membrane_ctrl.metrology.phase.full_decoder import CONTRAST_SHARE
from membrane_ctrl.metrology.phase.pattern_sequence import AXES
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
_WIDE, _AROUND = (
    2,
    10,
)  # bands in the picture: a wave's own width, and where the power around it is judged
_MOST = 6  # waves: the power of pulses falls as the fourth power of their harmonics
_FINER = 16  # steps of the frequency in one over the picture's height
_FEWEST_STEPS, _DARKEST = 4, 0.2  # three leave nothing; no row is darker, over its mean
# power over that around it, in the mean over an axis' steps; without bands it is 10 at most
_CLEAR_STEPS = 20.0
_FEWEST_BINS, _ENOUGH_BINS = 1_000, 15_000  # fewer show nothing, more only cost time
_TURNS = 3  # the last one changes the largest bands by a thousandth
# share of the largest eigenvalue below which amplitudes are not determined, and stay
_SINGULAR = 1e-3
_NONE = np.zeros(0)
_GREAT = 0.05  # a twentieth of what bands do is left: 0.1 µm of figure from here on
# of bands, times the share that they leave of the rest: those of wrong pictures explain little
_UNEXPLAINED = 0.05


class Bands:
    """The waves along the rows that frames have shown; `row` (n,) is that of each bin."""

    def __init__(self, row: IntArray) -> None:
        self.row = row
        self._place = np.arange(int(row.max()) + 1) - row.mean()
        self._rad_per_row = self._told = np.zeros(0)
        self.waves = np.zeros((0, self._place.size), np.float32)  # (2 k, R): cosines, sines
        self._steady, self._mean = (
            np.ones(row.size, np.float32),
            np.zeros(self._place.size // 2 * _FINER),
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
        clear = _clear(_power(rows[0]), _LEAST_BANDS)
        self._mean = _KEEPS * self._mean + (1 - _KEEPS) * clear
        return self._add(np.maximum(clear / _CLEAR, self._mean / _CLEAR_MEAN))

    def recall(self) -> bool:
        """Whether the first frames show one more wave together."""
        return self._add(self._mean / _CLEAR_FIRST)

    def _add(self, clear: FloatArray) -> bool:
        """Whether the clearest wave is one, by its power over what it must have,
        and was not known.
        """
        found_rad = 2 * np.pi * int(np.argmax(clear)) / (_FINER * self._place.size)
        apart = np.abs(self._rad_per_row - found_rad) > 2 * np.pi * _WIDE / self._place.size
        if len(apart) == _MOST or not apart.all() or np.max(clear) < 1:
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
        self.waves = _waves(self._rad_per_row, self._place).astype(np.float32)


def _power(rows: FloatArray) -> FloatArray:
    """Of the frequencies along the rows (..., R)."""
    return (
        np.abs(np.fft.rfft(rows, _FINER * rows.shape[-1])[..., : rows.shape[-1] // 2 * _FINER]) ** 2
    )


def fitted_waves(waves: FloatArray | Singles, rows: FloatArray) -> FloatArray:
    """Amplitudes (2 k,) of waves (2 k, R) from sums (2, R) of light times rest, and of light
    squared.
    """
    return np.asarray(np.linalg.solve((waves * rows[1]) @ waves.T, waves @ rows[0]), float)


def _clear(power: FloatArray, least_bands: int) -> FloatArray:
    """Power over the median around it and of all; 0 for waves that are too wide."""
    means = power.reshape(-1, _FINER).mean(axis=1)
    around = np.maximum(ndimage.median_filter(means, 2 * _AROUND + 1), np.median(means) + 1e-30)
    clear = power / np.repeat(around, _FINER)
    clear[: least_bands * _FINER] = 0.0
    return np.asarray(clear)


class _Steps:
    """The phase steps of one axis in n bins, and the bands of the N frames."""

    def __init__(
        self, stack: FrameStack, binned: Binned, frames: list[int], index: IntArray
    ) -> None:
        self.frames, (_, rows, columns) = frames, binned.means.shape
        self._row, self._rows, self._shifts_rad = (
            index // columns,
            np.arange(rows),
            stack.shifts_rad(frames),
        )
        self._seen = binned.means[frames].reshape(len(frames), -1)[:, index]
        self._design, self._inverse = stack.design(frames), np.linalg.pinv(stack.design(frames))
        self.unexplained, self.rad_per_row, self.amplitudes = 0.0, _NONE, np.zeros((len(frames), 0))
        self._fit()
        self._first = max(float(np.sum(self._rest**2)), 1e-30)

    def gain(self, place: FloatArray | IntArray) -> FloatArray:
        """Of the light of rows (N, R)."""
        return np.maximum(1 + self.amplitudes @ _waves(self.rad_per_row, place), _DARKEST)

    def _fit(self) -> None:
        """Level and phasor of each bin, what they show, and what they leave, without the bands."""
        gain = self.gain(self._rows)[:, self._row]
        self._parts = self._inverse @ (self._seen / gain)
        self._shown = self._design @ self._parts
        self._rest, self._lit = self._seen / gain - self._shown, self._shown / gain

    def _sums(self, values: FloatArray) -> FloatArray:
        """Over each row (N, R), of values (N, n)."""
        return np.asarray(sums_by(self._row, values, self._rows.size))

    def left(self) -> FloatArray:
        """Power of the frequencies along the rows in what the steps leave, weighed with their
        light.
        """
        return np.asarray(
            _power(self._sums((self._rest - self._others) * self._shown)).mean(axis=0)
        )

    def brighter(self, other: "_Steps") -> FloatArray:
        """Sums (2, R), as in `fitted_waves`, of the light by which the other axis differs."""
        level, theirs = self._parts[0], other._parts[0]
        theirs = theirs * (level @ level / (theirs @ level))
        return self._sums(np.stack([level * (theirs - level), level**2]))

    def along(self) -> float:
        """1 if the fringes are along the rows, 0 if they cross them many times."""
        return float(
            np.sum(np.hypot(*self._sums(self._parts[1:]))) / np.sum(np.hypot(*self._parts[1:]))
        )

    def solve(self, rad_per_row: FloatArray) -> float:
        """Fit the amplitudes of waves along the rows, with harmonics and flicker; returns
        `unexplained`.
        """
        count, waves = len(self.frames), _waves(rad_per_row, self._rows)
        off, every = (
            np.eye(count) - self._design @ self._inverse,
            np.vstack([waves, np.ones(self._rows.size)]),
        )
        self.rad_per_row, self.amplitudes = rad_per_row, np.zeros((count, len(waves)))
        for _ in range(_TURNS if len(waves) else 1):
            self._fit()
            psi_rad = np.arctan2(self._parts[2], self._parts[1]) + self._shifts_rad[:, None]
            bent = off @ np.stack(
                [np.hypot(*self._parts[1:]) * np.cos(n * psi_rad) for n in (2, 3, 4)]
            )  # (3, N, n)
            both = np.array(
                [off[k][:, None] * self._sums(self._lit[k] * self._lit) for k in range(count)]
            )
            matrix = np.einsum("jkr,pr,qr->jpkq", both, every, every).reshape(
                2 * (count * len(every),)
            )
            aside = np.array(
                [self._sums(self._lit * one) @ every.T for one in (*bent, self._rest)]
            ).reshape(4, -1)
            flat = bent.reshape(3, -1)
            matrix = np.block([[matrix, aside[:3].T], [aside[:3], flat @ flat.T]])
            right = np.append(aside[3], flat @ self._rest.ravel())
            scale = np.sqrt(
                np.maximum(np.diag(matrix), 1e-12 * np.diag(matrix).max())
            )  # what vanishes is no unknown
            found = (
                np.linalg.pinv(matrix / np.outer(scale, scale), _SINGULAR, hermitian=True)
                @ (right / scale)
                / scale
            )
            lamps = found[:-3].reshape(count, -1)
            self.amplitudes += lamps[:, :-1]
            self._others = off @ (lamps[:, -1:] * self._lit) + np.tensordot(found[-3:], bent, 1)
        self._fit()
        self.unexplained = float(
            np.abs(self.amplitudes).max(initial=0.0) * np.sum(self._rest**2) / self._first
        )
        return self.unexplained


def without_bands(
    stack: FrameStack, binned: Binned, known: FloatArray = _NONE
) -> tuple[FrameStack, Binned, FloatArray]:
    """A set with the gain of its rows known, its bins without bands, and the bands' frequencies,
    `known` the first.

    Unchanged where no bands are seen, and where an axis has three steps, which leave nothing that
    shows them.
    """
    axes = [[k for k in stack.sinusoids(axis) if k not in stack.unusable] for axis in AXES]
    if (
        min(map(len, axes)) < _FEWEST_STEPS
        or (index := _with_fringes(binned, axes)).size < _FEWEST_BINS
    ):
        return stack, binned, _NONE
    x, y = steps = [_Steps(stack, binned, one, index) for one in axes]
    (across, other), rows = sorted(steps, key=_Steps.along), np.arange(binned.means.shape[1])
    across.solve(known)  # fringes along the rows look like bands
    while (found := _more(across.rad_per_row, across.left(), rows)).size > across.rad_per_row.size:
        across.solve(found)
    if not found.size or max(across.unexplained, other.solve(found)) > _UNEXPLAINED:
        return stack, binned, _NONE
    y.amplitudes += fitted_waves(
        _waves(found, rows), x.brighter(y)
    )  # else the film seems to move, see `evidence`
    place = np.arange(stack.size_px[0]) / binned.bin_px - (1 - 1 / binned.bin_px) / 2
    gain, means = np.ones((len(stack.patterns), place.size)), binned.means.copy()
    for one in steps:
        gain[one.frames] = one.gain(place)
        means[one.frames] /= one.gain(rows)[..., None].astype(np.float32)
    return replace(stack, gain=gain), replace(binned, means=means), found


def doubt(gain: FloatArray | None) -> str:
    """Why a set with such gains (frames, rows) is degraded; empty if it is not."""
    most = 0.0 if gain is None else float(np.abs(gain - 1).max())
    return f"bands of {most:.0%} of the light along the rows: expose for whole backlight pulses" * (
        most > _GREAT
    )


def _more(rad_per_row: FloatArray, power: FloatArray, rows: IntArray) -> FloatArray:
    """Frequencies, with one more if the power shows a wave that is none of them."""
    clear = _clear(power, 1)
    peak = np.argmax(power * (np.abs(np.arange(clear.size) - np.argmax(clear)) <= _FINER))
    found_rad = 2 * np.pi * int(peak) / (_FINER * rows.size)
    known = (
        len(rad_per_row) == _MOST
        or (np.abs(rad_per_row - found_rad) < 2 * np.pi * _WIDE / rows.size).any()
    )
    return (
        rad_per_row if known or np.max(clear) < _CLEAR_STEPS else np.append(rad_per_row, found_rad)
    )


def _with_fringes(binned: Binned, axes: list[list[int]]) -> IntArray:
    """Bins (n,), enough of those in which both axes swing and nothing is saturated."""
    swing = np.minimum(*(np.ptp(binned.means[frames], axis=0) for frames in axes))
    seen = (swing > CONTRAST_SHARE * np.percentile(swing, 95)) & ~binned.saturated[
        [*axes[0], *axes[1]]
    ].any(axis=0)
    return np.flatnonzero(seen)[:: max(1, np.count_nonzero(seen) // _ENOUGH_BINS)]


def _waves(rad_per_row: FloatArray, place: FloatArray | IntArray) -> FloatArray:
    """Cosines, then sines (2 k, rows) of k frequencies."""
    turns = rad_per_row[:, None] * place
    return np.concatenate([np.cos(turns), np.sin(turns)])
