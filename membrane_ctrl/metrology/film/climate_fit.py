"""Learns the expansions of film and ring from a night of figures, temperatures and humidity.

At a held centre the spherical term of the figure, z, follows the excess strain of the film:

    z(t) = S (a_f dT_film(t) - a_r dT_ring(t) + b dm(t)) + z_0 + z_1 t,    dm/dt = (dH - m) / T_m

S is the sensitivity of `climate_figure`. a_f, a_r, b, z_0, z_1 and the moisture m(0) are linear;
T_m is searched. A slow drift z_1 is free because creep changes the figure, too.

Errors are those of a jackknife over blocks of an hour, as the residual is not white; T_m is
free in it, too, to first order.

Noise of a thermometer would make its expansion too small, most where film and ring are nearly in
phase. Figures and sensors are therefore smoothed equally before the fit, which changes no relation
between them, and what is left of the noise is subtracted from the normal equations:

    (A'A - n diag(v)) x = A'y,      v = variance of the noise in each column

(Fuller, Measurement Error Models, 1987, section 2.2). Where noise makes most of a direction, only
a part is subtracted, and the rest counts as an error.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from membrane_ctrl.model.arrays import FloatArray

BLOCK_S = 3600.0
LEAST_S = 4 * 3600.0
# A change of a temperature or of the humidity below this is no test of an expansion
_LEAST_CHANGE_K = 0.3
_LEAST_CHANGE_PERCENT = 2.0
# The time constant of the film's moisture is searched between these
_FASTEST_S = 120.0
_SLOWEST_S = 20_000.0
_LOG_STEP = 0.01
_NEWTON_STEPS = 6
_NEWTON_MOST = 0.2  # of the logarithm, in a step
# Share by which the spherical term of `climate_figure` is wrong: Foeppl's law against a film with
# finite rotations
_LAW_ERROR = 0.02
# Of the running means of all series, the longest first. Waves of the climate that are as short, as
# of an air conditioner, would be averaged away: the first that leaves this share of what varies in
# each cause is used.
_SMOOTH_S = (900.0, 300.0, 60.0)
_LEAST_LEFT = 0.5
# Largest share of a direction of the causes that may be noise: beyond, its inverse is noise itself
_NOISE_MOST = 0.3
# Noise of a sensor by fourth differences, in which waves of a quarter of an hour hardly show; the
# variance of white noise is 70 times as large in them. Steps are few: the median leaves them out.
_DIFFERENCES = 4
_DIFFERENCE_GAIN = 70.0
_MEDIAN_TO_SIGMA = 1.4826


@dataclass(frozen=True)
class Expansion:
    """A learned expansion and its standard deviation, in 1e-6 per kelvin or per cent."""

    value: float
    sigma: float


@dataclass(frozen=True)
class ClimateFit:
    """What a night shows.

    Attributes
    ----------
    film_per_k, ring_per_k, film_per_percent : Expansion or None
        None if its cause did not change enough.
    follows_humidity_s : float
        Time constant of the moisture; NaN without humidity.
    residual_um : float
        RMS of the spherical term that neither the climate nor a steady drift explains.
    explained : float
        Share that the climate explains of the variance of the spherical term about a steady drift.
    """

    film_per_k: Expansion | None
    ring_per_k: Expansion | None
    film_per_percent: Expansion | None
    follows_humidity_s: float
    residual_um: float
    explained: float


def fit_climate(
    time_s: FloatArray,
    spherical_um: FloatArray,
    film_c: FloatArray,
    ring_c: FloatArray,
    humidity_percent: FloatArray,
    sensitivity_um_per_ppm: float,
    known_ring: Expansion | None = None,
) -> ClimateFit:
    """Fit the expansions.

    Parameters
    ----------
    time_s : (n,) array
        Evenly spaced, e.g. each minute.
    spherical_um : (n,) array
        Noll 11 of the measured figure, mean of the interval; NaN without a figure.
    film_c, ring_c, humidity_percent : (n,) array
        Means of the interval; all NaN for a sensor that the bench does not have.
    sensitivity_um_per_ppm : float
        S.
    known_ring : Expansion, optional
        What is known of the ring, e.g. that it is of aluminium. Film and ring are nearly in phase
        over a day: without it only a room whose temperature changes within an hour separates them.

    Returns
    -------
    ClimateFit

    Raises
    ------
    ValueError
        Too short a record, or nothing of the climate has changed enough.
    """
    if time_s.size < 2 or time_s[-1] - time_s[0] < LEAST_S:
        raise ValueError(f"a record of {LEAST_S / 3600:.0f} hours is needed")
    causes = _list_causes(time_s, film_c, ring_c, humidity_percent)
    if not causes:
        raise ValueError("neither temperature nor humidity has changed enough")
    good = np.isfinite(spherical_um)
    if good.sum() < 0.5 * good.size:
        raise ValueError("less than half of the record has figures")

    # Figures and causes, smoothed equally.
    width = _choose_width(list(causes.values()), float(np.median(np.diff(time_s))))
    model = _ClimateModel(time_s, causes, sensitivity_um_per_ppm, width)
    filled_um = np.interp(time_s, time_s[good], spherical_um[good])
    wanted_um = _smooth(filled_um, width)

    # The time constant T_m by a search, all else by least squares.
    follows_s = model.find_time_constant(wanted_um)
    measured = wanted_um.size

    # What is known of the ring is one more row; without it the row is 0. It also helps to find T_m,
    # which in a short record takes up any error of the ring.
    wanted_um = np.append(wanted_um, 0.0)
    if known_ring is not None and "ring" in causes:
        noise = model.find_noise(follows_s)
        fitted = _solve(model.make_rows(follows_s), wanted_um, noise)
        scatter = _find_scatter(fitted, noise, filled_um, width, measured)
        wanted_um[-1] = model.add_known_ring(known_ring, float(np.sqrt(width * scatter)))
        follows_s = model.find_time_constant(wanted_um[:-1], float(wanted_um[-1]))
    columns = model.make_rows(follows_s)
    noise = model.find_noise(follows_s)
    fitted = _solve(columns, wanted_um, noise)
    solution = fitted.values
    scatter = _find_scatter(fitted, noise, filled_um, width, measured)

    # The residual itself, by the jackknife; T_m is free in it to first order.
    free, free_noise = columns, noise
    if "humidity" in causes:
        by_log_time = model.differentiate(follows_s, columns, solution)
        free = np.column_stack([columns, by_log_time])
        free_noise = np.append(noise, 0.0)
    found = _solve(free, wanted_um, free_noise)
    sigmas = _jackknife(free, wanted_um, _smooth(time_s, width), free_noise)

    # The error of what is known of the ring enters all expansions.
    if known_ring is not None and columns[-1].any():
        other_um = wanted_um.copy()
        other_um[-1] += np.linalg.norm(columns[-1]) * known_ring.sigma
        shift = _solve(free, other_um, free_noise).values - found.values
        sigmas = np.hypot(sigmas, shift)

    # Where causes are nearly in phase the blocks resemble each other too much: white noise of the
    # same scatter, with the error of what is known, is then the larger error.
    sigmas = np.maximum(sigmas, np.sqrt(width * scatter) * found.gain)

    # Noise of the sensors that could not be subtracted.
    sigmas = np.hypot(sigmas, found.attenuation)

    # The film's law, from which S follows, scales all expansions.
    sigmas = np.hypot(sigmas, _LAW_ERROR * np.abs(np.append(solution, 0.0)[: sigmas.size]))
    expansions = {
        name: Expansion(float(solution[i]), float(sigmas[i])) for i, name in enumerate(causes)
    }

    # What remains of the figures, and what would remain with a drift alone.
    residual_um = (wanted_um - columns @ solution)[:measured]
    misfit = float(np.mean(residual_um**2))
    drift = model.make_drift()
    drift_misfit = _solve(drift, wanted_um[:measured], np.zeros(drift.shape[1])).misfit
    explained = 0.0
    if drift_misfit > 0:
        explained = 1.0 - misfit / drift_misfit
    return ClimateFit(
        expansions.get("film"),
        expansions.get("ring"),
        expansions.get("humidity"),
        follows_s,
        float(np.sqrt(misfit)),
        explained,
    )


def _list_causes(
    time_s: FloatArray, film_c: FloatArray, ring_c: FloatArray, humidity_percent: FloatArray
) -> dict[str, FloatArray]:
    """The causes that have changed enough, (n,) about their means and filled where a value is
    missing. A warmer ring acts as a colder film.
    """
    causes: dict[str, FloatArray] = {}
    for name, values, least, sign in (
        ("film", film_c, _LEAST_CHANGE_K, 1.0),
        ("ring", ring_c, _LEAST_CHANGE_K, -1.0),
        ("humidity", humidity_percent, _LEAST_CHANGE_PERCENT, 1.0),
    ):
        seen = np.isfinite(values)
        if seen.sum() < 0.5 * values.size or np.ptp(values[seen]) < least:
            continue
        filled = np.interp(time_s, time_s[seen], values[seen])
        causes[name] = sign * (filled - filled.mean())
    return causes


class _ClimateModel:
    """The linear part of the equation above, for a time constant of the moisture.

    Parameters
    ----------
    time_s : (n,) array
        Evenly spaced.
    causes : dict of (n,) arrays
        As `_list_causes` returns them.
    sensitivity_um_per_ppm : float
        S.
    width : int
        Values of a running mean.
    """

    def __init__(
        self,
        time_s: FloatArray,
        causes: dict[str, FloatArray],
        sensitivity_um_per_ppm: float,
        width: int,
    ) -> None:
        self._time_s = time_s
        self._causes = causes
        self._sensitivity_um_per_ppm = sensitivity_um_per_ppm
        self._width = width
        self._step_s = float(np.median(np.diff(time_s)))
        unknowns = len(causes) + 2 + ("humidity" in causes)
        self._known: FloatArray = np.zeros(unknowns)

    def make_rows(self, follows_s: float) -> FloatArray:
        """The columns (n - width + 2, unknowns) with the row of what is known of the ring last."""
        return np.vstack([self.make_columns(follows_s), self._known])

    def make_columns(self, follows_s: float) -> FloatArray:
        """Columns (n - width + 1, unknowns), smoothed: the causes', then z_0 and z_1, then m(0).

        `follows_s` is T_m; NaN without humidity.
        """
        columns = [
            _follow(values, self._time_s, follows_s) if name == "humidity" else values
            for name, values in self._causes.items()
        ]
        scaled = [self._sensitivity_um_per_ppm * column for column in columns]
        smoothed = [_smooth(column, self._width) for column in scaled]
        if "humidity" not in self._causes:
            return np.column_stack([*smoothed, self.make_drift()])

        # The film was not in balance at first: its moisture approaches the room's.
        decay = np.exp(-(self._time_s - self._time_s[0]) / follows_s)
        return np.column_stack([*smoothed, self.make_drift(), _smooth(decay, self._width)])

    def make_drift(self) -> FloatArray:
        """Columns (n - width + 1, 2) of z_0 and z_1."""
        since_s = self._time_s - self._time_s[0]
        share = since_s / since_s[-1]
        constant = _smooth(np.ones_like(share), self._width)
        return np.column_stack([constant, _smooth(share, self._width)])

    def find_time_constant(self, wanted_um: FloatArray, known_um: float = 0.0) -> float:
        """T_m with the least misfit to the smoothed figures (n - width + 1,), s; NaN without
        humidity.

        `known_um` is the value of the row of what is known of the ring.
        """
        if "humidity" not in self._causes:
            return float("nan")
        rows_um = np.append(wanted_um, known_um)

        def find_misfit(log_follows_s: float) -> float:
            """Mean square of the residual with this time constant."""
            columns = self.make_rows(float(np.exp(log_follows_s)))
            return _solve(columns, rows_um, np.zeros(columns.shape[1])).misfit

        bounds = (np.log(_FASTEST_S), np.log(_SLOWEST_S))
        found = minimize_scalar(find_misfit, bounds=bounds, method="bounded")
        log_follows_s = float(found.x)
        # From there with the noise subtracted, by Gauss and Newton.
        for _ in range(_NEWTON_STEPS):
            follows_s = float(np.exp(log_follows_s))
            columns = self.make_rows(follows_s)
            noise = self.find_noise(follows_s)
            solution = _solve(columns, rows_um, noise).values
            derivative = self.differentiate(follows_s, columns, solution)
            free = np.column_stack([columns, derivative])
            step = float(_solve(free, rows_um, np.append(noise, 0.0)).values[-1])
            log_follows_s += float(np.clip(step, -_NEWTON_MOST, _NEWTON_MOST))
            log_follows_s = float(np.clip(log_follows_s, *bounds))
        return float(np.exp(log_follows_s))

    def differentiate(
        self, follows_s: float, columns: FloatArray, solution: FloatArray
    ) -> FloatArray:
        """The derivative (n - width + 2,) of the fit by the logarithm of T_m."""
        slower = self.make_rows(follows_s * float(np.exp(_LOG_STEP))) @ solution
        return np.asarray((slower - columns @ solution) / _LOG_STEP)

    def find_noise(self, follows_s: float) -> FloatArray:
        """Variance (unknowns,) of each smoothed column by noise of its sensor."""
        variances = np.zeros(self._known.size)
        for i, (name, values) in enumerate(self._causes.items()):
            left = 1.0 / self._width
            if name == "humidity":
                # Behind the moisture's lag; the running mean is shorter than that.
                share = -np.expm1(-self._step_s / follows_s)
                left = share / (2.0 - share)
            scale = self._sensitivity_um_per_ppm**2
            variances[i] = scale * _find_noise_variance(values) * left
        return variances

    def add_known_ring(self, known_ring: Expansion, sigma_um: float) -> float:
        """Add the row of what is known of the ring, and return its value.

        Its weight is that of one figure, whose standard deviation is `sigma_um`.
        """
        weight = sigma_um / known_ring.sigma
        self._known[list(self._causes).index("ring")] = weight
        return weight * known_ring.value


def _find_scatter(
    fitted: "_Solution", noise: FloatArray, figures_um: FloatArray, width: int, rows: int
) -> float:
    """Variance of a row: as the residual has it, but at least that of the sensors' noise."""
    independent = rows / width
    free = max(independent - fitted.values.size, 1.0)
    by_residual = fitted.misfit * independent / free
    by_noise = _find_noise_variance(figures_um) / width + float(noise @ fitted.values**2)
    return max(by_residual, by_noise)


def _choose_width(causes: list[FloatArray], step_s: float) -> int:
    """Number of values of the running means."""
    widths = [max(1, round(smooth_s / step_s)) for smooth_s in _SMOOTH_S]
    for width in widths:
        left = []
        for values in causes:
            noise = float(np.var(np.diff(values))) / 2
            varies = max(float(np.var(values)) - noise, np.finfo(float).tiny)
            left.append((float(np.var(_smooth(values, width))) - noise / width) / varies)
        if min(left) > _LEAST_LEFT:
            return width
    return widths[-1]


def _follow(values: FloatArray, time_s: FloatArray, lag_s: float) -> FloatArray:
    """The values behind a lag, in balance at first."""
    followed = np.empty_like(values)
    followed[0] = values[0]
    share = -np.expm1(-float(np.median(np.diff(time_s))) / lag_s)
    for k in range(1, values.size):
        followed[k] = followed[k - 1] + share * (values[k] - followed[k - 1])
    return followed


def _smooth(values: FloatArray, width: int) -> FloatArray:
    """Running means over `width` values, without the ends."""
    return np.convolve(values, np.full(width, 1.0 / width), mode="valid")


def _find_noise_variance(values: FloatArray) -> float:
    """Variance of white noise in a slow series, by its fourth differences."""
    differences = np.diff(values, _DIFFERENCES)
    sigma = _MEDIAN_TO_SIGMA * float(np.median(np.abs(differences)))
    return sigma**2 / _DIFFERENCE_GAIN


@dataclass(frozen=True)
class _Solution:
    """Least squares with noise in the columns.

    Attributes
    ----------
    values : (columns,) array
    misfit : float
        Mean square of the residual.
    attenuation : (columns,) array
        By how much noise that was not subtracted may have changed the values.
    gain : (columns,) array
        Standard deviation of the values for independent errors of 1.
    """

    values: FloatArray
    misfit: float
    attenuation: FloatArray
    gain: FloatArray


def _solve(columns: FloatArray, values: FloatArray, noise: FloatArray) -> _Solution:
    """Least squares, the noise (columns,) of the columns subtracted from the normal equations."""
    # Columns of length 1, so that their units do not matter.
    scale = np.linalg.norm(columns, axis=0)
    unit = columns / scale
    normal = unit.T @ unit
    noisy = np.diag(len(columns) * noise / scale**2)
    # Largest share of noise in any direction.
    root = np.linalg.pinv(np.linalg.cholesky(normal + 1e-13 * np.eye(len(scale))))
    share = float(np.linalg.eigvalsh(root @ noisy @ root.T)[-1])
    subtracted = 1.0
    if share > _NOISE_MOST:
        subtracted = _NOISE_MOST / share
    inverse = np.linalg.pinv(normal - subtracted * noisy, hermitian=True)
    found = inverse @ (unit.T @ values)
    attenuation = (1.0 - subtracted) * (inverse @ (noisy @ found))
    residual = values - unit @ found
    misfit = float(np.mean(residual**2))
    gain = np.sqrt(np.diag(inverse @ normal @ inverse))
    return _Solution(found / scale, misfit, np.abs(attenuation) / scale, gain / scale)


def _jackknife(
    columns: FloatArray, values: FloatArray, time_s: FloatArray, noise: FloatArray
) -> FloatArray:
    """Standard deviations of the solution, from records that each miss a block.

    The last row, what is known, is in all.
    """
    blocks = np.append(((time_s - time_s[0]) // BLOCK_S).astype(int), -1)
    solutions = []
    for block in range(int(blocks.max()) + 1):
        kept = blocks != block
        solutions.append(_solve(columns[kept], values[kept], noise).values)
    each = np.array(solutions)
    spread = each - each.mean(axis=0)
    return np.asarray(np.sqrt((len(each) - 1) / len(each) * np.sum(spread**2, axis=0)))
