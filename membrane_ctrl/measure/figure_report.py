"""The report of a measurement: its numbers as tables, written as HTML and PDF."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from membrane_ctrl.measure.report_pdf import pdf_pages
from membrane_ctrl.model.files import write_bytes_atomic, write_text_atomic
from membrane_ctrl.model.terminal import escape_controls
from membrane_ctrl.report_pages.blocks import (
    PageLines,
    PagePicture,
    PageSection,
    PageTable,
    PageText,
    ReportPage,
    TextMark,
)
from membrane_ctrl.report_pages.render import render_page

# On the page, these tables come before the other pictures; the Zernike terms come after them.
_TABLES_FIRST = 2
# The picture that shows what a reader came for: the first of these that was drawn.
_PICTURES_FIRST = ("figure", "star", "residual", "frames")
_MARKS = {"ok": TextMark.GOOD, "degraded": TextMark.LOOK, "rejected": TextMark.BAD}


def write_report(
    out: Path, name: str, lines: Sequence[str], result: dict[str, Any], drawn: Sequence[Path]
) -> None:
    """Write `report.html` and `report.pdf` of a measurement: its lines, numbers, terms and
    pictures.

    Parameters
    ----------
    out : Path
        The folder.
    name : str
        Of the measured set, for the title.
    lines : sequence of str
        What the command printed.
    result : dict
        The content of `result.json`.
    drawn : sequence of Path
        The pictures' PNG files.

    Raises
    ------
    OSError
        If a file cannot be read or written.
    """
    title = escape_controls(f"Measurement of {name}")
    safe_lines = [escape_controls(line) for line in lines]

    # Tables and pictures.
    tables = {}
    if result["figure"] is not None:
        tables = _make_tables(result["figure"])
    pictures = [PagePicture(file.stem, file.read_bytes()) for file in drawn]
    sections = [PageSection(heading, [table]) for heading, table in tables.items()]

    # The verdict, in a text that cannot contain control characters.
    quality = result["quality"]
    verdict = str(quality["verdict"])
    reason = escape_controls(str(quality["reason"]))
    stated = PageText(f"{verdict}: {reason}" if reason else verdict, _MARKS[verdict])
    pictures.sort(key=_rank_picture)

    # The page in HTML, and the same as PDF.
    page = ReportPage(
        title,
        [
            PageSection("", [stated, *pictures[:1]]),
            *sections[:_TABLES_FIRST],
            *(PageSection(picture.name, [picture]) for picture in pictures[1:]),
            *sections[_TABLES_FIRST:],
            PageSection("As printed", [PageLines(safe_lines)]),
        ],
    )
    write_text_atomic(out / "report.html", render_page(page))
    write_bytes_atomic(out / "report.pdf", pdf_pages(title, safe_lines, tables, pictures))


def _rank_picture(picture: PagePicture) -> int:
    """The order of the pictures: the figure first, the others as they were drawn."""
    first = _PICTURES_FIRST
    if picture.name in first:
        return first.index(picture.name)
    return len(first)


def _make_tables(figure: dict[str, Any]) -> dict[str, PageTable]:
    """Return the numbers of the block `figure`, what it does not give, and its sets of terms, by
    heading.
    """
    where = (
        f"aperture: radius {figure['aperture_radius_mm']:g} mm about the vertex; cells of "
        f"{figure['cell_mm']:.3g} mm"
    )
    rows = [
        (name, *map(_format_cell, number.values())) for name, number in figure["numbers"].items()
    ]
    head = ("number", "value", "1 sigma, noise", "1 sigma, geometry")
    tables = {f"Figure ({where})": PageTable(head, rows)}
    if figure["not_given"]:
        reasons = list(figure["not_given"].items())
        tables["Not given"] = PageTable(("number", "reason"), reasons)
    for terms in figure["zernike"]:
        heading = (
            f"Zernike terms, {terms['index']}, {terms['normalisation']} 1 over "
            f"{terms['radius_mm']:g} mm"
        )
        tables[heading] = _tabulate_terms(terms)
    return tables


def _tabulate_terms(terms: dict[str, Any]) -> PageTable:
    columns = (terms["coeffs_um"], terms["sigma_noise_um"], terms["sigma_geometry_um"])
    rows = [
        (str(j), *map(_format_cell, row))
        for j, row in enumerate(zip(*columns, strict=True), terms["first"])
    ]
    return PageTable(("j", "coefficient, µm", "1 sigma, noise", "1 sigma, geometry"), rows)


def _format_cell(value: float | None) -> str:
    if value is None:
        return "unknown"
    return f"{value:.6g}"
