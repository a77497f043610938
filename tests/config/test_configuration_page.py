"""docs/reference/configuration.md is what the schema makes of it."""

from pathlib import Path

from membrane_ctrl.config import reference


def test_the_page_is_up_to_date() -> None:
    page = Path(__file__).parents[2] / "docs" / "reference" / "configuration.md"
    assert page.read_text() == reference.make_reference_page(), "run make generate"
