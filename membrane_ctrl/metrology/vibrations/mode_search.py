"""Vibrations of the mirror in its tracked terms: frequency, shape and amplitude of each.

A term that oscillates at f gives, at the frames' own times t, the same numbers at f and at every
alias of f. Frames taken at two rates have different aliases: only the true frequency explains both.
So each piece of some seconds is projected on exp(-2 pi i f t) for frequencies far beyond half the
frame rate,

    X_p(f) = sum over frames of w z exp(-2 pi i f t),

with a Hann window w. T(f) is the power of all X_p of one shape, in units of their noise: the
largest eigenvalue over the shapes. Without a vibration it follows about a gamma distribution, whose
scale and order its quantiles give. The largest T is a vibration if chance would give it once in ten
thousand nights; it is subtracted from the terms, and the search continues with the rest. T is
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

# Resolution 0.1 Hz: as wide as a line of 48 Hz with a quality of 500.
PIECE_S = 10.0
LEAST_S = 20.0
SEARCH_S = 60.0
LEAST_RATE_HZ = 4.0  # of the frames; a cycle of eight gives 0.5
# Relative change of frequency that is reported: 1 %, which is 2 % of the film's tension, is
# always found.
MOVED = 0.009
_LEAST_HZ = 1.2  # below it are weather, leak and control
_GRID = 4  # frequencies per resolution
# Offsets, in resolutions, that are removed with a line: a damped line is broad.
_REMOVED_OFFSETS = (-2.1, -1.4, -0.7, 0.0, 0.7, 1.4, 2.1)
_SHORTEST = 0.6  # shorter runs of frames of one rate, in pieces, are not used
_GRAIN_UM = 1e-3  # resolution of a hold's terms: they have at least the noise of rounding
# A change of the frame rate: intervals on each side, and relative change of their medians.
# The intervals of a busy computer scatter by as much.
_HALF = 12
_OTHER_RATE = 0.04
_GAP = 4.5  # intervals: a pause as long as this ends a piece
_MOST_MODES = 24
_CHANCE = 1e-9  # probability of a false line in one search
# Difference of T, a factor of 2e4 in likelihood, below which two frequencies are equally possible.
_EQUALLY_LIKELY = 10.0
_EQUAL = 0.1  # difference of T of two frequencies that are aliases of each other in all pieces
# Share of T that a line leaves where its alias is as slow as drift, and that another frequency
# takes over.
_LEAKED = 0.1
_MISSING = 0.9  # share of T per piece, below which some of the pieces do not show the line
# Factor of the threshold at one rate: errors of the noise's spectrum are the same in all pieces.
_MARGIN = 1.5
_APART_HZ = 0.3  # closer lines are one
_SAME = 0.004  # relative difference of frequency: two searches see one mode, whatever the shapes
# Relative difference of frequency, and correlation of the shapes: two searches see one mode whose
# frequency has moved.
_FAR = 0.05
_SIMILAR = 0.8
_MOST_OF_LEAST = 0.9  # share of the least time that the pieces must have
_BEYOND_LAST = 1.001  # the last band ends just beyond the fastest alias
_LEAST_EIGENVALUE = 1e-3  # of the terms' noise, over the largest: smaller ones are rounding
_DRIFT_DEGREE = 3  # of the polynomial that counts as drift
_MOST_DEVIATIONS = 6  # robust ones, at which terms are clipped
_MAD_TO_SIGMA = 1.4826
_EQUAL_RATES = 1.03  # largest over smallest rate of pieces that count as one rate
_MEDIAN_OF_POWER = np.log(2)  # median over mean of an exponential distribution
_GAUSSIAN_QUANTILE = 1.2816  # distance of the 10 % quantile from the median, in sigmas


@dataclass(frozen=True)
class VibrationMode(StateNode):
    """One vibration.

    Attributes
    ----------
    frequency_hz : float
    sigma_hz : float
    amplitude_nm : float
        Amplitude of the oscillation, RMS over the mirror, with the ring at rest.
    shape : (terms,) array
        Zernike terms of unit RMS; the largest is positive.
    evidence : float
        T less that of noise.
    aliases_hz : tuple of float
        Frequencies that explain the frames equally well: aliases that one frame rate cannot
        distinguish. `frequency_hz` is the lowest.
    """

    frequency_hz: float
    sigma_hz: float
    amplitude_nm: float
    shape: Annotated[FloatArray, ArrayShape((ZERNIKE_TERMS,))]
    evidence: float
    aliases_hz: tuple[float, ...] = ()

    def is_like(self, other: "VibrationMode") -> bool:
        """Whether two searches see one mode: nearly the same frequency, or the same shape at a
        frequency that has moved.
        """
        change = abs(self.frequency_hz / other.frequency_hz - 1)
        if change < _SAME:
            return True
        correlation = abs(float(self.shape @ other.shape))
        return change < _FAR and correlation > _SIMILAR


@dataclass(frozen=True)
class _Piece:
    """Some seconds of frames, and how they see each frequency of the search.

    Attributes
    ----------
    time_s : (n,) array
    rate_hz : float
    window : (n,) array
    waves : (frequencies, n) complex array
    alias_hz : (frequencies,) array
        Aliases of the searched frequencies below half the frame rate.
    blind : (frequencies,) bool array
        Frequencies with an alias in the drift, or at half the frame rate, where X is real.
    """

    time_s: FloatArray
    rate_hz: float
    window: FloatArray
    waves: ComplexArray
    alias_hz: FloatArray
    blind: BoolArray

    def project_terms(self, terms_um: FloatArray) -> ComplexArray:
        """X (frequencies, terms - 1) of terms (n, terms - 1)."""
        return np.asarray(self.waves @ (self.window[:, None] * terms_um))

    def shares_alias(self, frequency_hz: float) -> BoolArray:
        """The frequencies (frequencies,) that have nearly the alias of a line."""
        alias_hz = abs(frequency_hz - self.rate_hz * round(frequency_hz / self.rate_hz))
        reach_hz = (_REMOVED_OFFSETS[-1] + 1) / PIECE_S
        return np.asarray(np.abs(self.alias_hz - alias_hz) < reach_hz)

    def estimate_noise(self, power: FloatArray, gone: BoolArray) -> FloatArray:
        """Noise under the lines: a function of the alias that falls with it, from drift to
        white noise.

        It is the median of the power over bands of half an octave, never larger than in a slower
        band, where a line has less influence. The frequencies with a line are left out while most
        of the band remains: an emptied slow band would leave no noise for itself and all faster
        ones.

        Parameters
        ----------
        power : (frequencies, terms - 1) array
            |X|^2 of the terms.
        gone : (frequencies,) bool array
            Frequencies near a line that was found.

        Returns
        -------
        (frequencies, terms - 1) array
        """
        # Bands of half an octave, from below the slowest line to the fastest alias.
        slowest_hz = _LEAST_HZ / 2
        fastest_hz = self.alias_hz.max()
        octaves = np.log2(fastest_hz / slowest_hz)
        edges = np.geomspace(slowest_hz, fastest_hz * _BEYOND_LAST, 3 + int(2 * octaves))
        levels = []
        middles = []
        for low, high in pairwise(edges):
            inside = (self.alias_hz >= low) & (self.alias_hz < high)
            if not inside.any():
                continue
            remaining = inside & ~gone
            most_remains = 2 * remaining.sum() > inside.sum()
            band = inside
            if most_remains:
                band = remaining
            levels.append(np.median(power[band], axis=0) / _MEDIAN_OF_POWER)
            middles.append(np.log(np.sqrt(low * high)))

        # Falling with frequency, and not below the rounding of the recorded terms, whose variance
        # is grain^2 / 12.
        rounding = np.sum(self.window**2) * _GRAIN_UM**2 / 12
        falling = np.minimum.accumulate(levels, axis=0)
        logs = np.log(np.maximum(falling, rounding))

        # Interpolated between the bands in the logarithms of frequency and power.
        log_alias = np.log(np.maximum(self.alias_hz, slowest_hz))
        columns = [np.interp(log_alias, middles, column) for column in logs.T]
        return np.asarray(np.exp(np.column_stack(columns)))

    def remove_oscillations(
        self, terms_um: FloatArray, frequency_hz: float, shapes: FloatArray
    ) -> FloatArray:
        """Return the terms without the oscillations about a frequency.

        Parameters
        ----------
        terms_um : (n, terms - 1) array
        frequency_hz : float
        shapes : (terms - 1, terms - 1) array
            Projection that selects which of them.
        """
        # Cosines and sines at the frequency and beside it, fitted to the selected terms.
        rad_per_hz = 2 * np.pi * (self.time_s - self.time_s[0])
        waves = []
        for offset in _REMOVED_OFFSETS:
            phase = (frequency_hz + offset / PIECE_S) * rad_per_hz
            waves += [np.cos(phase), np.sin(phase)]
        base = np.column_stack(waves)
        amplitudes = np.linalg.lstsq(base, terms_um @ shapes, rcond=None)[0]
        return np.asarray(terms_um - base @ amplitudes)


def find_modes(
    time_s: FloatArray, coeffs_um: FloatArray, most_hz: float = 100.0
) -> tuple[VibrationMode, ...] | None:
    """Find the vibrations in tracked terms.

    Parameters
    ----------
    time_s : (n,) array
        Times of the frames.
    coeffs_um : (n, terms) array
        Terms of each frame; NaN where a frame was rejected.
    most_hz : float
        Highest frequency to search.

    Returns
    -------
    tuple of VibrationMode or None
        The modes, the strongest first; None if there are less than 20 s of frames at a steady rate.
    """
    # The good frames in pieces of one rate. The first term only puts the vertex at 0: it would
    # count what moves the vertex twice.
    good = np.isfinite(coeffs_um).all(axis=1)
    grid_hz = np.arange(_LEAST_HZ, most_hz, 1 / (_GRID * PIECE_S))
    pieces, terms = _split_frames(time_s[good], coeffs_um[good, 1:], grid_hz)
    durations_s = [piece.time_s[-1] - piece.time_s[0] for piece in pieces]
    if sum(durations_s) < _MOST_OF_LEAST * LEAST_S:
        return None
    margin = 1.0
    if _have_one_rate([piece.rate_hz for piece in pieces]):
        margin = _MARGIN

    # In how many pieces each frequency is visible, and the power before any line is removed.
    visible = np.sum([~piece.blind for piece in pieces], axis=0)
    whole_power = [np.abs(spectrum) ** 2 for spectrum in _project_pieces(pieces, terms)]
    # For each piece, the frequencies whose aliases were removed with a line.
    gone = [np.zeros(grid_hz.size, bool) for _ in pieces]

    found: list[VibrationMode] = []
    for _ in range(_MOST_MODES):
        # Evidence at each frequency, in units of the noise that the lines found so far leave.
        spectra = _project_pieces(pieces, terms)
        noises = []
        for spectrum, before, piece, away in zip(spectra, whole_power, pieces, gone, strict=True):
            power = np.where(away[:, None], before, np.abs(spectrum) ** 2)
            noises.append(piece.estimate_noise(power, away))
        seen = _compute_evidence(spectra, noises, pieces)
        if seen.max() < margin * _compute_threshold(seen, grid_hz.size):
            break

        # The strongest line: its frequency, amplitude and shape. In the other pieces its alias is
        # as slow as drift.
        k, rivals = _find_likeliest(seen, visible)
        frequency, sigma = _refine_frequency(seen, grid_hz, k)
        used = [p for p, piece in enumerate(pieces) if not piece.blind[k]]
        amplitude_nm, shape = _compute_shape(
            [spectra[p][k] for p in used],
            [pieces[p] for p in used],
            [noises[p][k] for p in used],
        )

        # Its error: the curvature of T, or the scatter among the pieces if that is larger.
        direction = shape[1:] / np.linalg.norm(shape[1:])
        own_power = [np.abs(spectra[p] @ direction) ** 2 for p in used]
        sigma = max(sigma, _scatter_hz(own_power, grid_hz, k))

        # A new mode, with all frequencies that the frames cannot exclude.
        is_known = any(abs(frequency - mode.frequency_hz) < _APART_HZ for mode in found)
        if not is_known:
            evidence = float(seen[k] - np.median(seen))
            rates_hz = [pieces[p].rate_hz for p in used]
            aliases = _aliases_hz(rates_hz, frequency, most_hz)
            if not aliases:
                aliases = tuple(grid_hz[rivals].tolist())
            found.append(VibrationMode(frequency, sigma, amplitude_nm, shape, evidence, aliases))

        # Remove its shape; if it was found before, all shapes at its frequency.
        remaining = []
        for piece, part, noise in zip(pieces, terms, noises, strict=True):
            shapes = np.eye(direction.size)
            if not is_known:
                shapes = _projection_onto(direction, noise[k])
            remaining.append(piece.remove_oscillations(part, frequency, shapes))
        terms = remaining
        gone = [
            away | piece.shares_alias(frequency) for piece, away in zip(pieces, gone, strict=True)
        ]
    return tuple(_drop_false_aliases(mode, found) for mode in found)


def _project_pieces(pieces: Sequence[_Piece], terms: Sequence[FloatArray]) -> list[ComplexArray]:
    """X (frequencies, terms - 1) of each piece."""
    return [piece.project_terms(part) for piece, part in zip(pieces, terms, strict=True)]


def _drop_false_aliases(mode: VibrationMode, found: list[VibrationMode]) -> VibrationMode:
    """The mode without aliases that are themselves modes: they stood out when it was gone."""
    others_hz = np.array([other.frequency_hz for other in found])
    kept = (alias for alias in mode.aliases_hz if np.abs(others_hz - alias).min() > _APART_HZ)
    return replace(mode, aliases_hz=tuple(kept))


def _split_frames(
    time_s: FloatArray, coeffs_um: FloatArray, grid_hz: FloatArray
) -> tuple[list[_Piece], list[FloatArray]]:
    """The frames in pieces, and their terms without drift."""
    pieces = []
    terms = []
    for frames in _find_runs(time_s):
        # The frame rate, and where each frequency of the search appears at it.
        t = time_s[frames]
        rate_hz = 1 / float(np.median(np.diff(t)))
        alias_hz = np.abs(grid_hz - rate_hz * np.round(grid_hz / rate_hz))
        blind = (alias_hz < _LEAST_HZ) | (alias_hz > rate_hz / 2 - 2 / PIECE_S)

        # Hann's window, which is 0 one frame beyond both ends, and the waves of the projection.
        middle_s = (t[0] + t[-1]) / 2
        half_s = (t[-1] - t[0]) / 2 + 1 / rate_hz
        window = np.cos(np.pi / 2 * (t - middle_s) / half_s) ** 2
        from_first_s = t - t[0]
        waves = np.exp(-2j * np.pi * grid_hz[:, None] * from_first_s)
        pieces.append(_Piece(t, rate_hz, window, waves, alias_hz, blind))
        terms.append(_without_drift(t, coeffs_um[frames]))
    return pieces, terms


def _find_runs(time_s: FloatArray) -> list[slice]:
    """Frames of one rate without a gap, in pieces of about the same length."""
    from scipy import ndimage

    intervals = np.diff(time_s)
    if intervals.size <= 2 * _HALF:
        return []

    # The rate changes in the middle of each stretch where the medians on both sides differ.
    usual = ndimage.median_filter(intervals, 2 * _HALF + 1, mode="nearest")
    before = usual[: -2 * _HALF]
    after = usual[2 * _HALF :]
    differs = np.append(0, np.abs(after - before) > _OTHER_RATE * before)
    edges_of_stretches = np.diff(np.append(differs, 0))
    begins = np.flatnonzero(edges_of_stretches == 1)
    ceases = np.flatnonzero(edges_of_stretches == -1)
    rate_changes = (begins + ceases) // 2 + _HALF

    # Runs between these changes and the gaps, each split evenly.
    gaps = np.flatnonzero(intervals > _GAP * usual)
    ends = np.union1d(rate_changes, gaps)
    pieces = []
    for first, last in pairwise([0, *(ends + 1), time_s.size]):
        duration_s = time_s[last - 1] - time_s[first]
        if duration_s >= _SHORTEST * PIECE_S:
            count = max(1, round(duration_s / PIECE_S))
            edges = np.linspace(first, last, count + 1).astype(int)
            pieces += [slice(a, b) for a, b in pairwise(edges)]
    return pieces


def _without_drift(time_s: FloatArray, terms_um: FloatArray) -> FloatArray:
    """Terms less a cubic, clipped at six robust deviations."""
    place = np.linspace(-1, 1, time_s.size)
    base = np.column_stack([place**power for power in range(_DRIFT_DEGREE + 1)])
    cubic = base @ np.linalg.lstsq(base, terms_um, rcond=None)[0]
    rest = terms_um - cubic
    deviation = _MAD_TO_SIGMA * np.median(np.abs(rest), axis=0)
    most = _MOST_DEVIATIONS * np.maximum(deviation, _GRAIN_UM)
    return np.asarray(np.clip(rest, -most, most))


def _compute_evidence(
    spectra: list[ComplexArray], noises: list[FloatArray], pieces: list[_Piece]
) -> FloatArray:
    """T (frequencies,): the largest eigenvalue over the shapes, with terms and pieces in units of
    their noise.
    """
    scaled = [spectrum / np.sqrt(noise) for spectrum, noise in zip(spectra, noises, strict=True)]
    white = np.stack(scaled, axis=1)  # (frequencies, pieces, terms - 1)

    # The covariance of the terms' noise, from the quiet half: lines and their aliases are in the
    # other one.
    power = np.sum(np.abs(white) ** 2, axis=2)
    quiet = white[power <= np.median(power, axis=0)]
    covariance = np.real(quiet.conj().T @ quiet) / len(quiet)
    values, vectors = np.linalg.eigh(covariance)

    # Combinations of terms whose noise is independent and of unit variance. A blind piece shows
    # nothing.
    kept = values > _LEAST_EIGENVALUE * values[-1]
    independent = (white @ vectors[:, kept]) / np.sqrt(values[kept])
    is_blind = np.stack([piece.blind for piece in pieces], axis=1)
    independent[is_blind] = 0

    # Real and imaginary parts of all pieces are rows of one matrix; the largest eigenvalue of its
    # square is the power of the best common shape.
    parts = np.concatenate([independent.real, independent.imag], axis=1)
    squares = parts @ parts.transpose(0, 2, 1)
    return np.asarray(np.linalg.eigvalsh(squares)[:, -1])


def _compute_threshold(seen: FloatArray, frequencies: int) -> float:
    """T that chance exceeds at any of the frequencies with `_CHANCE`, for a gamma distribution of
    these quantiles.
    """
    from scipy import stats

    visible = seen[seen > 0]  # all pieces are blind to the others
    if not visible.size:
        return float("inf")
    # Quantiles of the lower half, where neither lines nor their aliases are.
    low, middle = np.quantile(visible, [0.1, 0.5])
    if not middle > low:
        return float("inf")  # nothing moves at all
    order = max((_GAUSSIAN_QUANTILE * middle / (middle - low)) ** 2, 1.0)
    scale = middle / stats.gamma.median(order)
    return float(scale * stats.gamma.isf(_CHANCE / frequencies, order))


def _find_likeliest(seen: FloatArray, visible: IntArray) -> tuple[int, list[int]]:
    """The frequency with the largest T, and others that explain the frames as well.

    Of equal ones it is the one that all its pieces show, then the lowest.
    """
    # Peaks of T that are nearly as high as the highest, and not its flanks.
    best = int(np.argmax(seen))
    inner = seen[1:-1]
    near = seen[best] - max(_EQUALLY_LIKELY, _LEAKED * seen[best])
    is_peak = (inner >= seen[:-2]) & (inner > seen[2:])
    peaks = 1 + np.flatnonzero(is_peak & (inner > near))
    apart = round(_APART_HZ * _GRID * PIECE_S)
    candidates = [best, *(int(k) for k in peaks if abs(k - best) > apart)]

    # Those that all their pieces show.
    per_piece = {k: seen[k] / visible[k] for k in candidates}
    most_per_piece = max(per_piece.values())
    candidates = [k for k in candidates if per_piece[k] > _MISSING * most_per_piece]

    # The lowest of nearly equal ones, and the others that may not be excluded.
    most = max(seen[k] for k in candidates)
    likeliest = min(k for k in candidates if seen[k] > most - _EQUAL)
    rivals = [k for k in candidates if k != likeliest and seen[k] > most - _EQUALLY_LIKELY]
    return likeliest, sorted(rivals)


def _have_one_rate(rates_hz: list[float]) -> bool:
    """Whether all pieces have the same frame rate, so that they have the same aliases."""
    return max(rates_hz) < _EQUAL_RATES * min(rates_hz)


def _aliases_hz(rates_hz: list[float], frequency_hz: float, most_hz: float) -> tuple[float, ...]:
    """All aliases of a frequency that pieces of one rate alone show: others may be blind to the
    true one.
    """
    if not _have_one_rate(rates_hz):
        return ()
    # At a rate r a frequency shows as |f - n r|, and so do all |m r +- alias|.
    rate_hz = float(np.mean(rates_hz))
    alias_hz = abs(frequency_hz - rate_hz * round(frequency_hz / rate_hz))
    every = {
        abs(m * rate_hz + sign * alias_hz)
        for m in range(int(most_hz / rate_hz) + 1)
        for sign in (-1, 1)
    }
    in_range = sorted(f for f in every if _LEAST_HZ < f < most_hz)
    return tuple(f for f in in_range if abs(f - frequency_hz) > _APART_HZ)


def _refine_frequency(seen: FloatArray, grid_hz: FloatArray, k: int) -> tuple[float, float]:
    """Frequency and its standard deviation from the parabola through three values of T."""
    step = grid_hz[1] - grid_hz[0]
    if not 0 < k < seen.size - 1:
        return float(grid_hz[k]), float(step)
    # T is a log likelihood: its second derivative is minus the inverse of the variance.
    before, here, after = seen[k - 1 : k + 2]
    bend = before - 2 * here + after
    if bend >= 0:
        return float(grid_hz[k]), float(step)
    offset = float(np.clip((before - after) / (2 * bend), -1, 1))
    frequency_hz = grid_hz[k] + offset * step
    sigma_hz = step / np.sqrt(-bend)
    return float(frequency_hz), float(sigma_hz)


def _compute_shape(
    lines: Sequence[ComplexArray], pieces: Sequence[_Piece], noises: Sequence[FloatArray]
) -> tuple[float, FloatArray]:
    """Amplitude in nm and terms (terms,) of unit RMS with the ring at rest, from X (terms - 1,) of
    each piece at the line.

    All terms are in phase. A piece that has the line among slow motion, which is a shape too, has
    little weight.
    """
    # Complex amplitudes (pieces, terms - 1) and weights (pieces,), the inverse of their noise.
    window_sums = np.array([piece.window.sum() for piece in pieces])
    waves = 2 * np.array(lines) / window_sums[:, None]
    weights = window_sums**2 / np.array([noise.mean() for noise in noises])

    # The common shape is the largest eigenvector of their weighted products.
    products = np.real((weights[:, None] * waves).conj().T @ waves)
    terms = np.linalg.eigh(products)[1][:, -1]

    # The first term puts the ring at rest; then unit RMS, with the largest term positive.
    shape = np.append(-terms @ zernike.at_rim()[1:], terms)
    size = float(np.linalg.norm(shape))
    shape *= np.sign(shape[np.argmax(np.abs(shape))]) / size

    mean_square = np.average(np.abs(waves @ terms) ** 2, weights=weights)
    amplitude_nm = float(1e3 * size * np.sqrt(mean_square))
    return amplitude_nm, np.asarray(shape)


def _projection_onto(shape: FloatArray, noise: FloatArray) -> FloatArray:
    """Projection of terms onto a shape, (terms - 1, terms - 1), weighted by their noise.

    The film's slow motion is mostly one term: with equal weights it would count as the shape's
    other terms.
    """
    weighed = shape / noise
    return np.outer(weighed, shape) / (weighed @ shape)


def _scatter_hz(lines: list[FloatArray], grid_hz: FloatArray, k: int) -> float:
    """Standard error of the mean of the pieces' own frequencies: that of a damped line varies by
    its width.
    """
    if len(lines) < 2:
        return 0.0
    # The largest power of each piece within the distance of two lines, refined between the grid.
    reach = round(_APART_HZ * _GRID * PIECE_S)
    first = max(k - reach, 0)
    last = min(k + reach + 1, grid_hz.size)
    own_hz = []
    for line in lines:
        peak = first + int(np.argmax(line[first:last]))
        own_hz.append(_refine_frequency(line, grid_hz, peak)[0])
    return float(np.std(own_hz, ddof=1) / np.sqrt(len(own_hz)))
