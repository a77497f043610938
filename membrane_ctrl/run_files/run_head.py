"""`run.json`: the format of a run folder, and the program that recorded it.

The format counts the layout of the whole folder: from 1.0.0 on, each release reads those of the
former releases (decision 68).
"""

import re
from dataclasses import dataclass
from pathlib import Path

from membrane_ctrl.model import file_checksums, files, plain_json
from membrane_ctrl.model.program import file_origin, stated_program

HEAD_FILE = "run.json"
FORMAT = 1
_SCHEMA = re.compile(r"membrane-run/(\d{1,6})")
_BYTES_MAX = 65_536


@dataclass(frozen=True, slots=True)
class RunHead:
    """Content of `run.json`: number of the format, and the program with its commit; 0 and empty if
    unknown.
    """

    format: int = 0
    recorded_by: str = ""


def write_run_head(run_dir: Path) -> None:
    """Write `run.json`. Raises OSError."""
    text = file_checksums.dumps_checked(file_origin(f"membrane-run/{FORMAT}"), indent=2)
    files.write_text_atomic(run_dir / HEAD_FILE, text + "\n")


def read_run_head(folder: Path, notes: list[str]) -> RunHead:
    """Read `run.json`; without it, or if it is damaged, number 0 and no program.

    Parameters
    ----------
    folder : Path
        Folder of the run.
    notes : list of str
        Gets a line if it is damaged or edited, or the folder has a later format than this version.
    """
    try:
        table = plain_json.loads(files.read_text(folder / HEAD_FILE, _BYTES_MAX))
    except FileNotFoundError:
        return RunHead()
    except (OSError, ValueError) as error:
        notes.append(f"{HEAD_FILE}: cannot be read ({error})")
        return RunHead()
    # Of our schema, and not damaged or edited.
    found = None
    if isinstance(table, dict):
        found = _SCHEMA.fullmatch(str(table.get("schema")))
    if found is None or not file_checksums.pop_checksum(table):
        notes.append(f"{HEAD_FILE}: damaged or edited; it is not used")
        return RunHead()
    head = RunHead(int(found[1]), stated_program(table))
    if head.format > FORMAT:
        notes.append(
            f"{HEAD_FILE}: membrane-run/{head.format}, recorded by "
            f"{head.recorded_by or 'a later version'}; "
            f"this version reads membrane-run/{FORMAT}, and what it does not understand is left out"
        )
    return head
