"""Reads the configuration of a run.

Of a damaged configuration, or one of another version, the valid parts are used.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from membrane_ctrl.config import toml_file
from membrane_ctrl.config.schema import Config
from membrane_ctrl.model import (
    errors,
    file_checksums,
    files,
)

_NAMED_MAX = 20


def keep_understood(tables: dict[str, Any]) -> tuple[Config, list[str]]:
    """Return a configuration without unknown keys and invalid values, and the names of those.

    An unknown key does not affect the others: they keep their values.
    """
    tables = _copy_value(tables)
    left_out: list[str] = []
    while True:
        try:
            return Config.model_validate(tables), left_out
        except ValidationError as error:
            # all at once: removing ten thousand keys one by one would validate as many times
            names = [_remove_key(tables, found["loc"]) for found in error.errors(include_url=False)]
        if not any(names):  # incompatible tables
            return Config(), [*left_out, "tables that do not go together"]
        left_out += filter(None, names)


def _remove_key(tables: dict[str, Any], location: Sequence[int | str]) -> str:
    """Delete the deepest existing key of an error's location; returns its name, or ""."""
    inside: Any = tables
    path: list[str] = []
    found: tuple[dict[str, Any], str] | None = None
    for part in location:
        # a location contains the tag of a union's member, the file does not
        if isinstance(inside, dict) and isinstance(part, str) and part in inside:
            found = inside, part
            path.append(part)
            inside = inside[part]
        elif isinstance(inside, list) and isinstance(part, int) and part < len(inside):
            inside = inside[part]
    if found is None:
        return ""
    del found[0][found[1]]
    return ".".join(path)


def _copy_value(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _copy_value(inner) for key, inner in value.items()}
    if not isinstance(value, list):
        return value
    return [_copy_value(inner) for inner in value]


def read_exact_config(folder: Path) -> Config:
    """`config.toml` as it was in use. Raises InputError if this version does not understand all
    of it.
    """
    return toml_file.load_toml(folder / "config.toml", Config, follow=False)


def read_config(folder: Path, notes: list[str]) -> Config:
    """Read `config.toml` of a run, as far as this version understands it.

    Never raises for the content: the record must be readable with a damaged or foreign
    configuration. `read_exact_config` is for a replay, which must not guess.

    Parameters
    ----------
    folder : Path
        Folder of the run.
    notes : list of str
        Gets a line for damage, and for keys that were left out or have their defaults.
    """
    path = folder / "config.toml"
    notes += _config_damage(path)
    try:
        tables = toml_file.read_toml(path, follow=False)
    except errors.InputError as error:
        notes.append(f"{error}; all defaults are used")
        return Config()
    try:
        return toml_file.parse_tables(tables, Config, "config.toml")
    except errors.InputError as error:
        config, left_out = keep_understood(tables)
        named = ", ".join(left_out[:_NAMED_MAX])
        if len(left_out) > _NAMED_MAX:
            named += f" and {len(left_out) - _NAMED_MAX} more"
        notes.append(f"{error}; omitted or at its default: {named}")
        return config


def _config_damage(path: Path) -> list[str]:
    try:
        text = files.read_text(path)
    except (OSError, ValueError):  # reported when it is read
        return []
    if not text:
        return ["config.toml: empty; all defaults are used"]
    right = file_checksums.is_comment_checksum_correct(text)
    if right:
        return []
    return ["config.toml: checksum mismatch (damaged or edited); its values are doubtful"]
