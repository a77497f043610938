"""Pictures of a session: the experiments and their fit, the weather, the candidates, and before against after."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.signal import welch

from membrane_ctrl.config import LoopConfig
from tuning.disturbance_model import Disturbance
from tuning.identify import Identified
from tuning.loop_model import Gains, frequencies, loop_response
from tuning.plant_model import PlantModel, driven_um
from tuning.records import Record, Series
from tuning.session import Design, Verified

_DPI = 100
_SEGMENT_S = 40.0


def draw_experiments(path: Path, record: Record, found: Identified | None) -> None:
    """Flow, reading, and (once fitted) what the model makes of the flow, with the residuals."""
    figure = Figure(figsize=(11, 7), layout="constrained")
    upper, middle, lower = figure.subplots(3, 1, sharex=True)
    time_s = np.arange(len(record)) * record.dt_s
    upper.step(time_s, record.flow_um_per_s, where="post", linewidth=0.8)
    upper.set(ylabel="flow (um/s)")
    middle.plot(time_s, record.displacement_um, ".", markersize=1, color="tab:gray", label="reading")
    if found is not None:
        model = found.model
        x = driven_um(record.flow_um_per_s, model.dead_time_s, model.lag_s, record.dt_s)
        way = model.gain * x - model.leak_um_per_s * time_s
        off = record.filled_displacement_um() - way
        middle.plot(time_s, way + off.mean(), linewidth=1, label="the pump's share, by the model")
        lower.plot(time_s[1:], found.residual_um, linewidth=0.4)
    middle.set(ylabel="centre (um)")
    middle.legend(loc="upper right")
    lower.set(ylabel="prediction error (um)", xlabel="time (s)")
    _save(path, figure)


def draw_weather(path: Path, record: Record, model: PlantModel, weather: Disturbance) -> None:
    """Spectrum of a quiet hold's readings without the pump's share, and the fitted parts."""
    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.subplots()
    x = driven_um(record.flow_um_per_s, model.dead_time_s, model.lag_s, record.dt_s)
    rest = record.filled_displacement_um() - model.gain * x
    frequency_hz, power = welch(np.diff(rest), 1 / record.dt_s, nperseg=round(_SEGMENT_S / record.dt_s))
    w: Series = 2 * np.pi * frequency_hz[1:]
    back = 1 / np.abs(1 - np.exp(-1j * w * record.dt_s)) ** 2  # from increments to readings
    axes.loglog(frequency_hz[1:], power[1:] * back, linewidth=0.7, color="tab:gray", label="readings, pump taken out")
    blind = LoopConfig(feedforward_barometer=False, feedforward_temperature=False)
    axes.loglog(frequency_hz[1:], 2 * weather.psd(w, model, blind), label="movement, fitted")  # one-sided
    axes.loglog(frequency_hz[1:], 2 * weather.rest.moving_psd(w), label="movement that no weather sensor explains")
    axes.axhline(2 * weather.rest.white_psd, color="tab:red", linestyle="--", label="laser noise")
    axes.set(xlabel="frequency (Hz)", ylabel="um^2/Hz", ylim=(1e-4 * weather.rest.white_psd, None))
    axes.legend()
    _save(path, figure)


def draw_candidates(path: Path, design: Design, model: PlantModel, dt_s: float) -> None:
    """All candidates: predicted standard deviation, sensitivity peak, load peak, pump activity, and |S|."""
    rows = [row for row in design.candidates if row.predicted is not None]
    names = [row.name for row in rows]
    stds = [row.predicted.std_um for row in rows if row.predicted is not None]
    flows = [row.predicted.flow_std_um_per_s for row in rows if row.predicted is not None]
    figure = Figure(figsize=(12, 8), layout="constrained")
    (a, b, c), (d, e, f) = figure.subplots(2, 3)
    f.remove()
    places = np.arange(len(names))
    for axes, values, title, limit in (
        (a, stds, "predicted std (um)", design.least_std_um),
        (b, [row.margins.ms for row in rows], "Ms", 1.4),
        (c, [row.load_peak_um for row in rows], "load peak (um)", math.nan),
        (d, np.minimum(flows, 3.0), "flow std (um/s, cut at 3)", math.nan),
    ):
        colours = ["tab:green"] + ["tab:blue"] * (len(names) - 1)
        axes.barh(places, values, color=colours)
        axes.set_yticks(places, names, fontsize=7)
        axes.invert_yaxis()
        axes.set_title(title, fontsize=9)
        if math.isfinite(limit):
            axes.axvline(limit, color="tab:red", linestyle="--")
    w = frequencies(dt_s)
    for row in rows:
        size = np.abs(1 / (1 + loop_response(row.gains, model, w, dt_s)))
        e.semilogx(w, size, linewidth=2 if row is rows[0] else 0.8, label=row.name)
    e.set(xlim=(0.05, w[-1]), xlabel="rad/s", title="|S|")
    e.legend(fontsize=6)
    _save(path, figure)


def draw_verification(path: Path, before: Record, after: Record | None, model: PlantModel, done: Verified) -> None:
    """Spectra of the readings before and after, and how the trial grew or shrank stage by stage."""
    figure = Figure(figsize=(11, 4.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    dt_s = before.dt_s
    for record, loop, name in ((before, done.before, "before"), (after, done.after, "after")):
        if record is None:
            continue
        readings = record.filled_displacement_um()
        f, power = welch(readings - readings.mean(), 1 / dt_s, nperseg=min(readings.size, round(_SEGMENT_S / dt_s)))
        ms = float(np.max(np.abs(1 / (1 + loop_response(Gains.of(loop), model, frequencies(dt_s), dt_s)))))
        left.loglog(f[1:], power[1:], linewidth=0.8, label=f"{name}, Ms {ms:.2f}")
    left.set(xlabel="frequency (Hz)", ylabel="readings (um^2/Hz)")
    left.legend()
    times = [stage.time_s for stage in done.stages]
    right.plot(times, [stage.growth for stage in done.stages], "o-", label="std over that of the gains before")
    right.plot(times, [stage.growth_max for stage in done.stages], "r--", label="most that passes")
    right.set(xlabel="time (s)", title="kept" if done.kept else f"taken back: {done.reason}"[:90])
    right.title.set_fontsize(8)
    right.legend()
    _save(path, figure)


def _save(path: Path, figure: Figure) -> None:
    FigureCanvasAgg(figure).print_figure(str(path), dpi=_DPI)
