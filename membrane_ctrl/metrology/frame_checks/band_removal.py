"""Backlight bands found in the steps of one set, and divided out of its frames."""

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
from membrane_ctrl.metrology.numerics.grouped_sums import sums_by
from membrane_ctrl.metrology.phase.frame_stack import Binned, FrameStack
from membrane_ctrl.metrology.phase.full_decoder import CONTRAST_SHARE
from membrane_ctrl.metrology.phase.pattern_sequence import AXES
from membrane_ctrl.model.arrays import FloatArray, IntArray

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
        return np.maximum(1 + self.amplitudes @ row_waves(self.rad_per_row, place), _DARKEST)

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
            row_power(self._sums((self._rest - self._others) * self._shown)).mean(axis=0)
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
        count, waves = len(self.frames), row_waves(rad_per_row, self._rows)
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


def remove_bands(
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
    while (
        found := _add_frequency(across.rad_per_row, across.left(), rows)
    ).size > across.rad_per_row.size:
        across.solve(found)
    if not found.size or max(across.unexplained, other.solve(found)) > _UNEXPLAINED:
        return stack, binned, _NONE
    y.amplitudes += fitted_waves(
        row_waves(found, rows), x.brighter(y)
    )  # else the film seems to move, see `evidence`
    place = np.arange(stack.size_px[0]) / binned.bin_px - (1 - 1 / binned.bin_px) / 2
    gain, means = np.ones((len(stack.patterns), place.size)), binned.means.copy()
    for one in steps:
        gain[one.frames] = one.gain(place)
        means[one.frames] /= one.gain(rows)[..., None].astype(np.float32)
    return replace(stack, gain=gain), replace(binned, means=means), found


def describe_bands(gain: FloatArray | None) -> str:
    """Why a set with such gains (frames, rows) is degraded; empty if it is not."""
    most = 0.0 if gain is None else float(np.abs(gain - 1).max())
    return f"bands of {most:.0%} of the light along the rows: expose for whole backlight pulses" * (
        most > _GREAT
    )


def _add_frequency(rad_per_row: FloatArray, power: FloatArray, rows: IntArray) -> FloatArray:
    """Frequencies, with one more if the power shows a wave that is none of them."""
    clear = clear_power(power, 1)
    peak = np.argmax(
        power * (np.abs(np.arange(clear.size) - np.argmax(clear)) <= FREQUENCIES_PER_BIN)
    )
    found_rad = 2 * np.pi * int(peak) / (FREQUENCIES_PER_BIN * rows.size)
    known = (
        len(rad_per_row) == MOST_BANDS
        or (np.abs(rad_per_row - found_rad) < 2 * np.pi * WAVE_WIDTH / rows.size).any()
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
