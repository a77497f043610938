"""The report of a session: one HTML file with everything in it, and a Rerun recording; renewed after each step."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Sequence
from pathlib import Path

from membrane_ctrl.recording.atomic import users, write_text_atomic
from tuning import pictures, session
from tuning.gains_file import load_gains
from tuning.records_file import load_record
from tuning.session_folder import STEPS, SessionFolder
from tuning.session_recording import write_recording

_STYLE = (
    "body{font-family:sans-serif;max-width:70em;margin:2em auto;padding:0 1em}table{border-collapse:collapse}"
    "td,th{border:1px solid #bbb;padding:.2em .5em;font-size:85%;text-align:right}td:first-child{text-align:left}"
    "img{max-width:100%}.refused{color:#a00}.ok{color:#060}"
)


def write_report(folder: SessionFolder) -> Path:
    """Draw what there is and put it together; returns `report.html`."""
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
    text = f"<!doctype html><meta charset=utf-8><title>{html.escape(head.name)}</title><style>{_STYLE}</style>"
    write_text_atomic(users(path), text + "\n".join(parts))
    write_recording(folder)
    return path


def draw(folder: SessionFolder) -> None:
    """Renew the pictures of all steps that are done."""
    if folder.done("characterise"):
        found = session.found_of(folder).identified if folder.done("identify") else None
        pictures.draw_experiments(folder.file("experiments.png"), session.experiments_of(folder).record, found)
    if not folder.done("observe"):
        return
    model = session.found_of(folder).identified.model
    quiet = load_record(folder.file("quiet.npz"))
    pictures.draw_weather(folder.file("weather.png"), quiet, model, session.disturbance_of(folder))
    if folder.done("design"):
        pictures.draw_candidates(folder.file("candidates.png"), session.design_of(folder), model, quiet.dt_s)
    if folder.done("verify"):
        path = folder.file("verify.npz")
        after = load_record(path) if path.exists() else None
        pictures.draw_verification(folder.file("verify.png"), quiet, after, model, session.verified_of(folder))


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
        ("leak (um/s)", f"{model.leak_um_per_s:.2f}", f"{sigma.leak_um_per_s:.2f}"),
    ]
    parts.append(_table(("", "value", "1 sigma"), rows))
    parts.append(
        f"<p>Residuals: whiteness p = {found.identified.whiteness_p:.3g}, independence of the flow p = "
        f"{found.identified.independence_p:.3g}, largest {found.identified.largest_residual:.1f} sigma. "
        f"Data {found.data_sha256[:16]}.</p>"
    )
    return parts


def _designed(folder: SessionFolder) -> list[str]:
    if not folder.done("observe"):
        return []
    weather = session.disturbance_of(folder)
    parts = [
        f"<h2>Weather</h2><p>Laser noise {weather.laser_um:.3f} um a reading.</p>",
        _image(folder, "weather.png"),
    ]
    if not folder.done("design"):
        return parts
    design, gains = session.design_of(folder), load_gains(folder.file("gains.toml"))
    lines = folder.candidates().splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    parts += [
        "<h2>Candidates</h2>",
        _table(cells[0], cells[2:]),
        _image(folder, "candidates.png"),
        f"<p>Proposed: K {gains.loop.kp_per_s:.3f} 1/s, Ti {gains.loop.ti_s:.2f} s, filter "
        f"{gains.loop.measurement_filter_s:.2f} s; {gains.predicted_std_um:.3f} um predicted, the least possible is "
        f"{gains.least_std_um:.3f} um. Over plants drawn from the fit: Ms {design.robustness.ms_p95:.2f}, std "
        f"{design.robustness.std_p95_um:.3f} um at 95 %, {design.robustness.stable_fraction:.0%} stable.</p>",
    ]
    if folder.done("preview"):
        shown = session.preview_of(folder)
        rows = [
            (name, f"{p.std_um:.3f}", f"{p.bias_um:+.3f}", f"{p.load_peak_um:.2f}", f"{p.recovery_s:.1f}")
            for name, group in (("present", shown.present), ("proposed", shown.proposed))
            for p in group
        ]
        parts += ["<h2>Preview on the fitted twin</h2>", _table(("", "std", "bias", "load peak", "recovery s"), rows)]
    return parts


def _verified(folder: SessionFolder) -> list[str]:
    if not folder.done("verify"):
        return []
    done = session.verified_of(folder)
    words = "kept" if done.kept else f"taken back: {done.reason}"
    rows = [
        (f"{s.time_s:.0f} s", f"{s.std_um:.3f}", f"{s.before_um:.3f}", f"{s.growth:.2f}", _seen(s.ms), s.reason)
        for s in done.stages
    ]
    heads = ("after", "std um", "gains before um", "ratio", "sensitivity seen", "")
    return [
        f"<h2>Verification</h2><p class={'ok' if done.kept else 'refused'}>{html.escape(words)}</p>",
        _table(heads, rows),
        _image(folder, "verify.png"),
    ]


def _seen(ms: float) -> str:
    return f"{ms:.2f}" if math.isfinite(ms) else "too short to say"


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    head = "".join(f"<th>{html.escape(cell)}</th>" for cell in heads)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><tr>{head}</tr>{body}</table>"


def _image(folder: SessionFolder, name: str) -> str:
    path = folder.file(name)
    if not path.exists():
        return ""
    data = base64.b64encode(folder.content(name)).decode()
    return f'<img alt="{path.stem}" src="data:image/png;base64,{data}">'
