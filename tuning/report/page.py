"""The report of a session: one self-contained HTML file, updated after each step."""

import html
from pathlib import Path

from membrane_ctrl.model.files import resolve_user_path, write_text_atomic
from membrane_ctrl.sessions.folder import STEPS, SessionFolder
from tuning.report.recording import write_recording
from tuning.steps import design, identify, observe, preview, verify

_STYLE = (
    "body{font-family:sans-serif;max-width:70em;margin:2em auto;padding:0 "
    "1em}table{border-collapse:collapse}"
    "td,th{border:1px solid #bbb;padding:.2em "
    ".5em;font-size:85%;text-align:right}td:first-child{text-align:left}"
    "img{max-width:100%}.refused{color:#a00}.ok{color:#060}"
)


def write_report(folder: SessionFolder) -> Path:
    """Draw the finished steps, write `report.html` and return its path."""
    draw_pictures(folder)
    head = folder.head
    done = [step for step in STEPS if folder.is_done(step)]
    parts = [
        f"<h1>Tuning session {html.escape(head.name)}</h1>",
        f"<p>{html.escape(head.author)}, {head.created_utc}, on {html.escape(head.source)}; "
        f"done: {', '.join(done) or 'nothing yet'}</p>",
        *identify.make_report_part(folder),
        *observe.make_report_part(folder),
        *design.make_report_part(folder),
        *preview.make_report_part(folder),
        *verify.make_report_part(folder),
    ]
    path = folder.file_path("report.html")
    text = (
        "<!doctype html><meta charset=utf-8>"
        f"<title>{html.escape(head.name)}</title><style>{_STYLE}</style>"
    )
    write_text_atomic(resolve_user_path(path), text + "\n".join(parts))
    write_recording(folder)
    return path


def draw_pictures(folder: SessionFolder) -> None:
    """Draw the pictures of the finished steps that are missing or older than what they show."""
    for step in (identify, observe, design, verify):
        step.draw_picture(folder)
