"""Recognises actuators that no single lag describes: a second lag (a fan's rotor) and backlash.

Each is one parameter more in the model of the fit: a lag T2 in series, or a play p between the
commanded flow u and the flow v that the actuator follows,

    v[i] = min(max(v[i-1], u[i] - p), u[i] + p).

Gain, dead time, lag and leak are fitted again with it, with the noise model of the fit. By the
likelihood ratio n log(S0 / S1) of the sums S of squared prediction errors, a kind is named only if
it explains the record much better than one lag does, and better than the other kind.
Source: Ljung, System Identification (1999), section 16.4 (comparing model structures).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.optimize import least_squares, minimize_scalar
from scipy.signal import lfilter

from tuning.identification.plant_fit import Identified
from tuning.identification.plant_model import PlantModel, compute_driven_um
from tuning.identification.record import Record, Series

Kind = Literal["one lag", "two lags", "backlash"]

# Twice the logarithm of the likelihood ratio: 3.5 standard errors of one parameter, and 2.5
# against the other kind
_LEAST_RATIO = 12.0
_LEAST_LEAD = 6.0
_LAG_SHARE = 0.25  # of the first lag; a shorter second one is dead time to any loop
_LAG_MOST_S = 3.0
_PLAY_LEAST, _PLAY_MOST = 0.01, 0.45  # of the swing of the flow
_SWING_QUANTILES = 0.02, 0.98
_DELAY_MOST_S = 4.0


@dataclass(frozen=True, slots=True)
class ActuatorKind:
    """What the record shows of the actuator.

    Attributes
    ----------
    kind : str
        `one lag` if no other kind explains the record much better.
    lags_s : tuple of float
        The two lags, the longer one first; empty for other kinds.
    play_um_per_s : float
        Half of the dead band of the flow; 0 for other kinds.
    ratio : float
        Twice the logarithm of the likelihood ratio against one lag.
    """

    kind: Kind = "one lag"
    lags_s: tuple[float, ...] = ()
    play_um_per_s: float = 0.0
    ratio: float = 0.0

    def describe(self) -> str:
        """The kind in one sentence; empty for one lag."""
        if self.kind == "two lags":
            return (
                f"the actuator responds with two lags ({self.lags_s[0]:.2f} and "
                f"{self.lags_s[1]:.2f} s), like a fan with inertia"
            )
        if self.kind == "backlash":
            return (
                f"the actuator has backlash (the flow follows after {2 * self.play_um_per_s:.2f} "
                "µm/s of reversal): no gains remove the swing within it; remove the play, or bias "
                "it to one side"
            )
        return ""


def recognise_actuator(record: Record, identified: Identified) -> ActuatorKind:
    """Recognise the kind of actuator from the record of the experiments.

    Parameters
    ----------
    record : Record
        Readings and commanded flow of the experiments.
    identified : Identified
        The plant that was fitted to them.

    Returns
    -------
    ActuatorKind
        One lag, two lags, or a lag with backlash.
    """
    model = identified.model
    plain = _fit_remaining(record, identified, model, record.flow_um_per_s, 0.0)
    swing = float(np.ptp(np.quantile(record.flow_um_per_s, _SWING_QUANTILES)))
    if swing <= 0:
        return ActuatorKind()

    # a second lag, found along with the other parameters
    second_s, lagged = _search(
        lambda lag_s: _fit_remaining(record, identified, model, record.flow_um_per_s, lag_s),
        (record.dt_s, _LAG_MOST_S),
    )

    # a play between the commanded flow and the one that the actuator follows
    play, played = _search(
        lambda play: _fit_remaining(
            record, identified, model, follow_with_play(record.flow_um_per_s, play), 0.0
        ),
        (_PLAY_LEAST * swing, _PLAY_MOST * swing),
    )

    # Both kinds have one parameter more than the plain model. A second lag that is short beside the
    # first is dead time to any loop, and needs no name.
    size = len(record) - 1
    of_lag, of_play = (size * math.log(plain.cost / each.cost) for each in (lagged, played))
    if max(of_lag, of_play) < _LEAST_RATIO or abs(of_lag - of_play) < _LEAST_LEAD:
        return ActuatorKind(ratio=max(of_lag, of_play))
    if of_play > of_lag:
        return ActuatorKind("backlash", (), play, of_play)
    lags_s = sorted((lagged.lag_s, second_s), reverse=True)
    if lags_s[1] < _LAG_SHARE * lags_s[0]:
        return ActuatorKind(ratio=of_lag)
    return ActuatorKind("two lags", tuple(lags_s), 0.0, of_lag)


def follow_with_play(flow_um_per_s: Series, play_um_per_s: float) -> Series:
    """Return the flow that an actuator with play follows; it begins in the middle of its play.

    Parameters
    ----------
    flow_um_per_s : (n,) array
        Commanded flow.
    play_um_per_s : float
        Half the width of the play: the flow stays until the command is this far away.

    Returns
    -------
    (n,) array
    """
    followed = np.empty(flow_um_per_s.size)
    value = float(flow_um_per_s[0])
    for i, flow in enumerate(flow_um_per_s.tolist()):
        value = min(max(value, flow - play_um_per_s), flow + play_um_per_s)
        followed[i] = value
    return followed


@dataclass(frozen=True, slots=True)
class _Fit:
    cost: float  # sum of squared prediction errors
    lag_s: float


def _search(fit: Callable[[float], _Fit], bounds: tuple[float, float]) -> tuple[float, _Fit]:
    """The value in the bounds with the least cost, searched in its logarithm, and its fit."""
    # A coarse grid finds the valley, a bounded search its bottom.
    low, high = (math.log(bound) for bound in bounds)
    # A coarse search over the whole range; then a fine one between the neighbours of its best.
    coarse = np.linspace(low, high, 6)
    costs = [fit(math.exp(at)).cost for at in coarse.tolist()]
    place = int(np.argmin(costs))
    around = float(coarse[max(place - 1, 0)]), float(coarse[min(place + 1, coarse.size - 1)])
    found = minimize_scalar(
        lambda at: fit(math.exp(at)).cost, bounds=around, method="bounded", options={"xatol": 0.05}
    )
    best = float(found.x) if found.fun < costs[place] else float(coarse[place])
    return math.exp(best), fit(math.exp(best))


def _fit_remaining(
    record: Record, identified: Identified, start: PlantModel, flow: Series, second_s: float
) -> _Fit:
    """Gain, dead time, lag and leak fitted to a flow behind a further lag, with the given noise."""
    moved_um = np.diff(record.filled_displacement_um())
    if identified.pressure_gain_um_per_pa != 0.0:
        moved_um = moved_um - identified.pressure_gain_um_per_pa * np.diff(
            record.ambient_pressure_pa
        )
    dt_s = record.dt_s
    leak = identified.noise.whitened(np.full(moved_um.size, dt_s), dt_s)
    target = identified.noise.whitened(moved_um, dt_s)

    def errors(times_s: Series) -> Series:
        way = np.diff(compute_driven_um(flow, float(times_s[0]), float(times_s[1]), dt_s))
        if second_s > 0:
            kept = math.exp(-dt_s / second_s)
            way = lfilter([1.0 - kept], [1.0, -kept], way - way[0]) + way[0]
        columns = np.column_stack([identified.noise.whitened(way, dt_s), leak])
        return np.asarray(target - columns @ np.linalg.lstsq(columns, target, rcond=None)[0])

    # a second lag takes its share from dead time and first lag
    whole_s = start.delay_s
    begin = replace(start, dead_time_s=max(start.dead_time_s, 1e-3))
    if second_s > 0:
        left_s = max(whole_s - second_s, 2e-3)
        begin = replace(start, dead_time_s=0.5 * left_s, lag_s=0.5 * left_s)
    first = np.clip([begin.dead_time_s, begin.lag_s], 1e-3, _DELAY_MOST_S - 1e-3)
    fit = least_squares(
        errors,
        first,
        bounds=([0.0, 5e-4], [_DELAY_MOST_S, _DELAY_MOST_S]),
        xtol=1e-4,
        ftol=1e-6,
        x_scale=[0.05, 0.05],
    )
    return _Fit(2.0 * float(fit.cost), float(fit.x[1]))
