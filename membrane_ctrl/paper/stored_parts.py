"""Finished parts on disk, so that a computation that was ended continues where it was."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from membrane_ctrl.measure.result_files import write_json
from membrane_ctrl.model import files, program
from membrane_ctrl.paper.bench import PaperOptions
from membrane_ctrl.paper.comparison import PaperStatement, PartResult
from membrane_ctrl.paper.paper_part import PaperPart

_FORMAT = "membrane-paper-part/1"
_BYTES_MAX = 10_000_000  # of one picture or table


@dataclass(frozen=True, slots=True)
class _StoredPart:
    """The content of a part's table; its pictures are files beside it."""

    origin: dict[str, Any]
    made_from: dict[str, Any]
    comparisons: list[PaperStatement]
    numbers: dict[str, Any]
    timing_s: dict[str, float]
    pictures: list[str]


class PartFolder:
    """Parts of one document.

    Parameters
    ----------
    folder : Path
        Existing folder.
    options : PaperOptions
        A part that was computed with others is computed again.
    sets : str, optional
        Fingerprint of the recorded sets; None: simulated.
    """

    def __init__(self, folder: Path, options: PaperOptions, sets: str | None) -> None:
        self._folder = folder
        self._made_from = {**asdict(options), "sets": sets}
        del self._made_from["scheduler"]  # the numbers are the same everywhere

    def read_part(self, part: PaperPart) -> PartResult | None:
        """A finished part; None if there is none of this program and these options."""
        try:
            content = files.read_bytes(self._table(part), _BYTES_MAX)
            stored = TypeAdapter(_StoredPart).validate_json(content)
            if stored.origin != program.file_origin(_FORMAT) or stored.made_from != self._made_from:
                return None
            pictures = {
                title: files.read_bytes(self._picture(part, number), _BYTES_MAX)
                for number, title in enumerate(stored.pictures)
            }
        except (OSError, ValueError, ValidationError):
            return None
        return PartResult(stored.comparisons, stored.numbers, pictures, stored.timing_s)

    def write_part(self, part: PaperPart, result: PartResult) -> None:
        """Store a finished part: pictures first, so that a table is never without them.

        Parameters
        ----------
        part : PaperPart
            Which part.
        result : PartResult
            What it computed.

        Raises
        ------
        OSError
            A file cannot be written.
        """
        for number, png in enumerate(result.pictures.values()):
            files.write_bytes_atomic(self._picture(part, number), png)
        table = {
            "origin": program.file_origin(_FORMAT),
            "made_from": self._made_from,
            "comparisons": [asdict(comparison) for comparison in result.comparisons],
            "numbers": dict(result.numbers),
            "timing_s": dict(result.timing_s),
            "pictures": list(result.pictures),
        }
        write_json(self._table(part), table)

    def _table(self, part: PaperPart) -> Path:
        return self._folder / f"{part.name}.json"

    def _picture(self, part: PaperPart, number: int) -> Path:
        return self._folder / f"{part.name}-{number + 1}.png"
