"""The configuration's TOML file: read with errors a person can act on, written with every default spelled out."""

from __future__ import annotations

import difflib
import tomllib
from pathlib import Path
from typing import Any, TypeVar, get_args

import tomli_w
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from membrane_ctrl.errors import InputError

Model = TypeVar("Model", bound=BaseModel)


def load(path: Path, model: type[Model]) -> Model:
    """Read and validate a TOML file.

    Parameters
    ----------
    path : Path
        The file.
    model : type
        What it must hold (`config.Config` for a run).

    Raises
    ------
    InputError
        One line that names the file, the field and what would be right.
    """
    tables = read_toml(path)
    optics = tables.get("optics")
    if isinstance(optics, dict):
        with_height_map(optics.get("geometry"), path)
    return parse(tables, model, str(path))


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a TOML file. Raises InputError naming the file (and the line, if it is not TOML)."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder, a TOML file is needed") from None
    except PermissionError:
        raise InputError(f"{path}: no permission to read it") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not valid TOML: {error}") from None


def with_height_map(geometry: Any, where: Path) -> None:
    """Put the numbers of `screen.height_map.file` in its place, in the tables of a geometry that came from `where`.

    Raises
    ------
    InputError
        If there is no such file, or if it holds anything but rows of numbers.
    """
    screen = geometry.get("screen") if isinstance(geometry, dict) else None
    table = screen.get("height_map") if isinstance(screen, dict) else None
    if not isinstance(table, dict) or "file" not in table:
        return
    field = f"{where}: geometry.screen.height_map.file"
    if "heights_mm" in table:
        raise InputError(f"{field}: give either the file or heights_mm")
    path = where.parent / str(table.pop("file"))
    try:
        lines = path.read_text(encoding="utf-8").replace(",", " ").splitlines()
        rows = [[float(word) for word in line.split("#")[0].split()] for line in lines]
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise InputError(f"{field}: {path}: {reason}") from None
    table["heights_mm"] = [row for row in rows if row]


def parse(tables: dict[str, Any], model: type[Model], where: str) -> Model:
    """Validate tables that came from `where`. Raises InputError like `load`."""
    try:
        return model.model_validate(tables)
    except ValidationError as error:
        raise InputError(f"{where}: {describe(error.errors()[0], model)}") from None


def prune(table: dict[str, Any], model: type[BaseModel], prefix: str = "") -> tuple[str, ...]:
    """Take out keys that are not known, so that a newer writer's sets are read; returns their names."""
    ignored: list[str] = []
    known = {(field.alias or name): field.annotation for name, field in model.model_fields.items()}
    for key in list(table):
        if key not in known:
            del table[key]
            ignored.append(prefix + key)
            continue
        nested = [t for t in (known[key], *get_args(known[key])) if isinstance(t, type) and issubclass(t, BaseModel)]
        inner = table[key] if isinstance(table[key], list) else [table[key]]
        for item in inner:
            if nested and isinstance(item, dict):
                ignored += prune(item, nested[0], f"{prefix}{key}.")
    return tuple(dict.fromkeys(ignored))


def dump(config: BaseModel) -> str:
    """TOML text of a configuration, every default written out; fields that are None are left out."""
    return tomli_w.dumps(config.model_dump(mode="json", exclude_none=True))


def describe(error: ErrorDetails, model: type[BaseModel]) -> str:
    """One line for a validation error: the field, what is wrong with it, and what would be right."""
    field = ".".join(str(part) for part in error["loc"])
    if error["type"] == "extra_forbidden":
        known = _fields_at(model, error["loc"][:-1])
        near = difflib.get_close_matches(str(error["loc"][-1]), known, n=1, cutoff=0.5)
        hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(known)}" if known else "remove it"
        return f"{field}: unknown key; {hint}"
    message = error["msg"].removeprefix("Value error, ")
    if error["type"] == "value_error":
        return f"{field}: {message}" if field else message
    value = error["input"]
    shown = f" (it is {value!r})" if isinstance(value, (int, float, str, bool)) else ""
    return f"{field}: {message[:1].lower()}{message[1:]}{shown}"


def _fields_at(model: type[BaseModel], location: tuple[int | str, ...]) -> list[str]:
    for part in location:
        field = model.model_fields.get(str(part))
        if field is None:
            return []
        candidates = [field.annotation, *getattr(field.annotation, "__args__", ())]
        nested = [c for c in candidates if isinstance(c, type) and issubclass(c, BaseModel)]
        if not nested:
            return []
        model = nested[0]
    return list(model.model_fields)
