"""What differs between the geometries of two runs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.geometry.file import list_numbers

_NAMED_MOST = 4


def describe_change(before: OpticsConfig, now: OpticsConfig) -> str:
    """List the numbers of the geometry that differ, the first few with both values.

    Parameters
    ----------
    before, now : OpticsConfig
        The optics of two runs.

    Returns
    -------
    str
        Such as `geometry.a_mm from 2400 to 2401`; empty if none differs.
    """
    old = dict(_list_leaves("", list_numbers(before)))
    new = dict(_list_leaves("", list_numbers(now)))
    names = [name for name in {**new, **old} if old.get(name) != new.get(name)]
    parts = [
        f"{name} from {_format_value(old.get(name))} to {_format_value(new.get(name))}"
        for name in names[:_NAMED_MOST]
    ]
    if len(names) > _NAMED_MOST:
        parts.append(f"{len(names) - _NAMED_MOST} more")
    return ", ".join(parts)


def _list_leaves(prefix: str, tables: Mapping[str, Any]) -> Iterator[tuple[str, object]]:
    """The values of nested tables, each with its name, such as `geometry.a_mm`."""
    for key, value in tables.items():
        name = f"{prefix}.{key}" if prefix else key
        if isinstance(value, Mapping):
            yield from _list_leaves(name, value)
        elif value is not None:
            yield name, value


def _format_value(value: object) -> str:
    if value is None:
        return "none"
    if isinstance(value, int | float):
        return f"{value:g}"
    if isinstance(value, list | tuple) and len(value) <= 3:
        return f"({', '.join(_format_value(each) for each in value)})"
    return "other values" if isinstance(value, list | tuple) else str(value)
