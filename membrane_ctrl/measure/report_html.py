"""The pages of a measurement's report as one HTML file that loads nothing from elsewhere."""

from base64 import b64encode
from collections.abc import Sequence
from html import escape

_STYLE = """
body{max-width:1080px;margin:0 auto;padding:28px;color:#20242b;font:15px/1.5 system-ui,sans-serif}
h1,h2{overflow-wrap:anywhere}h2{font-size:17px;margin-top:28px;border-bottom:1px solid #e3e7ed}
table{border-collapse:collapse;font-variant-numeric:tabular-nums}th{text-align:left;color:#667}
td,th{border-bottom:1px solid #eef0f4;padding:3px 18px 3px 0}pre{white-space:pre-wrap;overflow-wrap:anywhere}
img{max-width:100%}@media print{figure,tr{break-inside:avoid}}
"""  # noqa: E501
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"

ReportTable = tuple[str, list[tuple[str, ...]]]  # heading, rows; the first names the columns


def html_page(
    title: str,
    lines: Sequence[str],
    tables: Sequence[ReportTable],
    images: Sequence[tuple[str, bytes]],
) -> str:
    parts = [
        "<!doctype html><html lang='en'><meta charset='utf-8'>",
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">',
        f"<title>{escape(title)}</title><style>{_STYLE}</style><h1>{escape(title)}</h1>",
        f"<pre>{escape(chr(10).join(lines))}</pre>",
    ]
    for heading, rows in tables[:2]:
        parts.append(_html_table(heading, rows))
    for name, data in images:
        text = b64encode(data).decode()
        parts.append(
            f"<h2>{name}</h2><figure><img alt='{name}' src='data:image/png;base64,{text}'></figure>"
        )
    parts += [_html_table(heading, rows) for heading, rows in tables[2:]]
    return "\n".join(parts) + "</html>\n"


def _html_table(heading: str, rows: Sequence[tuple[str, ...]]) -> str:
    head, *body = [[escape(text) for text in row] for row in rows]
    marked = ["<th>" + "<th>".join(head), *("<td>" + "<td>".join(row) for row in body)]
    return (
        f"<h2>{escape(heading)}</h2><table>"
        + "\n".join(f"<tr>{row}" for row in marked)
        + "</table>"
    )
