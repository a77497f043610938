"""Renders a report page as one HTML file that loads nothing from elsewhere.

`report_page.html` is the template, `report_page.css` the style.
"""

from base64 import b64encode
from functools import cache

from jinja2 import Environment, PackageLoader, StrictUndefined, Template

from membrane_ctrl.report_pages.blocks import ReportPage


def render_page(page: ReportPage) -> str:
    """Return the page's HTML. Its scripts, links to other sites and fonts are none: a policy in the
    page forbids them.
    """
    return _load_template().render(page=page)


@cache
def _load_template() -> Template:
    environment = Environment(
        loader=PackageLoader("membrane_ctrl.report_pages", ""),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["base64"] = _encode_base64
    return environment.get_template("report_page.html")


def _encode_base64(data: bytes) -> str:
    return b64encode(data).decode("ascii")
