"""Learns the expansions of film and ring from a night of figures, temperatures and humidity.

At a held centre the spherical term of the figure, z, follows the excess strain of the film:

    z(t) = S (a_f dT_film(t) - a_r dT_ring(t) + b dm(t)) + z_0 + z_1 t,    dm/dt = (dH - m) / T_m

S is the sensitivity of `climate_figure`. a_f, a_r, b, z_0, z_1 and the moisture m(0) are linear;
T_m is searched. A slow drift z_1 is free because creep changes the figure, too.

Errors are those of a jackknife over blocks of an hour, as the residual is not white; T_m is
free in it, too, to first order.

Noise of a thermometer would make its expansion too small. Figures and sensors are therefore
smoothed equally before the fit, which changes no relation between them. What noise is left counts
as an error.
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
# Share by which the spherical term of `climate_figure` is wrong: Foeppl's law against a film with
# finite rotations
_LAW_ERROR = 0.02
# Of the running means of all series, the longest first. Waves of the climate that are as short, as
# of an air conditioner, would be averaged away: the first that leaves this share of what varies in
# each cause is used.
_SMOOTH_S = (900.0, 300.0, 60.0)
_LEAST_LEFT = 0.5


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
        RMS of the spherical term that the climate does not explain.
    explained : float
        Share of the variance of the spherical term that it explains.
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
    # The causes that have changed enough, filled where a minute is missing
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
    if not causes:
        raise ValueError("neither temperature nor humidity has changed enough")
    good = np.isfinite(spherical_um)
    if good.sum() < 0.5 * good.size:
        raise ValueError("less than half of the record has figures")
    width = _choose_width(list(causes.values()), float(np.median(np.diff(time_s))))
    seen_um = np.interp(time_s, time_s[good], spherical_um[good])

    def make_columns(follows_s: float) -> FloatArray:
        columns = [
            _follow(values, time_s, follows_s) if name == "humidity" else values
            for name, values in causes.items()
        ]
        drift = (time_s - time_s[0]) / (time_s[-1] - time_s[0])
        scaled = [sensitivity_um_per_ppm * column for column in columns]
        rest = [np.ones_like(drift), drift]
        if "humidity" in causes:
            # The film was not in balance at first
            rest.append(np.exp(-(time_s - time_s[0]) / follows_s))
        return np.column_stack([_smooth(column, width) for column in (*scaled, *rest)])

    wanted_um = _smooth(seen_um, width)

    def find_misfit(log_follows_s: float) -> float:
        return _solve(make_columns(float(np.exp(log_follows_s))), wanted_um)[1]

    follows_s = float("nan")
    if "humidity" in causes:
        bounds = (np.log(_FASTEST_S), np.log(_SLOWEST_S))
        found = minimize_scalar(find_misfit, bounds=bounds, method="bounded")
        follows_s = float(np.exp(found.x))
    columns = make_columns(follows_s)
    solution, misfit = _solve(columns, wanted_um)
    # Noise of each sensor, by its differences
    noises = [
        sensitivity_um_per_ppm**2 * float(np.var(np.diff(values))) / 2 / width
        for values in causes.values()
    ]
    # What is known of the ring counts as one more row, of the weight that the noise gives it
    names = list(causes)
    known = np.zeros(columns.shape[1])
    known_um = 0.0
    if known_ring is not None and "ring" in causes:
        hidden = sum(
            noise * value**2 for noise, value in zip(noises, solution[: len(noises)], strict=True)
        )
        weight = np.sqrt(width * (misfit + hidden)) / known_ring.sigma
        known[names.index("ring")] = weight
        known_um = weight * known_ring.value
    columns = np.vstack([columns, known])
    wanted_um = np.append(wanted_um, known_um)
    solution, misfit = _solve(columns, wanted_um)
    free = columns
    if "humidity" in causes:
        # The derivative by the logarithm of the time constant, by a step of a hundredth
        slower = make_columns(follows_s * np.exp(_LOG_STEP)) @ solution
        derivative = (slower - columns[:-1] @ solution) / _LOG_STEP
        free = np.column_stack([columns, np.append(derivative, 0.0)])
    sigmas = _jackknife(free, wanted_um, _smooth(time_s, width))
    for i, noise in enumerate(noises):
        # Against what only this sensor, and what is known, show
        own = _solve(np.delete(columns, i, axis=1), columns[:, i])[1]
        sigmas[i] = np.hypot(sigmas[i], abs(solution[i]) * noise / own)
    if known_ring is not None and known.any():
        # The error of what is known enters all expansions
        other_um = np.append(wanted_um[:-1], known_um + np.linalg.norm(known) * known_ring.sigma)
        shift = _solve(columns, other_um)[0] - solution
        sigmas[: shift.size] = np.hypot(sigmas[: shift.size], shift)
    # The law of the film, by which all expansions are computed
    sigmas = np.hypot(sigmas, _LAW_ERROR * np.abs(np.append(solution, 0.0)[: sigmas.size]))
    expansions = {
        name: Expansion(float(solution[i]), float(sigmas[i])) for i, name in enumerate(names)
    }
    variance = float(np.var(wanted_um))
    return ClimateFit(
        expansions.get("film"),
        expansions.get("ring"),
        expansions.get("humidity"),
        follows_s,
        float(np.sqrt(misfit)),
        1.0 - misfit / variance if variance > 0 else 0.0,
    )


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


def _solve(columns: FloatArray, values: FloatArray) -> tuple[FloatArray, float]:
    """Least squares: the solution and the mean square of its residual."""
    solution = np.linalg.lstsq(columns, values, rcond=None)[0]
    residual = values - columns @ solution
    return np.asarray(solution), float(np.mean(residual**2))


def _jackknife(columns: FloatArray, values: FloatArray, time_s: FloatArray) -> FloatArray:
    """Standard deviations of the solution, from records that each miss a block.

    The last row, what is known, is in all.
    """
    blocks = np.append(((time_s - time_s[0]) // BLOCK_S).astype(int), -1)
    solutions = []
    for block in range(int(blocks.max()) + 1):
        kept = blocks != block
        solutions.append(_solve(columns[kept], values[kept])[0])
    each = np.array(solutions)
    spread = each - each.mean(axis=0)
    return np.asarray(np.sqrt((len(each) - 1) / len(each) * np.sum(spread**2, axis=0)))
