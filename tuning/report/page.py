"""The report of a session: one self-contained HTML file, updated after each step."""

from pathlib import Path

from membrane_ctrl.model.files import resolve_user_path, write_text_atomic
from membrane_ctrl.report_pages.blocks import PageSection, PageText, ReportPage
from membrane_ctrl.report_pages.render import render_page
from membrane_ctrl.sessions.folder import STEPS, SessionFolder
from tuning.report.recording import write_recording
from tuning.steps import design, identify, observe, preview, verify


def write_report(folder: SessionFolder) -> Path:
    """Draw the finished steps, write `report.html` and return its path."""
    draw_pictures(folder)
    head = folder.head
    done = [step for step in STEPS if folder.is_done(step)]
    origin = f"{head.author}, {head.created_utc}, on {head.source}"
    sections = [PageSection("", [PageText(f"{origin}; done: {', '.join(done) or 'nothing yet'}")])]
    for step in (identify, observe, design, preview, verify):
        section = step.make_report_part(folder)
        if section is not None:
            sections.append(section)
    page = ReportPage(head.name, sections, heading=f"Tuning session {head.name}")
    path = folder.file_path("report.html")
    write_text_atomic(resolve_user_path(path), render_page(page))
    write_recording(folder)
    return path


def draw_pictures(folder: SessionFolder) -> None:
    """Draw the pictures of the finished steps that are missing or older than what they show."""
    for step in (identify, observe, design, verify):
        step.draw_picture(folder)
