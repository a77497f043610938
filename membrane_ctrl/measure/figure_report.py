"""The report of a measurement: its numbers as tables, written as HTML and PDF."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from membrane_ctrl.measure.report_html import ReportTable, html_page
from membrane_ctrl.measure.report_pdf import pdf_pages
from membrane_ctrl.model.files import write_bytes_atomic, write_text_atomic
from membrane_ctrl.model.terminal import escape_controls


def write_report(
    out: Path, name: str, lines: Sequence[str], result: dict[str, Any], drawn: Sequence[Path]
) -> None:
    """Write `report.html` and `report.pdf` of a measurement: its lines, numbers, terms and
    pictures. Raises OSError.

    `name` is for the title; `result` is the content of `result.json`; `drawn` are the pictures'
    files.
    """
    title = escape_controls(f"Measurement of {name}")
    tables = [] if result["figure"] is None else _list_tables(result["figure"])
    images = [(file.stem, file.read_bytes()) for file in drawn]
    write_text_atomic(
        out / "report.html",
        html_page(title, [escape_controls(line) for line in lines], tables, images),
    )
    write_bytes_atomic(
        out / "report.pdf",
        pdf_pages(title, [escape_controls(line) for line in lines], tables, images),
    )


def _list_tables(figure: dict[str, Any]) -> list[ReportTable]:
    """The numbers of the block `figure`, what it does not give, and its sets of terms."""

    def cell(value: float | None) -> str:
        return "unknown" if value is None else f"{value:.6g}"

    rows: list[tuple[str, ...]] = [("number", "value", "1 sigma, noise", "1 sigma, geometry")]
    rows += [(key, *(cell(item[part]) for part in item)) for key, item in figure["numbers"].items()]
    where = (
        f"aperture: radius {figure['aperture_radius_mm']:g} mm about the vertex; cells of "
        f"{figure['cell_mm']:.3g} mm"
    )
    tables: list[ReportTable] = [(f"Figure ({where})", rows)]
    if figure["not_given"]:
        tables.append(("Not given", [("number", "reason"), *figure["not_given"].items()]))
    for terms in figure["zernike"]:
        rows = [("j", "coefficient, µm", "1 sigma, noise", "1 sigma, geometry")]
        columns = (terms[key] for key in ("coeffs_um", "sigma_noise_um", "sigma_geometry_um"))
        rows += [
            (str(j), *map(cell, row))
            for j, row in enumerate(zip(*columns, strict=True), terms["first"])
        ]
        heading = (
            f"Zernike terms, {terms['index']}, {terms['normalisation']} 1 over "
            f"{terms['radius_mm']:g} mm"
        )
        tables.append((heading, rows))
    return tables
