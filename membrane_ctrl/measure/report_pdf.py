"""The pages of a measurement's report as PDF."""

import io
from collections.abc import Mapping, Sequence
from textwrap import wrap

from membrane_ctrl.report_pages.blocks import PagePicture, PageTable

_PAGE_INCHES = (8.27, 11.69)  # A4, inches
_LINES_A_PAGE = 64


def pdf_pages(
    title: str,
    lines: Sequence[str],
    tables: Mapping[str, PageTable],
    pictures: Sequence[PagePicture],
) -> bytes:
    """Make the pages of a report: text and tables first, then two pictures a page.

    Parameters
    ----------
    title : str
        First line.
    lines : sequence of str
        Text below the title; long lines are wrapped.
    tables : mapping of str to PageTable
        Tables by heading.
    pictures : sequence of PagePicture
        PNG images.

    Returns
    -------
    bytes
        A PDF file of pages in A4.
    """
    from matplotlib import figure, image
    from matplotlib.backends.backend_pdf import PdfPages

    text = [title, "", *(part for line in lines for part in wrap(line, 100) or [""])]
    for heading, table in tables.items():
        text += ["", heading]
        for row in (table.head, *table.rows):
            text += wrap("".join(f"{cell:26}" for cell in row), 104)
    file = io.BytesIO()
    with PdfPages(file) as pages:
        for first in range(0, len(text), _LINES_A_PAGE):
            page = figure.Figure(figsize=_PAGE_INCHES)
            part = "\n".join(text[first : first + _LINES_A_PAGE])
            page.text(
                0.07,
                0.96,
                part,
                va="top",
                family="monospace",
                fontsize=7.5,
                linespacing=1.5,
                parse_math=False,
            )
            pages.savefig(page)
        for first in range(0, len(pictures), 2):
            page = figure.Figure(figsize=_PAGE_INCHES)
            for place, picture in enumerate(pictures[first : first + 2]):
                axes = page.add_axes((0.05, 0.51 - 0.48 * place, 0.9, 0.46))
                axes.imshow(image.imread(io.BytesIO(picture.png)))
                axes.set_axis_off()
            pages.savefig(page)
    return file.getvalue()
