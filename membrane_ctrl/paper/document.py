"""The document: one page and one PDF with each part, ours beside the paper."""

from collections.abc import Mapping, Sequence

from membrane_ctrl.measure.report_pdf import pdf_pages
from membrane_ctrl.paper.comparison import Agreement, PaperStatement, PartResult
from membrane_ctrl.paper.paper_part import PaperPart
from membrane_ctrl.report_pages.blocks import (
    PageBlock,
    PageLines,
    PagePicture,
    PageSection,
    PageTable,
    PageText,
    ReportPage,
)
from membrane_ctrl.report_pages.render import render_page

TITLE = "Surface figure metrology for reflective membrane mirrors: computed again"
_HEAD = ("quantity", "the paper", "here", "", "note")
_SOURCE = (
    "X. Yan et al., Surface figure metrology for reflective membrane mirrors based on "
    "phase-measuring deflectometry. Each figure and table of it is computed here; where its text "
    "can be read in several ways, each way is computed."
)


def render_document(
    results: Mapping[PaperPart, PartResult], described: str, command: str
) -> tuple[str, bytes]:
    """The document as HTML and as PDF.

    Parameters
    ----------
    results : mapping of PaperPart to PartResult
        In the order of the document.
    described : str
        What was computed: bench, size, seed.
    command : str
        The command that makes the document; a part's own is this with `--only`.
    """
    sections = [PageSection("", [PageText(_SOURCE), PageText(described), _summarise(results)])]
    for part, result in results.items():
        blocks: list[PageBlock] = [_tabulate(result.comparisons)]
        blocks += [PagePicture(title, png) for title, png in result.pictures.items()]
        blocks.append(PageLines([f"{command} --only {part.name}"]))
        sections.append(PageSection(f"{part.title} ({part.source})", blocks))
    page = ReportPage(TITLE, sections, wide=True)
    return render_page(page), _render_pdf(results, described, command)


def count_agreements(results: Mapping[PaperPart, PartResult]) -> dict[Agreement, int]:
    """How many comparisons have which agreement."""
    found = [
        comparison.agreement for result in results.values() for comparison in result.comparisons
    ]
    return {agreement: found.count(agreement) for agreement in Agreement}


def _summarise(results: Mapping[PaperPart, PartResult]) -> PageTable:
    """One row a part: how many of its comparisons agree."""
    rows = []
    for part, result in results.items():
        counts = count_agreements({part: result})
        rows.append((part.title, *(str(counts[agreement]) for agreement in Agreement)))
    return PageTable(("part", *map(str, Agreement)), rows)


def _tabulate(comparisons: Sequence[PaperStatement]) -> PageTable:
    rows = [
        (each.quantity, each.paper, each.ours, str(each.agreement), each.note)
        for each in comparisons
    ]
    return PageTable(_HEAD, rows)


def _render_pdf(results: Mapping[PaperPart, PartResult], described: str, command: str) -> bytes:
    """The same content in pages of A4."""
    lines = [_SOURCE, "", described]
    pictures = []
    for part, result in results.items():
        lines += ["", "", f"{part.title} ({part.source})", f"{command} --only {part.name}"]
        for each in result.comparisons:
            lines += ["", each.quantity]
            if each.paper:
                lines.append(f"    the paper: {each.paper}")
            lines.append(f"    here: {each.ours} ({each.agreement})")
            if each.note:
                lines.append(f"    {each.note}")
        pictures += [PagePicture(title, png) for title, png in result.pictures.items()]
    return pdf_pages(TITLE, lines, {}, pictures)
