"""Keys of the configuration that releases have renamed, and the upgrade of a file that has them.

The promise begins with 1.0.0 (docs/reference/stability.md): a key that a later release renames or
removes is entered here, with the release and its date. A file with former keys is refused with the
command that upgrades it, until the major version after that release.
"""

import difflib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError

from membrane_ctrl.config import toml_file
from membrane_ctrl.config.schema import Config
from membrane_ctrl.model import errors, files


@dataclass(frozen=True, slots=True)
class ChangedKey:
    """A key that a release has renamed or removed.

    Attributes
    ----------
    release, date : str
        First release without the former key, and its day.
    former, present : str
        Dotted names; `present` is empty for a key that was removed.
    why : str
        For people.
    """

    release: str
    date: str
    former: str
    present: str
    why: str

    @property
    def words(self) -> str:
        """The change in one line."""
        becomes = f"is now {self.present}" if self.present else "was removed"
        return f"{self.former} {becomes} ({self.release}, {self.date}): {self.why}"


# No release has changed a key.
CHANGED_KEYS: tuple[ChangedKey, ...] = ()


@dataclass(frozen=True, slots=True)
class UpgradedText:
    """The text of a configuration after its upgrade, and the changes made."""

    text: str
    changes: tuple[ChangedKey, ...]


def upgrade_text(text: str, changed: Sequence[ChangedKey] = CHANGED_KEYS) -> UpgradedText:
    """Rename former keys in a configuration; comments and order stay.

    Parameters
    ----------
    text : str
        TOML.
    changed : sequence of ChangedKey
        The keys that releases have renamed or removed, oldest first.

    Raises
    ------
    InputError
        It is no TOML, or has a former key and the present one.
    """
    try:
        document = tomlkit.parse(text)
    except TOMLKitError as error:
        raise errors.InputError(f"not valid TOML: {error}") from None
    made = [change for change in changed if _apply_change(document, change)]
    return UpgradedText(tomlkit.dumps(document), tuple(made))


def upgrade_file(path: Path, write: bool, changed: Sequence[ChangedKey] = CHANGED_KEYS) -> str:
    """Upgrade a configuration file; the former one is kept beside it as `NAME.former`.

    Parameters
    ----------
    path : Path
        The file.
    write : bool
        Without it the file stays.
    changed : sequence of ChangedKey
        The renamed keys.

    Returns
    -------
    str
        The difference; empty if nothing changes.

    Raises
    ------
    InputError
        The file cannot be read, or is refused after the upgrade.
    """
    try:
        text = files.read_text(path, follow=True)
    except (OSError, UnicodeDecodeError) as error:
        reason = errors.os_reason(error) if isinstance(error, OSError) else "not UTF-8"
        raise errors.InputError(f"{path}: cannot be read ({reason})") from None
    upgraded = upgrade_text(text, changed)
    if not upgraded.changes:
        toml_file.load_toml_text(text, path, Config)
        return ""
    toml_file.load_toml_text(upgraded.text, path, Config)
    former = path.with_name(f"{path.name}.former")
    lines = difflib.unified_diff(
        text.splitlines(), upgraded.text.splitlines(), str(path), f"{path} (upgraded)", lineterm=""
    )
    if write:
        with errors.convert_write_errors(path):
            files.write_text_atomic(files.resolve_user_path(former), text)
            files.write_text_atomic(files.resolve_user_path(path), upgraded.text)
    return "\n".join(lines)


def _apply_change(document: dict[str, Any], change: ChangedKey) -> bool:
    """Rename or remove one key; returns whether the document had it."""
    *tables, key = change.former.split(".")
    table = _find_table(document, tables)
    if table is None or key not in table:
        return False
    value = table.pop(key)
    if change.present:
        *tables, key = change.present.split(".")
        target: Any = document
        for name in tables:
            target = target.setdefault(name, tomlkit.table())
        if key in target:
            raise errors.InputError(
                f"{change.former} and {change.present} are both there; remove one of them"
            )
        target[key] = value
    return True


def _find_table(document: dict[str, Any], names: Sequence[str]) -> dict[str, Any] | None:
    table: Any = document
    for name in names:
        table = table.get(name) if isinstance(table, dict) else None
    return table if isinstance(table, dict) else None
