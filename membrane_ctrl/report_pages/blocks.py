"""The content of a report page: blocks of text, facts, tables and pictures.

Texts are plain: the template escapes them. A cell or drawing that is HTML is a `Markup`; only this
program's own HTML may be one.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import ClassVar, TypeAlias

from markupsafe import Markup


class TextMark(StrEnum):
    """How a paragraph is marked; also the class of its style."""

    NONE = ""
    GOOD = "verdict good"
    LOOK = "verdict look"
    BAD = "verdict bad"


@dataclass(frozen=True, slots=True)
class PageText:
    """A paragraph."""

    kind: ClassVar[str] = "text"
    text: str
    mark: TextMark = TextMark.NONE


@dataclass(frozen=True, slots=True)
class PageLines:
    """Lines as a terminal shows them."""

    kind: ClassVar[str] = "lines"
    lines: Sequence[str]


@dataclass(frozen=True, slots=True)
class PageWarnings:
    """What is unusual: the name of each finding, and what was found."""

    kind: ClassVar[str] = "warnings"
    findings: Sequence[tuple[str, str]]


@dataclass(frozen=True, slots=True)
class PageFacts:
    """Names with their values."""

    kind: ClassVar[str] = "facts"
    facts: Sequence[tuple[str, str]]


@dataclass(frozen=True, slots=True)
class PageTable:
    """A table; all rows have as many cells as the head."""

    kind: ClassVar[str] = "table"
    head: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True, slots=True)
class PagePicture:
    """A PNG image, embedded in the page."""

    kind: ClassVar[str] = "picture"
    name: str
    png: bytes


@dataclass(frozen=True, slots=True)
class PageDrawing:
    """An SVG image that this program drew."""

    kind: ClassVar[str] = "drawing"
    svg: Markup


PageBlock: TypeAlias = (
    PageText | PageLines | PageWarnings | PageFacts | PageTable | PagePicture | PageDrawing
)


@dataclass(frozen=True, slots=True)
class PageSection:
    """Blocks under a heading; without a heading if the title is empty."""

    title: str
    blocks: Sequence[PageBlock]


@dataclass(frozen=True, slots=True)
class ReportPage:
    """A whole page."""

    title: str
    sections: Sequence[PageSection]
    heading: str = ""  # if it differs from the title
    beside_heading: str = ""
    footer: str = ""
    wide: bool = field(default=False, kw_only=True)  # as wide as the window
