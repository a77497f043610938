"""Which program wrote a file: its version and the commit of its source.

All commits before a release have the same version, so the commit is stated beside it. A wheel or a
source archive carries the commit in `BUILD_FILE`, which the build writes (`setup.py`). In a
checkout, git describes it. The commit of any other folder is empty.
"""

import json
import os
import re
import subprocess
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from membrane_ctrl import __version__

NAME = "membrane-ctrl"
PACKAGE = Path(__file__).parents[1]
BUILD_FILE = "build_commit.txt"
_COMMIT = re.compile(r"[0-9a-f]{12,64}(-dirty)?")
_COMMIT_DIGITS = 12
_GIT_TIMEOUT_S = 5.0
_REFERENCE_BYTES_MAX = 4096


@cache
def program_commit() -> str:
    """Commit of the running source: 12 hexadecimal digits, then `-dirty` if files were changed;
    empty if unknown.

    The first call of a process may start git, which takes some 20 ms. So call it before the first
    tick.
    """
    built = _find_match(_read_line(PACKAGE / BUILD_FILE))
    return built or find_commit(PACKAGE.parent)


def program_identity() -> str:
    """Name, version and commit in one line: `membrane-ctrl 1.0.0 (0123456789ab)`."""
    return stated_program(file_origin(""))


def file_origin(schema: str) -> dict[str, str]:
    """First members of a JSON or TOML file: its format with version, and the program and commit
    that wrote it.
    """
    return {"schema": schema, "program": f"{NAME} {__version__}", "commit": program_commit()}


def describe_origin(schema: str) -> str:
    """`file_origin` as one line of JSON, for a file of arrays."""
    return json.dumps(file_origin(schema))


def remove_origin(table: dict[str, Any], schema: str) -> None:
    """Remove the members of `file_origin` from a file's members.

    Parameters
    ----------
    table : dict
    schema : str
        Format with version that the file must have.

    Raises
    ------
    ValueError
        The file is of another format.
    """
    stated = table.pop("schema", None)
    if stated != schema:
        raise ValueError(f"format {str(stated)[:40]!r}, expected {schema!r}")
    table.pop("program", None)
    table.pop("commit", None)


def stated_program(table: Mapping[str, Any]) -> str:
    """Program and commit stated in a file's members, as `program_identity`; empty if none is
    stated.
    """
    program = table.get("program")
    commit = table.get("commit")
    if not isinstance(program, str) or not program:
        return ""
    if isinstance(commit, str) and commit:
        return f"{program} ({commit})"
    return program


def find_commit(checkout: Path) -> str:
    """Commit of a checkout's source, as `program_commit`; empty if the folder is no checkout.

    Without git, or where git refuses the folder, the commit is read from `.git`, and changed files
    go unnoticed.
    """
    if not (checkout / ".git").exists():  # a checkout above this folder is another project's
        return ""
    return _describe_with_git(checkout) or _read_head(checkout / ".git")


def _describe_with_git(checkout: Path) -> str:
    words = ["git", "describe", "--always", "--dirty", "--exclude=*", f"--abbrev={_COMMIT_DIGITS}"]
    # writes nothing, not even a refreshed index
    environment = os.environ | {"GIT_OPTIONAL_LOCKS": "0"}
    try:
        done = subprocess.run(
            words,
            cwd=checkout,
            env=environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=_GIT_TIMEOUT_S,
            check=False,
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    if done.returncode != 0:
        return ""
    return _find_match(done.stdout.decode(errors="replace").strip())


def _read_head(git: Path) -> str:
    head = _read_line(git / "HEAD")
    name = head.removeprefix("ref: ")
    if name != head and ".." not in Path(name).parts:
        found = _read_line(git / name)
    else:
        found = head
    return _find_match(found)[:_COMMIT_DIGITS]


def _read_line(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return file.read(_REFERENCE_BYTES_MAX).decode(errors="replace").strip()
    except OSError:
        return ""


def _find_match(text: str) -> str:
    return text if _COMMIT.fullmatch(text) else ""
