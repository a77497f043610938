"""What is explored, from a session or a run: plant, weather, present gains; and what other gains
would do.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from membrane_ctrl.config.schema import LoopConfig
from membrane_ctrl.control import loop_margins
from membrane_ctrl.model import arrays, errors, telemetry
from membrane_ctrl.run_files.run import open_run
from membrane_ctrl.sessions import folder
from tuning import gains_file
from tuning.identification import closed_loop, disturbance, noise_spectrum, plant_model
from tuning.identification.record import Record
from tuning.proposal import candidate, gain_search, tuning_rules
from tuning.steps import identify, observe

# An hour is a hundred times the slowest motion that the fit uses; two of its periods are the least
# it accepts.
_LONGEST_S, _SHORTEST_S = 3600.0, 2.0 * noise_spectrum.SLOWEST_S
_COLUMNS = ("flow_um_per_s", "displacement_um", "ambient_pressure_pa", "air_temperature_c")
STEP_UM = 1.0
# Shortest and longest closed-loop time constant that the slider offers, in delays of the plant;
# SIMC recommends 1.
DELAYS = (0.3, 30.0)
# Integral time in closed-loop time constants: 4 is SIMC's, critically damped; 2 oscillates, 16
# forgives much
DAMPINGS = (2.0, 16.0)
_SETTLINGS = 25.0  # duration of the responses in delays and closed-loop time constants
_POINTS_MAX = 6000


@dataclass(frozen=True, slots=True)
class Workpiece:
    """A loop to explore."""

    source: str  # where plant and weather come from, for the page
    model: plant_model.PlantModel
    weather: disturbance.DisturbanceModel
    loop: LoopConfig  # in use when plant and weather were recorded
    proposed: closed_loop.Gains | None  # of the session
    session: folder.SessionFolder | None  # receives the gains that a person saves


def of_path(path: Path, logs: Path) -> Workpiece:
    """The workpiece of a session folder or of a run folder.

    Raises InputError if it is neither, a session without quiet hold, or a run without 200 s of
    undisturbed hold.
    """
    return (
        of_session(folder.open_session(path))
        if (path / "session.json").exists()
        else of_run(path, logs)
    )


def of_session(opened: folder.SessionFolder) -> Workpiece:
    """Plant and weather as identified and observed in a session."""
    model, weather = (
        identify.load_identified(opened).identified.model,
        observe.load_disturbance(opened),
    )
    proposed = None
    if opened.is_done("design"):
        proposed = closed_loop.Gains.of(gains_file.load_gains(opened.file_path("gains.toml")).loop)
    source = f"Plant and weather of the session {opened.path.name}."
    return Workpiece(source, model, weather, opened.head.before, proposed, opened)


def of_run(path: Path, logs: Path) -> Workpiece:
    """Weather of a run's longest undisturbed hold; plant of the newest session, else as the
    configuration assumes.
    """
    run = open_run(path)
    loop = run.config.loop
    names = (*_COLUMNS, "state", "safe_level", "leak_um_per_s")
    blocks = list(run.tick_blocks(names))
    columns = {
        name: np.concatenate([block[name] for block in blocks] or [np.empty(0)]) for name in names
    }
    quiet = (columns["state"] == telemetry.State.HOLD) & (
        columns["safe_level"] == telemetry.SafeLevel.NONE
    )
    part = _longest(quiet, round(_LONGEST_S * loop.rate_hz))
    dt_s = 1.0 / loop.rate_hz
    if (part.stop - part.start) * dt_s < _SHORTEST_S:
        raise errors.InputError(
            f"{path}: no undisturbed hold of {_SHORTEST_S:.0f} s; choose another run or a session"
        )
    model, whose = _plant_for(logs, float(np.nanmedian(columns["leak_um_per_s"][part])))
    record = Record(dt_s, *(columns[name][part].astype(float) for name in _COLUMNS))
    try:
        weather = disturbance.observe_disturbance(record, model, loop)
    except ValueError as error:
        raise errors.InputError(f"{path}: {error}") from None
    minutes = record.duration_s / 60
    return Workpiece(
        f"Weather of {minutes:.0f} min of {run.name}; {whose}.", model, weather, loop, None, None
    )


def _longest(good: arrays.BoolArray, at_most: int) -> slice:
    """The longest stretch of true values; of one that is too long, the end."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], good, [False])).astype(np.int8)))
    if edges.size == 0:
        return slice(0, 0)
    starts, ends = edges[::2], edges[1::2]
    best = int(np.argmax(ends - starts))
    return slice(max(int(starts[best]), int(ends[best]) - at_most), int(ends[best]))


def _plant_for(logs: Path, leak_um_per_s: float) -> tuple[plant_model.PlantModel, str]:
    """The newest identified plant, else the assumed one with the run's own leak;
    and whose it is.
    """
    try:
        newest = folder.find_newest_session(logs)
        return identify.load_identified(
            newest
        ).identified.model, f"plant of the session {newest.path.name}"
    except errors.InputError:
        leak = leak_um_per_s if math.isfinite(leak_um_per_s) else 0.0
        plant = plant_model.PlantModel(1.0, loop_margins.DEAD_S, loop_margins.PUMP_LAG_S, leak)
        return plant, "plant as the configuration assumes it (no session has identified it)"


@dataclass(frozen=True, slots=True)
class Sliders:
    """What a person sets."""

    closed_loop_s: float  # time constant wanted of the closed loop
    damping: float  # integral time over (closed-loop time constant + delay)
    filter_s: float

    def gains(self, model: plant_model.PlantModel, dt_s: float) -> closed_loop.Gains:
        """PI gains, K = 1 / (k (tc + d)), Ti = c (tc + d): SIMC for c = 4 (Skogestad 2003)."""
        slowed_s = self.closed_loop_s + tuning_rules.compute_effective_delay_s(
            model, dt_s, self.filter_s
        )
        return closed_loop.Gains(
            1 / (model.gain * slowed_s), self.damping * slowed_s, 0.0, self.filter_s
        )

    @classmethod
    def near(
        cls, gains: closed_loop.Gains, model: plant_model.PlantModel, dt_s: float
    ) -> "Sliders":
        """The setting of the sliders that gives these gains, as far as they reach."""
        slowed_s = 1 / (model.gain * max(gains.kp_per_s, 1e-9))
        delay_s = tuning_rules.compute_effective_delay_s(model, dt_s, gains.filter_s)
        within = min(max(slowed_s - delay_s, DELAYS[0] * delay_s), DELAYS[1] * delay_s)
        damping = gains.ti_s / (within + delay_s)
        return cls(within, min(max(damping, DAMPINGS[0]), DAMPINGS[1]), gains.filter_s)


@dataclass(frozen=True, slots=True)
class Curves:
    """Responses of one set of gains; a loop that is unstable has none over time."""

    figures: candidate.Candidate
    time_s: arrays.FloatArray  # (n,)
    step_um: arrays.FloatArray  # (n,): the centre after a setpoint step of `STEP_UM`
    load_um: arrays.FloatArray  # (n,): the centre after a step of the leak
    w_rad_per_s: arrays.FloatArray  # (m,)
    open_loop: arrays.ComplexArray  # (m,): L
    # (m,): two-sided spectrum of the true centre in the recorded weather
    centre_um2_s: arrays.FloatArray


def curves(name: str, gains: closed_loop.Gains, of: Workpiece, duration_s: float) -> Curves:
    """Everything the page draws of a set of gains."""
    dt_s = of.weather.rest.dt_s
    demands = gain_search.Demands()
    figures = candidate.evaluate_candidate(name, gains, of.model, of.weather, of.loop, demands)
    w = closed_loop.make_frequencies(dt_s)
    response = closed_loop.compute_loop_response(gains, of.model, w, dt_s)
    sensitivity = 1 / (1 + response)
    moving, noise = of.weather.psd(w, of.model, of.loop), of.weather.rest.white_psd
    centre = np.abs(sensitivity) ** 2 * moving + np.abs(1 - sensitivity) ** 2 * noise
    time_s = step_um = load_um = np.empty(0)
    if figures.margins.stable:
        time_s, step_um = responded(gains, of, duration_s, STEP_UM, 0.0)
        _, load_um = responded(gains, of, duration_s, 0.0, demands.load_step_um_per_s)
    return Curves(figures, time_s, step_um, load_um, w, response, centre)


def shown_s(gains: closed_loop.Gains, model: plant_model.PlantModel) -> float:
    """How long the responses of the gains are worth a look."""
    return _SETTLINGS * (model.delay_s + gains.filter_s + 0.2 * gains.ti_s)


def responded(
    gains: closed_loop.Gains,
    of: Workpiece,
    duration_s: float,
    setpoint_um: float,
    load_um_per_s: float,
) -> tuple[arrays.FloatArray, arrays.FloatArray]:
    """Centre of the mirror, linear and without noise, after steps of setpoint and leak at time 0.

    Returns
    -------
    time_s, centre_um : (n,)
        At each tick; the delayed flow changes once within a tick, which is taken into account.
    """
    loop, model = of.loop, of.model
    dt_s = max(of.weather.rest.dt_s, duration_s / _POINTS_MAX)
    shaped = _Setpoint(loop, gains.ti_s, dt_s)
    smooth = -math.expm1(-dt_s / gains.filter_s) if gains.filter_s > 0 else 1.0
    count = max(2, round(duration_s / dt_s))
    whole = int(model.dead_time_s // dt_s)
    # share of a tick that the newer of two flows lasts
    early = 1.0 - (model.dead_time_s / dt_s - whole)
    follow = -math.expm1(-dt_s / model.lag_s) if model.lag_s > 0 else 1.0
    flows = [0.0] * (whole + 2)
    centre = filtered = matched = integral = speed = 0.0
    out = np.empty(count)
    for tick in range(count):
        out[tick] = centre
        before, filtered = filtered, filtered + smooth * (centre - filtered)
        matched += smooth * (shaped.at(setpoint_um) - matched)
        error = matched - filtered
        flow = gains.kp_per_s * (error - gains.td_s * (filtered - before) / dt_s) + integral
        integral += gains.kp_per_s / gains.ti_s * error * dt_s
        flows = [flow, *flows[:-1]]
        arriving = model.gain * (early * flows[whole] + (1.0 - early) * flows[whole + 1])
        old, speed = speed, speed + follow * (arriving - speed)
        centre += ((old + speed) / 2 - load_um_per_s) * dt_s
    return np.arange(count, dtype=float) * dt_s, out


class _Setpoint:
    """The setpoint behind its weight b: (1 + b Ti s) / (1 + Ti s), as the hold shapes it."""

    def __init__(self, loop: LoopConfig, ti_s: float, dt_s: float) -> None:
        self._weight = loop.setpoint_weight
        self._slow = 0.0
        self._share = -math.expm1(-dt_s / ti_s)

    def at(self, setpoint_um: float) -> float:
        self._slow += self._share * (setpoint_um - self._slow)
        return self._slow + self._weight * (setpoint_um - self._slow)
