"""The report of a session: one self-contained HTML file and a Rerun recording, updated after each
step.
"""

import base64
import html
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from matplotlib.figure import Figure
from scipy.signal import welch

from membrane_ctrl.config.schema import LoopConfig
from membrane_ctrl.measure.results import write_figure
from membrane_ctrl.model.arrays import AnyArray
from membrane_ctrl.model.files import move, users, write_text_atomic
from membrane_ctrl.sessions.folder import FILES, STEPS, SessionFolder
from tuning import gains_file, session
from tuning.identification import disturbance, identify, loop_model
from tuning.identification.loop_model import Record, Series
from tuning.session import Design, Verified

_DPI = 100
_SEGMENT_S = 40.0
_TIMELINE = "session_time"


def draw_experiments(path: Path, record: Record, found: identify.Identified | None) -> None:
    """Draw flow and readings and, once fitted, the model's response
    to the flow with the residuals.
    """
    figure = Figure(figsize=(11, 7), layout="constrained")
    upper, middle, lower = figure.subplots(3, 1, sharex=True)
    time_s = np.arange(len(record)) * record.dt_s
    upper.step(time_s, record.flow_um_per_s, where="post", linewidth=0.8)
    upper.set(ylabel="flow (µm/s)")
    middle.plot(
        time_s, record.displacement_um, ".", markersize=1, color="tab:gray", label="reading"
    )
    if found is not None:
        middle.plot(
            time_s,
            loop_model.pump_share_um(record, found.model),
            linewidth=1,
            label="response to the pump (model)",
        )
        lower.plot(time_s[1:], found.residual_um, linewidth=0.4)
    middle.set(ylabel="centre (µm)")
    middle.legend(loc="upper right")
    lower.set(ylabel="prediction error (µm)", xlabel="time (s)")
    write_figure(users(path), figure, _DPI)


def draw_weather(
    path: Path, record: Record, model: loop_model.PlantModel, weather: disturbance.DisturbanceModel
) -> None:
    """Draw the spectrum of a quiet hold's readings less the pump's response,
    and the fitted parts.
    """
    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.subplots()
    x = loop_model.driven_um(record.flow_um_per_s, model.dead_time_s, model.lag_s, record.dt_s)
    rest = record.filled_displacement_um() - model.gain * x
    frequency_hz, power = welch(
        np.diff(rest), 1 / record.dt_s, nperseg=round(_SEGMENT_S / record.dt_s)
    )
    w: Series = 2 * np.pi * frequency_hz[1:]
    back = 1 / np.abs(1 - np.exp(-1j * w * record.dt_s)) ** 2  # from increments to readings
    axes.loglog(
        frequency_hz[1:],
        power[1:] * back,
        linewidth=0.7,
        color="tab:gray",
        label="readings less pump",
    )
    blind = LoopConfig(feedforward_barometer=False, feedforward_temperature=False)
    axes.loglog(
        frequency_hz[1:], 2 * weather.psd(w, model, blind), label="fitted motion"
    )  # one-sided
    axes.loglog(
        frequency_hz[1:],
        2 * weather.rest.moving_psd(w),
        label="motion not explained by weather sensors",
    )
    axes.axhline(
        2 * weather.rest.white_psd, color="tab:red", linestyle="--", label="noise of a reading"
    )
    axes.set(xlabel="frequency (Hz)", ylabel="um^2/Hz", ylim=(1e-4 * weather.rest.white_psd, None))
    axes.legend(loc="best")
    write_figure(users(path), figure, _DPI)


def draw_candidates(path: Path, design: Design, model: loop_model.PlantModel, dt_s: float) -> None:
    """Draw all candidates: predicted standard deviation, Ms, load peak, recovery, pump activity,
    |S|.
    """
    sound = [(row, row.predicted) for row in design.candidates if row.predicted is not None]
    rows, names = [row for row, _ in sound], [row.name for row, _ in sound]
    stds, flows = ([getattr(p, name) for _, p in sound] for name in ("std_um", "flow_std_um_per_s"))
    figure = Figure(figsize=(12, 8), layout="constrained")
    (a, b, c), (d, e, f) = figure.subplots(2, 3)
    places = np.arange(len(names))
    for axes, values, title, limit in (
        (a, stds, "predicted std (µm)", design.least_std_um),
        (b, [row.margins.ms for row in rows], "Ms", 1.4),
        (c, [row.load_peak_um for row in rows], "load peak (µm)", math.nan),
        (
            d,
            np.minimum([row.load_recovery_s for row in rows], 60.0),
            "recovery (s, cut at 60)",
            math.nan,
        ),
        (e, np.minimum(flows, 3.0), "flow std (µm/s, cut at 3)", math.nan),
    ):
        axes.barh(places, values, color=["tab:green"] + ["tab:blue"] * (len(names) - 1))
        axes.set_yticks(places, names, fontsize=7)
        axes.invert_yaxis()
        axes.set_title(title, fontsize=9)
        if math.isfinite(limit):
            axes.axvline(limit, color="tab:red", linestyle="--")
    w = loop_model.frequencies(dt_s)
    for row in rows:
        size = np.abs(1 / (1 + loop_model.loop_response(row.gains, model, w, dt_s)))
        f.semilogx(w, size, linewidth=2 if row is rows[0] else 0.8, label=row.name)
    f.set(xlim=(0.05, w[-1]), xlabel="rad/s", title="|S|")
    f.legend(loc="best", fontsize=6)
    write_figure(users(path), figure, _DPI)


def draw_verification(
    path: Path, before: Record, after: Record | None, model: loop_model.PlantModel, done: Verified
) -> None:
    """Draw the readings' spectra before and after, and the ratio of
    standard deviations per stage.
    """
    figure = Figure(figsize=(11, 4.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    dt_s = before.dt_s
    for record, loop, name in ((before, done.before, "before"), (after, done.after, "after")):
        if record is None:
            continue
        readings = record.filled_displacement_um()
        f, power = welch(
            readings - readings.mean(),
            1 / dt_s,
            nperseg=min(readings.size, round(_SEGMENT_S / dt_s)),
        )
        response = loop_model.loop_response(
            loop_model.Gains.of(loop), model, loop_model.frequencies(dt_s), dt_s
        )
        ms = float(np.max(np.abs(1 / (1 + response))))
        left.loglog(f[1:], power[1:], linewidth=0.8, label=f"{name}, Ms {ms:.2f}")
    left.set(xlabel="frequency (Hz)", ylabel="readings (µm^2/Hz)")
    left.legend(loc="best")
    times = [stage.time_s for stage in done.stages]
    right.plot(
        times,
        [stage.growth for stage in done.stages],
        "o-",
        label="std relative to the previous gains",
    )
    right.plot(times, [stage.growth_max for stage in done.stages], "r--", label="limit")
    right.set(xlabel="time (s)", title="kept" if done.kept else f"reverted: {done.reason}"[:90])
    right.title.set_fontsize(8)
    right.legend(loc="best")
    write_figure(users(path), figure, _DPI)


_STYLE = (
    "body{font-family:sans-serif;max-width:70em;margin:2em auto;padding:0 "
    "1em}table{border-collapse:collapse}"
    "td,th{border:1px solid #bbb;padding:.2em "
    ".5em;font-size:85%;text-align:right}td:first-child{text-align:left}"
    "img{max-width:100%}.refused{color:#a00}.ok{color:#060}"
)


def write_report(folder: SessionFolder) -> Path:
    """Draw the finished steps, write `report.html` and return its path."""
    draw(folder)
    head = folder.head
    done = [step for step in STEPS if folder.done(step)]
    parts = [
        f"<h1>Tuning session {html.escape(head.name)}</h1>",
        f"<p>{html.escape(head.author)}, {head.created_utc}, on {html.escape(head.source)}; "
        f"done: {', '.join(done) or 'nothing yet'}</p>",
        *_identified(folder),
        *_designed(folder),
        *_verified(folder),
    ]
    path = folder.file("report.html")
    text = (
        "<!doctype html><meta "
        f"charset=utf-8><title>{html.escape(head.name)}</title><style>{_STYLE}</style>"
    )
    write_text_atomic(users(path), text + "\n".join(parts))
    write_recording(folder)
    return path


def draw(folder: SessionFolder) -> None:
    """Draw the pictures of the finished steps that are missing or older than what they show."""
    if folder.done("characterise") and _outdated(
        folder, "experiments.png", "characterise", "identify"
    ):
        found = session.found_of(folder).identified if folder.done("identify") else None
        draw_experiments(
            folder.file("experiments.png"), session.experiments_of(folder).record, found
        )
    if not folder.done("observe"):
        return
    model = session.found_of(folder).identified.model
    quiet = loop_model.load_record(folder.file("quiet.npz"))
    if _outdated(folder, "weather.png", "identify", "observe"):
        draw_weather(folder.file("weather.png"), quiet, model, session.disturbance_of(folder))
    if folder.done("design") and _outdated(
        folder, "candidates.png", "identify", "observe", "design"
    ):
        draw_candidates(folder.file("candidates.png"), session.design_of(folder), model, quiet.dt_s)
    if folder.done("verify") and _outdated(folder, "verify.png", "identify", "observe", "verify"):
        path = folder.file("verify.npz")
        after = loop_model.load_record(path) if path.exists() else None
        draw_verification(
            folder.file("verify.png"), quiet, after, model, session.verified_of(folder)
        )


def _outdated(folder: SessionFolder, picture: str, *steps: str) -> bool:
    """Whether the picture is no file, or older than a result of one of the steps."""
    path = folder.file(picture)
    if path.is_symlink() or not path.is_file():
        return True
    results = [folder.file(name) for step in steps for name in FILES[step]]
    return (
        max(each.stat().st_mtime_ns for each in results if each.exists()) >= path.stat().st_mtime_ns
    )


def _identified(folder: SessionFolder) -> list[str]:
    parts = ["<h2>Experiments and fit</h2>", _image(folder, "experiments.png")]
    if not folder.done("identify"):
        return parts
    found = session.found_of(folder)
    model, sigma = found.identified.model, found.identified.sigma
    colour = "refused" if found.quality.verdict == "refused" else "ok"
    reasons = "; ".join(found.quality.reasons)
    parts.append(f"<p class={colour}>Data: {found.quality.verdict}. {html.escape(reasons)}</p>")
    rows = [
        ("gain k", f"{model.gain:.3f}", f"{sigma.gain:.3f}"),
        ("dead time (s)", f"{model.dead_time_s:.3f}", f"{sigma.dead_time_s:.3f}"),
        ("lag (s)", f"{model.lag_s:.3f}", f"{sigma.lag_s:.3f}"),
        ("delay, both (s)", f"{model.delay_s:.3f}", f"{sigma.delay_s:.3f}"),
        ("leak (µm/s)", f"{model.leak_um_per_s:.2f}", f"{sigma.leak_um_per_s:.2f}"),
    ]
    parts.append(_table(("", "value", "1 sigma"), rows))
    parts.append(
        f"<p>Residuals: whiteness p = {found.identified.whiteness_p:.3g}, independence of "
        "the flow p = "
        f"{found.identified.independence_p:.3g}, largest "
        f"{found.identified.largest_residual:.1f} sigma. "
        f"Data {found.data_sha256[:16]}.</p>"
    )
    return parts


def _designed(folder: SessionFolder) -> list[str]:
    if not folder.done("observe"):
        return []
    weather = session.disturbance_of(folder)
    parts = [
        f"<h2>Weather</h2><p>Noise of a reading {weather.laser_um:.3f} µm. Every predicted "
        "std rests on this "
        f"record: ten other minutes of weather like it change it by {weather.unsteady:.0%} "
        "(1 sigma), and its "
        "fit has an error.</p>",
        _image(folder, "weather.png"),
    ]
    if not folder.done("design"):
        return parts
    design, gains = session.design_of(folder), gains_file.load_gains(folder.file("gains.toml"))
    traded, by = session.traded(folder), "chosen" if gains.candidate else "proposed"
    lines = folder.candidates().splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    parts += [
        "<h2>Candidates</h2>",
        _table(cells[0], cells[2:]),
        _image(folder, "candidates.png"),
        f"<p>{html.escape(traded.candidate)} is {by}: K {gains.loop.kp_per_s:.3f} 1/s, Ti "
        f"{gains.loop.ti_s:.2f} s, "
        f"filter {gains.loop.measurement_filter_s:.2f} s. Present and new gains: "
        f"{html.escape(str(traded))}. Lower "
        f"bound of the std: {gains.least_std_um:.3f} µm. The proposal over plants drawn from "
        "the fit: Ms "
        f"{design.robustness.ms_p95:.2f}, std {design.robustness.std_p95_um:.3f} µm at 95 %, "
        f"{design.robustness.stable_fraction:.0%} stable.</p>",
    ]
    if folder.done("preview"):
        shown = session.preview_of(folder)
        rows = [
            (
                name,
                f"{p.std_um:.3f}",
                f"{p.bias_um:+.3f}",
                f"{p.load_peak_um:.2f}",
                f"{p.recovery_s:.1f}",
            )
            for name, group in (("present", shown.present), ("proposed", shown.proposed))
            for p in group
        ]
        parts += [
            "<h2>Preview on the fitted twin</h2>",
            _table(("", "std", "bias", "load peak", "recovery s"), rows),
        ]
    return parts


def _verified(folder: SessionFolder) -> list[str]:
    if not folder.done("verify"):
        return []
    done = session.verified_of(folder)
    words = "kept" if done.kept else f"reverted: {done.reason}"
    seen = [f"{s.ms:.2f}" if math.isfinite(s.ms) else "record too short" for s in done.stages]
    rows = [
        (
            f"{s.time_s:.0f} s",
            f"{s.std_um:.3f}",
            f"{s.before_um:.3f}",
            f"{s.growth:.2f}",
            ms,
            s.reason,
        )
        for s, ms in zip(done.stages, seen, strict=True)
    ]
    heads = ("after", "std µm", "previous µm", "ratio", "observed sensitivity", "")
    return [
        "<h2>Verification</h2><p "
        f"class={'ok' if done.kept else 'refused'}>{html.escape(words)}</p>",
        _table(heads, rows),
        _image(folder, "verify.png"),
    ]


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    head = "".join(f"<th>{html.escape(cell)}</th>" for cell in heads)
    body = "".join(
        "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows
    )
    return f"<table><tr>{head}</tr>{body}</table>"


def _image(folder: SessionFolder, name: str) -> str:
    path = folder.file(name)
    if not path.exists():
        return ""
    data = base64.b64encode(folder.content(name)).decode()
    return f'<img alt="{path.stem}" src="data:image/png;base64,{data}">'


def write_recording(folder: SessionFolder) -> None:
    """Write `session.rrd` with the steps done so far."""
    stream = rr.RecordingStream("membrane_ctrl_tune", recording_id=folder.path.name)
    path = users(folder.file("session.rrd"))
    part = path.with_name(f".{path.name}.part")
    part.unlink(missing_ok=True)
    stream.save(part, default_blueprint=_blueprint())
    if folder.done("characterise"):
        _experiments(stream, folder)
    if folder.done("observe"):
        _record(stream, "before", loop_model.load_record(folder.file("quiet.npz")))
    if folder.done("design"):
        markdown = folder.candidates()
        stream.log(
            "candidates/table", rr.TextDocument(markdown, media_type="text/markdown"), static=True
        )
        rows = [row for row in session.design_of(folder).candidates if row.predicted is not None]
        stds = [row.predicted.std_um for row in rows if row.predicted is not None]
        stream.log("candidates/std_um", rr.BarChart(stds), static=True)
        stream.log("candidates/ms", rr.BarChart([row.margins.ms for row in rows]), static=True)
    if folder.file("verify.npz").exists():
        _record(stream, "after", loop_model.load_record(folder.file("verify.npz")))
    stream.flush()
    stream.disconnect()
    move(part, path)


def _experiments(stream: rr.RecordingStream, folder: SessionFolder) -> None:
    record = session.experiments_of(folder).record
    _record(stream, "experiment", record)
    if not folder.done("identify"):
        return
    found = session.found_of(folder).identified
    time_s = np.arange(len(record)) * record.dt_s
    _series(stream, "fit/pump_share_um", time_s, loop_model.pump_share_um(record, found.model))
    _series(stream, "residual/prediction_error_um", time_s[1:], found.residual_um)


def _record(stream: rr.RecordingStream, name: str, record: Record) -> None:
    time_s = np.arange(len(record)) * record.dt_s
    _series(stream, f"{name}/flow_um_per_s", time_s, record.flow_um_per_s)
    _series(stream, f"{name}/displacement_um", time_s, record.displacement_um)
    if record.has_barometer:
        _series(stream, f"{name}/ambient_pressure_pa", time_s, record.ambient_pressure_pa)


def _series(stream: rr.RecordingStream, path: str, time_s: AnyArray, values: AnyArray) -> None:
    good = np.isfinite(values)
    index = rr.TimeColumn(_TIMELINE, duration=time_s[good])
    stream.send_columns(path, indexes=[index], columns=rr.Scalars.columns(scalars=values[good]))


def _blueprint() -> rrb.Blueprint:
    def plot(name: str, *paths: str) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(name=name, origin="/", contents=[f"+ /{path}" for path in paths])

    experiment = rrb.Vertical(
        plot("Flow, µm/s", "experiment/flow_um_per_s"),
        plot(
            "Centre and its response to the pump, µm",
            "experiment/displacement_um",
            "fit/pump_share_um",
        ),
        plot("Residual, µm", "residual/prediction_error_um"),
        name="Experiment and fit",
    )
    candidates = rrb.Vertical(
        rrb.TextDocumentView(name="Candidates", origin="/candidates/table"),
        rrb.Horizontal(
            rrb.BarChartView(name="Predicted std, µm", origin="/candidates/std_um"),
            rrb.BarChartView(name="Ms", origin="/candidates/ms"),
        ),
        name="Candidates",
    )
    compared = rrb.Vertical(
        plot("Centre before, µm", "before/displacement_um"),
        plot("Centre after, µm", "after/displacement_um"),
        plot("Flow before and after, µm/s", "before/flow_um_per_s", "after/flow_um_per_s"),
        name="Before and after",
    )
    panel = rrb.TimePanel(state="collapsed", timeline=_TIMELINE)
    return rrb.Blueprint(rrb.Tabs(experiment, candidates, compared), panel, auto_views=False)
