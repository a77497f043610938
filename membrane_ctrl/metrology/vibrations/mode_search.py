"""Vibrations of the mirror in its tracked terms: frequency, shape and amplitude of each.

A term that oscillates at f gives, at the frames' own times t, the same numbers at f and at every
alias of f. Frames taken at two rates have different aliases: only the true frequency explains both.
So each piece of some seconds is projected on exp(-2 pi i f t) for frequencies far beyond half the
frame rate,

    X_p(f) = sum over frames of w z exp(-2 pi i f t),

with a Hann window w. T(f) is the power of all X_p of one shape, in units of their noise: the
largest eigenvalue over the shapes. Without a vibration it follows about a gamma distribution, whose
scale and order its quantiles give. The largest T is a vibration if chance would give it once in ten
thousand nights; it is subtracted from the terms, and the search goes on with what is left. T is
also the logarithm of the likelihood (Bretthorst 1988, chapter 3), so that its curvature is the
frequency's variance, and frequencies with a T nearly as large are named as equally possible.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.metrology.numerics import zernike
from membrane_ctrl.model.arrays import BoolArray, FloatArray, IntArray
from membrane_ctrl.model.state_tree import ArrayShape, StateNode
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS

ComplexArray = NDArray[np.complex128]

PIECE_S = 10.0  # a line of 48 Hz with a quality of 500 is as wide as the resolution of that, 0.1 Hz
LEAST_S = 20.0
_LEAST_HZ = 1.2  # slower than that is weather, leak and control
_GRID = 4  # frequencies per resolution
_TAKEN = (
    -2.1,
    -1.4,
    -0.7,
    0.0,
    0.7,
    1.4,
    2.1,
)  # resolutions about a line that go with it: it may be damped
_SHORTEST = 0.6  # shorter frames of one rate, in pieces, are left out
_GRAIN_UM = 1e-3  # of a hold's terms: they have at least the noise of rounding
_HALF, _OTHER_RATE = (
    12,
    0.04,
)  # intervals on each side, and change of their median; busy machines scatter by as much
_GAP = 4.5  # intervals: as long a pause ends a piece
_MOST = 24
_CHANCE = 1e-9  # of a false line in one search
# difference of T, a factor of 2e4 in likelihood, below which two frequencies are equally possible
_ALIKE = 10.0
# of T: what a line leaves where its alias is as slow as drift, and another frequency takes for
# itself
_LEAKED = 0.1
_MISSING = 0.9  # of T for each piece: below it, some of the pieces do not show the line
_MARGIN = 1.5  # of T at one rate: errors of the noise's spectrum are the same in all pieces
_APART_HZ = 0.3  # closer ones are one line
_SAME = 0.004  # relative: two searches see one mode, whatever the shapes
_FAR, _SIMILAR = (
    0.05,
    0.8,
)  # relative, and correlation: two searches see one mode whose frequency has moved

SEARCH_S = 60.0
LEAST_RATE_HZ = 4.0  # of the frames; a cycle of eight gives 0.5
# relative, told from here on: none of 1 %, which is 2 % of the film's tension, is missed
MOVED = 0.009


@dataclass(frozen=True)
class VibrationMode(StateNode):
    """One vibration."""

    frequency_hz: float
    sigma_hz: float
    amplitude_nm: float  # of the oscillation, RMS over the mirror, whose ring rests
    # (terms,): terms, unit RMS; the largest is positive
    shape: Annotated[FloatArray, ArrayShape((ZERNIKE_TERMS,))]
    evidence: float  # T less that of noise
    # Frequencies that explain the frames as well: aliases that one frame rate cannot tell apart.
    # The lowest is given.
    aliases_hz: tuple[float, ...] = ()

    def is_like(self, other: "VibrationMode") -> bool:
        """Whether two searches see one mode: nearly its frequency,
        or its shape somewhat beside it.
        """
        change = abs(self.frequency_hz / other.frequency_hz - 1)
        return change < _SAME or (change < _FAR and abs(float(self.shape @ other.shape)) > _SIMILAR)


@dataclass(frozen=True)
class _Piece:
    """Some seconds of frames."""

    time_s: FloatArray  # (n,)
    rate_hz: float
    window: FloatArray  # (n,)
    waves: ComplexArray  # (frequencies, n)
    alias_hz: FloatArray  # (frequencies,): their aliases below half its frame rate
    # (frequencies,): those with the alias of drift, or of half the frame rate, where X is real
    blind: BoolArray

    def projected(self, terms_um: FloatArray) -> ComplexArray:
        """X (frequencies, terms - 1) of terms (n, terms - 1)."""
        return np.asarray(self.waves @ (self.window[:, None] * terms_um))

    def goes_with(self, frequency_hz: float) -> BoolArray:
        """The frequencies (frequencies,) that have nearly the alias of a line."""
        alias_hz = abs(frequency_hz - self.rate_hz * round(frequency_hz / self.rate_hz))
        return np.asarray(np.abs(self.alias_hz - alias_hz) < (_TAKEN[-1] + 1) / PIECE_S)

    def noise(self, power: FloatArray, gone: BoolArray) -> FloatArray:
        """Noise (frequencies, terms - 1) under the lines, a function of the alias that falls with
        it: drift, then white.

        Medians over bands of half an octave (power is exponential: its median is ln 2 of its mean),
        none larger than that of a slower band, in which a line has less to say. What is `gone` with
        a line is left out if other power is there; a slow band that a line has emptied would leave
        no noise to it and to all the faster ones.
        """
        slowest_hz, levels, middles = _LEAST_HZ / 2, [], []
        octaves = np.log2(self.alias_hz.max() / slowest_hz)
        edges = np.geomspace(slowest_hz, self.alias_hz.max() * 1.001, 3 + int(2 * octaves))
        for low, high in pairwise(edges):
            inside = (self.alias_hz >= low) & (self.alias_hz < high)
            left = inside & ~gone
            if inside.any():
                levels.append(
                    np.median(power[left if 2 * left.sum() > inside.sum() else inside], axis=0)
                    / np.log(2)
                )
                middles.append(np.log(np.sqrt(low * high)))
        rounding = np.sum(self.window**2) * _GRAIN_UM**2 / 12
        logs = np.log(np.maximum(np.minimum.accumulate(levels, axis=0), rounding))
        at = np.log(np.maximum(self.alias_hz, slowest_hz))
        return np.exp(
            np.column_stack([np.interp(at, middles, logs[:, j]) for j in range(power.shape[1])])
        )

    def without(self, terms_um: FloatArray, frequency_hz: float, shapes: FloatArray) -> FloatArray:
        """The terms without oscillations about a frequency that `shapes` (terms - 1, terms - 1)
        projects on; others stay."""
        times = 2 * np.pi * (self.time_s - self.time_s[0])
        phases = [(frequency_hz + offset / PIECE_S) * times for offset in _TAKEN]
        base = np.column_stack([wave(phase) for phase in phases for wave in (np.cos, np.sin)])
        return np.asarray(terms_um - base @ np.linalg.lstsq(base, terms_um @ shapes, rcond=None)[0])


def find_modes(
    time_s: FloatArray, coeffs_um: FloatArray, most_hz: float = 100.0
) -> tuple[VibrationMode, ...] | None:
    """Vibrations in terms (n, terms) of frames at times (n,), NaN where a frame was rejected; the
    strongest first.

    None if there are less than 20 s of frames at a steady rate.
    """
    good = np.isfinite(coeffs_um).all(axis=1)
    grid_hz = np.arange(_LEAST_HZ, most_hz, 1 / (_GRID * PIECE_S))
    # the first term only puts the vertex at 0: it would weigh what moves the vertex twice
    pieces, terms = _split_frames(time_s[good], coeffs_um[good, 1:], grid_hz)
    if sum(piece.time_s[-1] - piece.time_s[0] for piece in pieces) < 0.9 * LEAST_S:
        return None
    found: list[VibrationMode] = []
    margin = _MARGIN if _one_rate([piece.rate_hz for piece in pieces]) else 1.0
    whole = [np.abs(piece.projected(part)) ** 2 for piece, part in zip(pieces, terms, strict=True)]
    gone = [
        np.zeros(grid_hz.size, bool) for _ in pieces
    ]  # frequencies whose aliases went with a line
    for _ in range(_MOST):
        spectra = [piece.projected(part) for piece, part in zip(pieces, terms, strict=True)]
        noises = [
            piece.noise(np.where(away[:, None], before, np.abs(spectrum) ** 2), away)
            for spectrum, before, piece, away in zip(spectra, whole, pieces, gone, strict=True)
        ]
        seen = _compute_evidence(spectra, noises, pieces)
        if seen.max() < margin * _compute_threshold(seen, grid_hz.size):
            break
        k, rivals = _find_likeliest(seen, np.sum([~piece.blind for piece in pieces], axis=0))
        frequency, sigma = _refine_frequency(seen, grid_hz, k)
        used = [
            p for p, piece in enumerate(pieces) if not piece.blind[k]
        ]  # others have drift there
        amplitude_nm, shape = _compute_shape(
            *zip(*((spectra[p][k], pieces[p], noises[p][k]) for p in used), strict=True)
        )
        own = shape[1:] / np.linalg.norm(shape[1:])
        sigma = max(sigma, _scatter_hz([np.abs(spectra[p] @ own) ** 2 for p in used], grid_hz, k))
        again = any(abs(frequency - mode.frequency_hz) < _APART_HZ for mode in found)
        if not again:
            evidence = float(seen[k] - np.median(seen))
            rates_hz = [pieces[p].rate_hz for p in used]
            aliases = _aliases_hz(rates_hz, frequency, most_hz) or tuple(grid_hz[rivals].tolist())
            found.append(VibrationMode(frequency, sigma, amplitude_nm, shape, evidence, aliases))
        terms = [
            piece.without(
                part, frequency, np.eye(own.size) if again else _projection_onto(own, noise[k])
            )
            for piece, part, noise in zip(pieces, terms, noises, strict=True)
        ]
        gone = [away | piece.goes_with(frequency) for piece, away in zip(pieces, gone, strict=True)]
    return tuple(_drop_false_aliases(mode, found) for mode in found)


def _drop_false_aliases(mode: VibrationMode, found: list[VibrationMode]) -> VibrationMode:
    """The mode without aliases that are themselves modes: they stood out when it was gone."""
    others_hz = np.array([other.frequency_hz for other in found])
    kept = (alias for alias in mode.aliases_hz if np.abs(others_hz - alias).min() > _APART_HZ)
    return replace(mode, aliases_hz=tuple(kept))


def _split_frames(
    time_s: FloatArray, coeffs_um: FloatArray, grid_hz: FloatArray
) -> tuple[list[_Piece], list[FloatArray]]:
    """The frames in pieces, and their terms without drift."""
    pieces, terms = [], []
    for frames in _find_runs(time_s):
        t = time_s[frames]
        rate_hz = 1 / float(np.median(np.diff(t)))
        alias_hz = np.abs(grid_hz - rate_hz * np.round(grid_hz / rate_hz))
        middle, half = (t[0] + t[-1]) / 2, (t[-1] - t[0]) / 2 + 1 / rate_hz
        window = np.cos(np.pi / 2 * (t - middle) / half) ** 2
        waves = np.exp(-2j * np.pi * grid_hz[:, None] * (t - t[0]))
        blind = (alias_hz < _LEAST_HZ) | (alias_hz > rate_hz / 2 - 2 / PIECE_S)
        pieces.append(_Piece(t, rate_hz, window, waves, alias_hz, blind))
        terms.append(_without_drift(t, coeffs_um[frames]))
    return pieces, terms


def _find_runs(time_s: FloatArray) -> list[slice]:
    """Frames of one rate without a gap, in pieces of about the same length."""
    from scipy import ndimage

    intervals = np.diff(time_s)
    if intervals.size <= 2 * _HALF:
        return []
    usual = ndimage.median_filter(intervals, 2 * _HALF + 1, mode="nearest")
    before, after = usual[: -2 * _HALF], usual[2 * _HALF :]
    other = np.append(0, np.abs(after - before) > _OTHER_RATE * before)
    begins, ceases = (np.flatnonzero(np.diff(np.append(other, 0)) == sign) for sign in (1, -1))
    ends = np.union1d((begins + ceases) // 2 + _HALF, np.flatnonzero(intervals > _GAP * usual))
    pieces = []
    for first, last in pairwise([0, *(ends + 1), time_s.size]):
        lasts_s = time_s[last - 1] - time_s[first]
        if lasts_s >= _SHORTEST * PIECE_S:
            edges = np.linspace(first, last, max(1, round(lasts_s / PIECE_S)) + 1).astype(int)
            pieces += [slice(a, b) for a, b in pairwise(edges)]
    return pieces


def _without_drift(time_s: FloatArray, terms_um: FloatArray) -> FloatArray:
    """Terms less a cubic, clipped at six robust deviations."""
    base = np.column_stack([np.linspace(-1, 1, time_s.size) ** power for power in range(4)])
    left = terms_um - base @ np.linalg.lstsq(base, terms_um, rcond=None)[0]
    spread = np.maximum(1.4826 * np.median(np.abs(left), axis=0), _GRAIN_UM)
    return np.asarray(np.clip(left, -6 * spread, 6 * spread))


def _compute_evidence(
    spectra: list[ComplexArray], noises: list[FloatArray], pieces: list[_Piece]
) -> FloatArray:
    """T (frequencies,): the largest eigenvalue over the shapes, with terms and pieces in units of
    their noise.
    """
    white = np.stack(
        [spectrum / np.sqrt(noise) for spectrum, noise in zip(spectra, noises, strict=True)], axis=1
    )
    power = np.sum(np.abs(white) ** 2, axis=2)
    quiet = white[
        power <= np.median(power, axis=0)
    ]  # lines, and their aliases, are in the other half
    values, vectors = np.linalg.eigh(np.real(quiet.conj().T @ quiet) / len(quiet))
    kept = values > 1e-3 * values[-1]
    alone = (white @ vectors[:, kept]) / np.sqrt(values[kept])
    alone[np.stack([piece.blind for piece in pieces], axis=1)] = 0
    parts = np.concatenate([alone.real, alone.imag], axis=1)
    return np.asarray(np.linalg.eigvalsh(parts @ parts.transpose(0, 2, 1))[:, -1])


def _compute_threshold(seen: FloatArray, frequencies: int) -> float:
    """T that chance exceeds at any of the frequencies with `_CHANCE`, for a gamma distribution of
    these quantiles.
    """
    from scipy import stats

    heard = seen[seen > 0]  # to the others all pieces are blind
    # of the lower half, where neither lines nor their aliases are
    low, middle = np.quantile(heard, [0.1, 0.5]) if heard.size else (0.0, 0.0)
    if not middle > low:
        return float("inf")  # nothing moves at all
    order = max((1.2816 * middle / (middle - low)) ** 2, 1.0)
    return float(middle / stats.gamma.median(order) * stats.gamma.isf(_CHANCE / frequencies, order))


def _find_likeliest(seen: FloatArray, visible: IntArray) -> tuple[int, list[int]]:
    """The frequency with the largest T, and others that explain the frames as well.

    Of equal ones it is the one that all its pieces show, then the lowest.
    """
    best = int(np.argmax(seen))
    inner, near = seen[1:-1], seen[best] - max(_ALIKE, _LEAKED * seen[best])
    peaks = 1 + np.flatnonzero((inner >= seen[:-2]) & (inner > seen[2:]) & (inner > near))
    apart = round(_APART_HZ * _GRID * PIECE_S)
    alike = [best, *(int(k) for k in peaks if abs(k - best) > apart)]
    each = {k: seen[k] / visible[k] for k in alike}
    alike = [k for k in alike if each[k] > _MISSING * max(each.values())]
    most = max(seen[k] for k in alike)
    likeliest = min(k for k in alike if seen[k] > most - 0.1)
    return likeliest, sorted(k for k in alike if k != likeliest and seen[k] > most - _ALIKE)


def _one_rate(rates_hz: list[float]) -> bool:
    return max(rates_hz) < 1.03 * min(rates_hz)


def _aliases_hz(rates_hz: list[float], frequency_hz: float, most_hz: float) -> tuple[float, ...]:
    """All aliases of a frequency that pieces of one rate alone show: others may be blind to the
    true one.
    """
    if not _one_rate(rates_hz):
        return ()
    rate_hz = float(np.mean(rates_hz))
    alias_hz = abs(frequency_hz - rate_hz * round(frequency_hz / rate_hz))
    every = {
        abs(m * rate_hz + sign * alias_hz)
        for m in range(int(most_hz / rate_hz) + 1)
        for sign in (-1, 1)
    }
    return tuple(
        sorted(f for f in every if _LEAST_HZ < f < most_hz and abs(f - frequency_hz) > _APART_HZ)
    )


def _refine_frequency(seen: FloatArray, grid_hz: FloatArray, k: int) -> tuple[float, float]:
    """Frequency and its standard deviation from the parabola through three values of T."""
    step = grid_hz[1] - grid_hz[0]
    if not 0 < k < seen.size - 1:
        return float(grid_hz[k]), float(step)
    before, here, after = seen[k - 1 : k + 2]
    bend = before - 2 * here + after
    if bend >= 0:
        return float(grid_hz[k]), float(step)
    offset = float(np.clip((before - after) / (2 * bend), -1, 1))
    return float(grid_hz[k] + offset * step), float(step / np.sqrt(-bend))


def _compute_shape(
    lines: Sequence[ComplexArray], pieces: Sequence[_Piece], noises: Sequence[FloatArray]
) -> tuple[float, FloatArray]:
    """Amplitude in nm and terms (terms,) of unit RMS with the ring at rest, from X (terms - 1,) of
    each piece at the line.

    All terms are in phase. A piece that has the line among slow motion, which is a shape too, has
    little weight.
    """
    waves = np.array(
        [2 * line / piece.window.sum() for line, piece in zip(lines, pieces, strict=True)]
    )
    weights = np.array(
        [
            piece.window.sum() ** 2 / noise.mean()
            for piece, noise in zip(pieces, noises, strict=True)
        ]
    )
    terms = np.linalg.eigh(np.real((weights[:, None] * waves).conj().T @ waves))[1][:, -1]
    shape = np.append(-terms @ zernike.at_rim()[1:], terms)
    size = float(np.linalg.norm(shape))
    shape *= np.sign(shape[np.argmax(np.abs(shape))]) / size
    return float(
        1e3 * size * np.sqrt(np.average(np.abs(waves @ terms) ** 2, weights=weights))
    ), np.asarray(shape)


def _projection_onto(shape: FloatArray, noise: FloatArray) -> FloatArray:
    """What takes terms to their part in a shape, (terms - 1, terms - 1), told by those with little
    noise.

    The film's slow motion is mostly one term: by all of them alike, it would be taken for the
    shape's other terms.
    """
    weighed = shape / noise
    return np.outer(weighed, shape) / (weighed @ shape)


def _scatter_hz(lines: list[FloatArray], grid_hz: FloatArray, k: int) -> float:
    """Standard error of the mean of the pieces' own frequencies: a damped line wanders by its
    width.
    """
    reach = round(_APART_HZ * _GRID * PIECE_S)
    first, last = max(k - reach, 0), min(k + reach + 1, grid_hz.size)
    own = [
        _refine_frequency(line, grid_hz, first + int(np.argmax(line[first:last])))[0]
        for line in lines
    ]
    return float(np.std(own, ddof=1) / np.sqrt(len(own))) if len(own) > 1 else 0.0
