"""The report of a commissioning session: accepted or not, with reasons, as HTML and PDF."""

import hashlib
from collections.abc import Sequence
from pathlib import Path

from membrane_ctrl.commissioning.guide.mirror_design import derive_design
from membrane_ctrl.commissioning.guide.mirror_stages import explain_design, list_facts
from membrane_ctrl.commissioning.guide.session_state import (
    CONFIGURATION,
    HTML,
    PDF,
    CheckVerdict,
    SessionState,
    TomlTable,
)
from membrane_ctrl.commissioning.guide.stage import CommissioningStage
from membrane_ctrl.commissioning.guide.thresholds import ALL_THRESHOLDS
from membrane_ctrl.measure.report_pdf import pdf_pages
from membrane_ctrl.model import errors, files, program
from membrane_ctrl.report_pages.blocks import (
    PageFacts,
    PageLines,
    PageSection,
    PageTable,
    PageText,
    ReportPage,
    TextMark,
)
from membrane_ctrl.report_pages.render import render_page

STEP_TITLES = {
    1: "Mirror",
    2: "Devices",
    3: "Wiring, without gas",
    4: "First inflation",
    5: "Optics",
    6: "Acceptance",
}
_NOTHING_REAL = "This session ran on the emulated bench: it proves the procedure, not a mirror."


def find_reasons(
    stages: Sequence[CommissioningStage], state: SessionState, tables: TomlTable
) -> list[str]:
    """Why a bench is not accepted.

    Parameters
    ----------
    stages : sequence of CommissioningStage
        All stages, in their order.
    state : SessionState
        Its records of the finished stages.
    tables : TomlTable
        The configuration, which decides what stages are needed.

    Returns
    -------
    list of str
        One for each needed stage that is not done, each failed check, and each check that was left
        out; empty if the bench is accepted.
    """
    reasons = []
    for stage in stages:
        if not stage.is_needed(state, tables):
            continue
        record = state.find_record(stage.name)
        if record is None:
            reasons.append(f"{stage.name}: not done")
            continue
        reasons += [f"{stage.name}: {check.name}: {check.measured}" for check in record.failed]
        reasons += [
            f"{stage.name}: {check.name}: not done ({check.measured})"
            for check in record.checks
            if check.verdict == CheckVerdict.NOT_DONE
        ]
    return reasons


def write_report(
    folder: Path,
    stages: Sequence[CommissioningStage],
    state: SessionState,
    tables: TomlTable,
    signed_by: str,
) -> bool:
    """Write `report.html` and `report.pdf`; returns whether the bench is accepted.

    Raises DeviceError if they cannot be written.

    Parameters
    ----------
    folder : Path
        Of the session.
    stages : sequence of CommissioningStage
        All stages, in their order.
    state : SessionState
        What the session has recorded.
    tables : TomlTable
        The configuration.
    signed_by : str
        Name of the person.
    """
    reasons = find_reasons(stages, state, tables)
    page = _make_page(folder, stages, state, reasons, signed_by)
    path = folder / HTML
    with errors.convert_write_errors(path, errors.DeviceError):
        files.write_text_atomic(path, render_page(page))
        files.write_bytes_atomic(folder / PDF, _make_pdf(page))
    return not reasons


def _make_page(
    folder: Path,
    stages: Sequence[CommissioningStage],
    state: SessionState,
    reasons: list[str],
    signed_by: str,
) -> ReportPage:
    # The verdict with its reasons comes first,
    verdict = "Accepted." if not reasons else f"Not accepted: {len(reasons)} reasons."
    mark = TextMark.BAD if reasons else TextMark.GOOD
    first: list[PageText | PageLines | PageFacts] = [PageText(verdict, mark)]
    if state.simulated:
        first.append(PageText(_NOTHING_REAL, TextMark.LOOK))
    if reasons:
        first.append(PageLines(reasons))
    first.append(PageFacts(_list_facts(folder, state, signed_by)))
    sections = [PageSection("", first)]
    # then the mirror's data with what follows from them,
    if state.facts is not None:
        lines = explain_design(state.facts, derive_design(state.facts))
        sections.append(
            PageSection(
                "The mirror's data, and what follows",
                [PageFacts(list_facts(state.facts)), PageLines([line.strip() for line in lines])],
            )
        )
    # the checks of each step in the order of the procedure,
    for step, title in STEP_TITLES.items():
        rows = _list_rows(stages, state, step)
        if rows:
            head = ("check", "measured", "limit", "result", "to do")
            sections.append(PageSection(f"{step}. {title}", [PageTable(head, rows)]))
    # and the limits by which they were judged.
    limits = [(each.name, each.words, each.reason) for each in ALL_THRESHOLDS]
    sections.append(PageSection("Limits", [PageTable(("of", "limit", "why"), limits)]))
    return ReportPage("Commissioning report", sections, footer=program.program_identity())


def _list_facts(folder: Path, state: SessionState, signed_by: str) -> list[tuple[str, str]]:
    digest = hashlib.sha256((folder / CONFIGURATION).read_bytes()).hexdigest()
    finished = max((record.finished_utc for record in state.records), default="")
    return [
        ("begun", state.created_utc),
        ("last stage", finished),
        ("session of", state.author),
        ("signed by", signed_by or "nobody"),
        ("configuration", f"{CONFIGURATION}, SHA-256 {digest}"),
    ]


def _list_rows(
    stages: Sequence[CommissioningStage], state: SessionState, step: int
) -> list[tuple[str, str, str, str, str]]:
    rows = []
    for stage in stages:
        record = state.find_record(stage.name) if stage.step == step else None
        if record is not None:
            rows += [
                (check.name, check.measured, check.limit, check.verdict.value, check.remedy)
                for check in record.checks
            ]
    return rows


def _make_pdf(page: ReportPage) -> bytes:
    """The page's texts and tables as PDF."""
    lines: list[str] = []
    tables: dict[str, PageTable] = {}
    for section in page.sections:
        for block in section.blocks:
            if isinstance(block, PageText):
                lines.append(block.text)
            elif isinstance(block, PageLines):
                lines += block.lines
            elif isinstance(block, PageFacts):
                lines += [f"{name}: {value}" for name, value in block.facts]
            elif isinstance(block, PageTable):
                tables[section.title] = PageTable(
                    ("",), [(" | ".join(cell for cell in row if cell),) for row in block.rows]
                )
        lines.append("")
    return pdf_pages(page.title, lines, tables, [])
