"""Separates motion of the mirror from noise of the reading: intensities from a quiet hold.

The response to the flow is removed from the readings, z = y - k int v(t - theta) dt, whatever loop
made the flow. The rest is the weather and the laser's noise. Its increments have the spectrum (per
sample, dt S)

    |1 - e^(-j w dt)|^2 (r + sum of s_i / dt / (1 + w^2 tau_i^2)^2)
        + q_fast dt + q_slow dt / (1 + w^2 tau^2)

r: laser noise (µm^2 per sample), q_fast: a random walk (air pressure), q_slow: a random walk that
reaches the gas through the film, tau = 12 s (air temperature), s_i: movement of any other colour,
for weather is no random walk at all frequencies and the standard deviation of a loop depends on
those about its bandwidth. The tau_i stand in equal ratios; log s_i bends little from one to the
next, so that the spectrum continues where noise hides it. The intensities maximise
Whittle's likelihood, sum of log S + I / S over the periodogram I of the tapered increments, times
that prior.
Source: Percival and Walden, Spectral Analysis for Univariate Time Series (2020), sections 6.3 and
9.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.signal.windows import hann

from tuning.identification import plant_model
from tuning.identification.record import Record, Series

# Slower motion does not matter to the loop, and weather is no longer a random walk.
SLOWEST_S = 100.0
FLOOR = 1e-12  # µm^2: stands for a zero intensity
_LARGEST = 1e9  # µm^2/s: the film would burst
_HANN_LOSS = 35.0 / 18.0  # neighbouring frequencies of a Hann taper share this much
_COLOUR_RATIO = 2.0  # of neighbouring tau_i, from the sample time to the slowest
# of first and second differences of log s_i: a spectrum falls with the square of the frequency,
# more or less, and does not bend all at once
_SLOPE_SIGMA = 2.0
_BEND_SIGMA = 1.0
_BAND = 0.03  # frequencies nearer than this factor count as one
_LOW_FREQUENCIES = 8  # bins whose mean power starts the search for the walk's intensity
_MOST_ITERATIONS = 200
_GRADIENT = 1e-2  # of the log likelihood by the logs, at which the search ends
Coloured = tuple[tuple[float, float], ...]  # (tau in s, s in unit^2 s) of s / (1 + (w tau)^2)^2


def compute_coloured_psd(coloured: Coloured, w_rad_per_s: Series) -> Series:
    """Compute the two-sided spectrum of movement of other colours than a random walk's.

    Parameters
    ----------
    coloured : tuple of (float, float)
        tau_i in s and s_i in unit^2 s of each.
    w_rad_per_s : (n,) array
        Angular frequencies.

    Returns
    -------
    (n,) array
        Sum of s_i / (1 + w^2 tau_i^2)^2, unit^2 s.
    """
    if not coloured:
        return np.zeros_like(w_rad_per_s)
    parts = [intensity / (1 + (w_rad_per_s * tau_s) ** 2) ** 2 for tau_s, intensity in coloured]
    return np.asarray(np.sum(parts, axis=0))


@dataclass(frozen=True, slots=True)
class Noise:
    """White noise of a reading, the random walk of its quantity, and movement of other colours.

    Raises ValueError for numbers that no fit gives.

    Attributes
    ----------
    white : float
        Standard deviation of a sample.
    fast, slow : float
        Intensities of the two walks: variance per second.
    slow_s : float
        Lag of the slow walk.
    dt_s : float
        Sample time that `white` belongs to.
    coloured : tuple of (float, float)
        As in `compute_coloured_psd`.
    """

    white: float
    fast: float
    slow: float
    slow_s: float
    dt_s: float
    coloured: Coloured = ()

    def __post_init__(self) -> None:
        """Check the numbers: a file may hold anything."""
        numbers = (self.white, self.fast, self.slow, self.slow_s, self.dt_s)
        if not all(0 <= number <= _LARGEST for number in numbers):
            raise ValueError(
                f"noise of {self.white:g} and walks of {self.fast:g} and {self.slow:g}"
            )
        for tau_s, intensity in self.coloured:
            if not (0 < tau_s <= _LARGEST and 0 <= intensity <= _LARGEST):
                raise ValueError(f"movement of {self.coloured}")

    def moving_psd(self, w_rad_per_s: Series) -> Series:
        """Two-sided spectrum of the true movement, unit^2 s."""
        # A walk of intensity q has the spectrum q / w^2; the slow one passes a first-order lag.
        slow_through_lag = self.slow / (1 + (w_rad_per_s * self.slow_s) ** 2)
        walks = (self.fast + slow_through_lag) / w_rad_per_s**2
        return walks + compute_coloured_psd(self.coloured, w_rad_per_s)

    @property
    def white_psd(self) -> float:
        """Two-sided spectrum of the reading's noise, unit^2 s."""
        return self.white**2 * self.dt_s


def remove_pump_motion_um(record: Record, model: plant_model.PlantModel) -> Series:
    """Return z: the readings without the effect of pump and mean leak.

    Parameters
    ----------
    record : Record
        n ticks; missing readings are filled.
    model : PlantModel
        Gain, dead time and lag of the pump.

    Returns
    -------
    (n,) array
        µm.
    """
    driven = plant_model.compute_driven_um(
        record.flow_um_per_s, model.dead_time_s, model.lag_s, record.dt_s
    )
    return record.filled_displacement_um() - model.gain * driven


def fit_noise(series: Series, dt_s: float, slow_s: float) -> Noise:
    """Fit the intensities of white noise and movement in a series; a straight trend has no effect.

    Parameters
    ----------
    series : (n,) array
        Values, evenly sampled.
    dt_s : float
        Sample time.
    slow_s : float
        Lag of the slow walk; 0 omits it.

    Returns
    -------
    Noise

    Raises
    ------
    ValueError
        The series is shorter than two of the slowest periods used.
    """
    if series.size * dt_s < 2 * SLOWEST_S:
        raise ValueError(
            f"{series.size * dt_s:.0f} s of hold are too short: {2 * SLOWEST_S:.0f} s at least"
        )
    w, power, count = _compute_periodogram(np.diff(series), dt_s)

    # Spectra of the increments for unit intensity (the module's formula): white noise, one or two
    # walks, and each colour. They are linear in the intensities.
    white = np.abs(1 - np.exp(-1j * w * dt_s)) ** 2
    walks = [np.full(w.size, dt_s)]
    if slow_s > 0:
        walks.append(dt_s / (1 + (w * slow_s) ** 2))
    slowest_s = SLOWEST_S / (2 * math.pi)
    ratios = round(math.log(slowest_s / dt_s, _COLOUR_RATIO))
    taus_s = np.geomspace(dt_s, slowest_s, 1 + ratios)
    colours = [white / dt_s / (1 + (w * tau_s) ** 2) ** 2 for tau_s in taus_s]
    basis = np.array([white, *walks, *colours])

    # Start: half the power is white noise; the slowest bins are one walk, or colours of its size.
    white_guess = float(power @ count / count.sum()) / 2
    walk_guess = float(np.mean(power[:_LOW_FREQUENCIES])) / dt_s
    colour_guesses = walk_guess * taus_s**2 / taus_s.size
    guess = [white_guess, *[walk_guess] * len(walks), *colour_guesses]

    # The likeliest intensities; logarithms keep them above 0.
    first_colour = 1 + len(walks)
    prior_rows, prior_values = _make_prior(taus_s, first_colour)
    logs = _maximise_likelihood(basis, power, count, prior_rows, prior_values, np.log(guess))
    intensities = np.exp(logs)

    fast = float(intensities[1])
    slow = 0.0
    if len(walks) > 1:
        slow = float(intensities[2])
    coloured = tuple(zip(taus_s.tolist(), intensities[first_colour:].tolist(), strict=True))
    return Noise(math.sqrt(intensities[0]), fast, slow, slow_s, dt_s, coloured)


def _make_prior(taus_s: Series, first: int) -> tuple[Series, Series]:
    """Prior of the logarithms of the intensities, as rows of least squares.

    Second differences of log s_i over the colours are near 0, first ones near those of a spectrum
    that falls with the square of the frequency.

    Parameters
    ----------
    taus_s : (k,) array
        Times of the colours.
    first : int
        Logarithms before those of the colours; they are free.

    Returns
    -------
    rows : (2 k - 3, first + k) array
    values : (2 k - 3,) array
        `rows` times the logarithms, less `values`, are independent and of unit variance.
    """
    one = np.eye(taus_s.size)
    bends = np.diff(one, 2, axis=0) / _BEND_SIGMA
    slopes = np.diff(one, axis=0) / _SLOPE_SIGMA
    rows = np.vstack((bends, slopes))
    usual_logs = 2 * np.log(taus_s)
    free = np.zeros((len(rows), first))
    return np.hstack((free, rows)), rows @ usual_logs


def _maximise_likelihood(
    basis: Series,
    power: Series,
    count: Series,
    prior_rows: Series,
    prior_values: Series,
    start: Series,
) -> Series:
    """Find the likeliest logarithms of the intensities by Newton's method in a trust region.

    Parameters
    ----------
    basis : (parts, n) array
        Spectra of the parts for unit intensity.
    power : (n,) array
        The periodogram.
    count : (n,) array
        Independent values that each frequency stands for.
    prior_rows, prior_values : (rows, parts), (rows,) arrays
        As in `_make_prior`.
    start : (parts,) array
        Logarithms to begin with.
    """

    def compute_cost(logs: Series) -> tuple[float, Series]:
        """Negative log likelihood with the prior, and its gradient."""
        # Whittle: sum of log S + I / S. d log S / d log q_i is the share of part i in S.
        spectrum = np.exp(logs) @ basis
        off = prior_rows @ logs - prior_values
        by_log_spectrum = count * (1 - power / spectrum)
        slope = _compute_shares(logs, basis) @ by_log_spectrum + prior_rows.T @ off
        likelihood = count @ (np.log(spectrum) + power / spectrum)
        return float(likelihood + off @ off / 2), slope

    def compute_information(logs: Series) -> Series:
        """Fisher's information: the expected second derivatives, which are positive everywhere."""
        shares = _compute_shares(logs, basis)
        return np.asarray(shares * count @ shares.T + prior_rows.T @ prior_rows)

    found = minimize(
        compute_cost,
        start,
        jac=True,
        hess=compute_information,
        method="trust-exact",
        options={"gtol": _GRADIENT, "maxiter": _MOST_ITERATIONS},
    ).x
    return np.asarray(np.maximum(found, math.log(FLOOR)), dtype=float)


def _compute_shares(logs: Series, basis: Series) -> Series:
    """Share (parts, n) of each part in the spectrum."""
    parts = np.exp(logs)[:, None] * basis
    return np.asarray(parts / parts.sum(axis=0))


def _compute_periodogram(increments: Series, dt_s: float) -> tuple[Series, Series, Series]:
    """Periodogram of tapered increments, averaged over bands of 3 %.

    Returns
    -------
    w_rad_per_s : (n,) array
        Mean angular frequency of each band, from the slowest that matters to Nyquist.
    power : (n,) array
        Mean power, per sample.
    count : (n,) array
        Independent values in it.
    """
    # A Hann taper of unit power keeps the walk's low frequencies out of the high ones.
    taper = hann(increments.size, sym=False)
    taper /= math.sqrt(float(taper @ taper))
    tapered = (increments - increments.mean()) * taper
    power = np.abs(np.fft.rfft(tapered)) ** 2
    w = 2 * np.pi * np.fft.rfftfreq(increments.size, dt_s)

    # Without what is too slow, and without Nyquist's frequency, which has one part only.
    slowest = int(np.searchsorted(w, 2 * np.pi / SLOWEST_S))
    used = slice(slowest, w.size - 1)
    w = w[used]
    power = power[used]

    # Means over bands of the logarithm of the frequency.
    band = np.unique(np.floor(np.log(w / w[0]) / _BAND), return_inverse=True)[1]
    count = np.bincount(band)
    mean_w = np.bincount(band, w) / count
    mean_power = np.bincount(band, power) / count
    return mean_w, mean_power, count / _HANN_LOSS
