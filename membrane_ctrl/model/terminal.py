"""Lets only text and line ends reach a terminal. Every command prints through this module.

Text from files and the network may contain control bytes, which a terminal executes, and
bidirectional marks, which reorder a line. Each such character becomes its JSON escape, so that JSON
stays JSON and keeps its meaning.
"""

from __future__ import annotations

import contextlib
import os
import sys
import unicodedata
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any, TextIO, TypeVar, cast

if TYPE_CHECKING:  # commands without a table need not load it
    from rich.console import (
        Console,
        ConsoleOptions,
        ConsoleRenderable,
        RenderableType,
        RenderResult,
    )


_T = TypeVar("_T")
# control, invisible and direction marks, surrogates, and two line ends that terminals do not show
_REFUSED = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})
_KEPT = frozenset("\n\t")


def escape_controls(text: str) -> str:
    """The text with every character that a terminal might execute replaced by its JSON escape."""
    if text.isprintable():
        return text
    return "".join(_escape_letter(letter) if _is_refused(letter) else letter for letter in text)


def one_line(text: str) -> str:
    """As `escape_controls`, in one line: spaces replace line ends."""
    return escape_controls(" ".join(text.split("\n")))


@contextlib.contextmanager
def only_text() -> Iterator[None]:
    """Within this context, all output of the program is reduced to plain text."""
    with (
        contextlib.redirect_stdout(cast("TextIO", _Text(sys.stdout))),
        contextlib.redirect_stderr(cast("TextIO", _Text(sys.stderr))),
    ):
        yield


def table_console(stderr: bool = False, width: int | None = None) -> Console:
    """Make a Rich console for tables whose cells may hold texts from anywhere.

    It passes Rich's own colours, but no control characters in the cells, and reads no markup.

    Parameters
    ----------
    stderr : bool
        Print on stderr instead of stdout.
    width : int or None
        Columns; None: those of the terminal.
    """
    from rich.console import Console

    # texts have [square brackets]
    made = Console(stderr=stderr, width=width, markup=False, emoji=False)
    made.push_render_hook(_Cells())  # type: ignore[arg-type]  # its base class is Rich's, loaded here only
    return made


def live_line(text: str, end: str = "") -> None:
    """Replace the last line of stderr, which must be a terminal.

    Parameters
    ----------
    text : str
        One line; line ends become spaces, control characters are escaped.
    end : str
        Written after the text; a line feed makes the line stay.
    """
    # `_Text` would escape what moves the cursor
    stream = getattr(sys.stderr, "rich_proxied_file", sys.stderr)
    stream.write(f"\r\033[K{one_line(text)}{end}")
    stream.flush()


def track_progress(items: Iterable[_T], what: str, total: int | None = None) -> Iterable[_T]:
    """Yield items, with a progress bar on stderr if that is a terminal.

    Parameters
    ----------
    items : iterable
        Yielded unchanged.
    what : str
        Title of the bar, such as `sets`.
    total : int or None
        Number of items; None: their length, or a bar without an end if they have none.
    """
    from rich.progress import track

    rich = table_console(stderr=True)
    on = sys.stderr.isatty()
    # while it draws, Rich replaces `_Text`
    rich.file = getattr(sys.stderr, "rich_proxied_file", sys.stderr)
    return track(items, what, total, console=rich, transient=True, disable=not on)


class Plain:
    """Removes control characters from what Rich draws, for a `Live`, which bypasses a console's
    hooks.
    """

    def __init__(self, inner: RenderableType) -> None:
        self._inner = inner

    def __rich_console__(self, rich: Console, options: ConsoleOptions) -> RenderResult:
        from rich.segment import Segment

        for segment in rich.render(self._inner, options):
            yield (
                segment
                if segment.control
                else Segment(escape_controls(segment.text), segment.style)
            )


class _Cells:
    def process_renderables(self, renderables: list[ConsoleRenderable]) -> list[ConsoleRenderable]:
        return [Plain(renderable) for renderable in renderables]


class _Text:
    """A stream that filters another."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        # Rich writes here, with colours: `table_console` has filtered its cells
        self.rich_proxied_file = getattr(stream, "rich_proxied_file", stream)

    def write(self, text: str) -> int:
        """Write a text, reduced to plain text."""
        self._stream.write(escape_controls(text))
        return len(text)

    def writelines(self, lines: Any) -> None:
        """Write several lines."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _is_refused(letter: str) -> bool:
    return letter not in _KEPT and unicodedata.category(letter) in _REFUSED


def _escape_letter(letter: str) -> str:
    units = letter.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{int.from_bytes(units[k : k + 2]):04x}" for k in range(0, len(units), 2))


def can_draw() -> bool:
    """Whether stderr is a terminal on which the console is drawn, not printed line by line."""
    return sys.stderr.isatty() and os.environ.get("TERM") not in ("dumb", "unknown")


def print_progress(words: str) -> None:
    """Print a line of progress on stderr; a reader that has gone is no error."""
    with contextlib.suppress(OSError):
        print(words, file=sys.stderr, flush=True)
