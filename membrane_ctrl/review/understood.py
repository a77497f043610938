"""A configuration of another version, or a damaged one: what this version understands of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pydantic import ValidationError

from membrane_ctrl.config import Config


def understood(tables: dict[str, Any]) -> tuple[Config, list[str]]:
    """A configuration without the keys that are not known or whose values cannot be, and the names of those.

    A key that this version does not know says nothing about its neighbours: they stay as they were run.
    """
    tables = _copied(tables)
    left_out: list[str] = []
    while True:
        try:
            return Config.model_validate(tables), left_out
        except ValidationError as error:
            # all at once: of ten thousand keys each alone would take as many looks at all of them
            names = [_take_out(tables, found["loc"]) for found in error.errors(include_url=False)]
        if not any(names):  # tables that do not go together
            return Config(), [*left_out, "tables that do not go together"]
        left_out += filter(None, names)


def _take_out(tables: dict[str, Any], location: Sequence[int | str]) -> str:
    """Delete the deepest key of an error's location that is there; its name, "" if none is."""
    inside: Any = tables
    path: list[str] = []
    found: tuple[dict[str, Any], str] | None = None
    for part in location:
        # the tag of a union's member stands in a location, and not in the file
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


def _copied(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _copied(inner) for key, inner in value.items()}
    return [_copied(inner) for inner in value] if isinstance(value, list) else value
