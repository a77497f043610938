"""Edits a configuration file in place; comments stay."""

import difflib
import json
import sys
import tomllib
from collections.abc import Collection
from pathlib import Path
from typing import Any

from firmware_iface.settings import Section
from membrane_ctrl.model import errors, files
from membrane_ctrl.model.errors import InputError
from membrane_ctrl.sessions.folder import SessionFolder
from membrane_ctrl.sessions.progress import Progress


def confirm_and_replace(
    path: Path, before: str, after: str, folder: SessionFolder, yes: bool
) -> bool:
    """Show the difference of a configuration, and write it if the person agrees.

    Parameters
    ----------
    path : Path
        The configuration; a link is followed.
    before : str
        The text that it has. It is not written if the file has another one by now.
    after : str
        The text that it shall have.
    folder : SessionFolder
        Whose results these are, for the heading of the difference.
    yes : bool
        Write without asking. Without it, and without a terminal, nothing is written.

    Returns
    -------
    bool
        Whether the file was written.

    Raises
    ------
    InputError
        The file has changed meanwhile, or cannot be written.
    """
    shown = difflib.unified_diff(
        before.splitlines(), after.splitlines(), str(path), folder.path.name, lineterm="", n=1
    )
    print("\n".join(shown))
    if not yes and not (
        sys.stdin.isatty()
        and Progress().ask_question(f"save to {path}? [y/N]").lower() in ("y", "yes")
    ):
        print(f"{path} is unchanged; --yes saves without asking", file=sys.stderr)
        return False
    _replace_file(path, before, after)
    return True


def list_changes(old: Section, new: Section, keys: Collection[str] = ()) -> dict[str, Any]:
    """Settings of a table that differ.

    Parameters
    ----------
    old, new : Section
        The same table of two configurations.
    keys : collection of str
        Only these are compared; all if it is empty.

    Returns
    -------
    dict
        The new values by key, as TOML holds them.
    """
    plain = new.model_dump(mode="json", include=set(keys) or None)
    return {key: value for key, value in plain.items() if getattr(new, key) != getattr(old, key)}


def edit_text(text: str, changed: dict[str, dict[str, Any]], path: Path) -> str:
    """Return a configuration's text with some keys replaced; nothing else changes.

    Parameters
    ----------
    text : str
        TOML.
    changed : dict of dict of Any
        New values by table and key.
    path : Path
        For the message.

    Raises
    ------
    InputError
        The edited text would not read as exactly the wanted tables.
    """
    import tomlkit
    from tomlkit.exceptions import TOMLKitError

    # The edited text is accepted only if it reads as exactly this.
    wanted = tomllib.loads(text)
    changed = {name: keys for name, keys in changed.items() if keys}
    wanted |= {name: wanted.get(name, {}) | keys for name, keys in changed.items()}
    try:
        document = tomlkit.parse(text)
        for name, keys in changed.items():
            document.setdefault(name, tomlkit.table()).update(keys)
        edited = tomlkit.dumps(document)
        if tomllib.loads(edited) == wanted:
            return edited
    except (TOMLKitError, ValueError):
        pass
    lines = "; ".join(
        f"set in [{name}]: "
        + ", ".join(f"{key} = {json.dumps(value)}" for key, value in keys.items())
        for name, keys in changed.items()
    )
    raise InputError(f"{path}: cannot be edited by a program; {lines}")


def _replace_file(path: Path, before: str, after: str) -> None:
    """Write the file a link leads to, with its permissions. Raises InputError also if it has
    changed meanwhile.
    """
    target = path.resolve()
    with errors.convert_write_errors(path):
        mode = target.stat().st_mode
        if files.read_text(target) != before:
            raise InputError(f"{path}: has changed meanwhile; repeat `tune save`")
        files.write_text_atomic(target, after)
        target.chmod(mode)
