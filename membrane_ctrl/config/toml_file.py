"""The configuration's TOML file: read with actionable errors, written with every default spelled
out.
"""

import difflib
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar, get_args

import tomli_w
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from firmware_iface.settings import MODBUS_URL_PATTERN
from membrane_ctrl.model.errors import InputError, os_reason
from membrane_ctrl.model.files import read_text

Model = TypeVar("Model", bound=BaseModel)
# A configuration with every default is 10 kB, a height map of 100 x 100 nodes 80 kB.
_BYTES_MAX = 1_000_000
# The parser's time and memory grow with the square of a dotted key's parts. Our keys have at most
# four.
_PARTS_MAX = 50
_QUOTED_PART = re.compile(r"""["']\s*\.""")


def load_toml(path: str | Path, model: type[Model], follow: bool = True) -> Model:
    """Read and validate a TOML file.

    Parameters
    ----------
    path : str or Path
        The file.
    model : type
        The schema.
    follow : bool
        False in a folder from an untrusted source (`model.files`).

    Returns
    -------
    Model

    Raises
    ------
    InputError
        With one line that names the file, the field and a valid value.
    """
    path = Path(path)
    return _parse_model(read_toml(path, follow), path, model, follow)


def load_toml_text(text: str, path: Path, model: type[Model]) -> Model:
    """As `load_toml`, of a text that is to become a file.

    Parameters
    ----------
    text : str
        TOML.
    path : Path
        The file, for messages; a height map that the text names is read beside it.
    model : type of BaseModel
        The schema.

    Raises
    ------
    InputError
        With one line that names the file, the field and a valid value.
    """
    return _parse_model(parse_toml(text, path), path, model, follow=True)


def _parse_model(tables: dict[str, Any], path: Path, model: type[Model], follow: bool) -> Model:
    optics = tables.get("optics")
    if isinstance(optics, dict):
        with_height_map(optics.get("geometry"), path, follow)
    return parse_tables(tables, model, str(path))


def read_toml(path: Path, follow: bool = True) -> dict[str, Any]:
    """Read the tables of a TOML file, without a schema.

    Parameters
    ----------
    path : Path
        UTF-8, at most 1 MB.
    follow : bool
        Whether it may be a symbolic link; not in a folder that comes from elsewhere.

    Raises
    ------
    InputError
        Names the file, and the line if it is not TOML.
    """
    try:
        text = read_text(path, _BYTES_MAX, follow=follow)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder, not a TOML file") from None
    except PermissionError:
        raise InputError(f"{path}: no permission to read it") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({os_reason(error)})") from None
    except UnicodeDecodeError:
        raise InputError(
            f"{path}: not valid TOML: not UTF-8 text (UTF-16, perhaps); save it as UTF-8"
        ) from None
    return parse_toml(text, path)


def parse_toml(text: str, path: Path) -> dict[str, Any]:
    """Parse the tables of a text, without a schema.

    Parameters
    ----------
    text : str
        TOML; a byte order mark in front is ignored.
    path : Path
        The file that it comes from, for messages.

    Raises
    ------
    InputError
        As for `read_toml`; also for a key of very many parts, which are slow to parse.
    """
    text = text.removeprefix("\ufeff")  # as some editors begin a file
    if any(map(_has_too_many_parts, text.splitlines())):
        raise InputError(f"{path}: not valid TOML: a key of more than {_PARTS_MAX} parts")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise InputError(f"{path}: not valid TOML: nested too deep") from None
    except ValueError as error:  # of TOML, of a number with thousands of digits
        raise InputError(f"{path}: not valid TOML: {_describe_cause(str(error), text)}") from None


def _describe_cause(message: str, text: str) -> str:
    """Return the parser's message, with the usual cause for two that do not name it: tomllib has no
    codes, so that the line of the file itself decides.
    """
    found = re.search(r"at line (\d+)", message)
    if not found:
        return message
    lines = [line.strip() for line in text.split("\n")]
    at = int(found[1]) - 1
    line = lines[at]
    if number := re.search(r"=\s*([-+]?\d+),(\d+)\s*(#|$)", line):
        return f"{message}: a number has a decimal point; write {number[1]}.{number[2]}"
    if _is_repeated(lines, at):
        return f"{message}: {line} comes twice"
    return message


def _is_repeated(lines: list[str], at: int) -> bool:
    """Whether a line's table was begun before, or its key was set before in the same table."""
    line = lines[at]
    if line.startswith("["):
        return line in lines[:at]
    begins = [number for number, other in enumerate(lines[:at]) if other.startswith("[")]
    table = lines[max(begins, default=-1) + 1 : at]
    key = line.partition("=")[0].strip()
    return any(other.partition("=")[0].strip() == key for other in table)


def _has_too_many_parts(line: str) -> bool:
    """Whether a line may hold such a key, i.e. too many dots between commas (only quoted keys
    contain commas).
    """
    if line.count(".") <= _PARTS_MAX or line.lstrip().startswith("#"):
        return False
    dots = max(piece.count(".") for piece in line.split(","))
    return dots > _PARTS_MAX or len(_QUOTED_PART.findall(line)) > _PARTS_MAX


def with_height_map(geometry: Any, where: Path, follow: bool = True) -> None:
    """Replace `screen.height_map.file` by its numbers, in place.

    Parameters
    ----------
    geometry : object
        The tables of a geometry as parsed; whatever else it is stays, and is judged by the schema.
    where : Path
        The file that the tables come from: the name of the height map is relative to its folder.
    follow : bool
        Whether links, and files in other folders, may be read; not in a folder that comes from
        elsewhere.

    Raises
    ------
    InputError
        The file is missing, or holds anything but rows of numbers (mm).
    """
    # Nothing to do without a height map that names a file.
    screen = None
    if isinstance(geometry, dict):
        screen = geometry.get("screen")
    table = screen.get("height_map") if isinstance(screen, dict) else None
    if not isinstance(table, dict) or "file" not in table:
        return
    field = f"{where}: geometry.screen.height_map.file"
    if "heights_mm" in table:
        raise InputError(f"{field}: give either the file or heights_mm")
    # The file is named relative to the one that names it.
    path = where.parent / str(table.pop("file"))
    if not follow and path.parent != where.parent:
        raise InputError(f"{field}: {path}: not beside {where.name}")
    try:
        lines = read_text(path, follow=follow).replace(",", " ").splitlines()
        rows = [[float(word) for word in line.split("#")[0].split()] for line in lines]
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise InputError(f"{field}: {path}: {reason}") from None
    table["heights_mm"] = [row for row in rows if row]


def parse_tables(tables: dict[str, Any], model: type[Model], where: str) -> Model:
    """Validate tables by a schema.

    Parameters
    ----------
    tables : dict
        As parsed; a request of the control port comes in the same form.
    model : type of BaseModel
        The schema.
    where : str
        The file or the request, for the message.

    Raises
    ------
    InputError
        With one line that names the field and a valid value: of several errors the one that helps
        most.
    """
    try:
        return model.model_validate(tables)
    except ValidationError as error:
        raise InputError(
            f"{where}: {describe_error(_choose_error(error.errors()), model)}"
        ) from None


def prune_unknown_keys(
    table: dict[str, Any], model: type[BaseModel], prefix: str = ""
) -> tuple[str, ...]:
    """Remove unknown keys from a table, so that sets of newer versions can be read.

    Parameters
    ----------
    table : dict of Any
        Is changed.
    model : type
        The schema.
    prefix : str
        Of the returned names.

    Returns
    -------
    tuple of str
        Names of the removed keys.
    """
    ignored: list[str] = []
    known = {(field.alias or name): field.annotation for name, field in model.model_fields.items()}
    for key in list(table):
        if key not in known:
            del table[key]
            ignored.append(prefix + key)
            continue
        # Tables below this key are of the model that its annotation names.
        nested = [
            t
            for t in (known[key], *get_args(known[key]))
            if isinstance(t, type) and issubclass(t, BaseModel)
        ]
        inner = table[key] if isinstance(table[key], list) else [table[key]]
        for item in inner:
            if nested and isinstance(item, dict):
                ignored += prune_unknown_keys(item, nested[0], f"{prefix}{key}.")
    return tuple(dict.fromkeys(ignored))


def dump_toml(config: BaseModel) -> str:
    """TOML text of a configuration with every default; omits fields that are None."""
    return tomli_w.dumps(config.model_dump(mode="json", exclude_none=True))


def describe_error(error: ErrorDetails, model: type[BaseModel]) -> str:
    """One line for a validation error: the field, the problem and the remedy.

    Parameters
    ----------
    error : ErrorDetails
        One error of pydantic. Its type decides, its text is only shown.
    model : type of BaseModel
        The schema, for the keys and drivers that are known.
    """
    path, parent = _walk_location(model, error["loc"])
    field = ".".join(str(part) for part in path)
    kind = error["type"]
    fields = {} if parent is None else parent.model_fields
    # An unknown key: a similar one, or the table in which it belongs
    if kind == "extra_forbidden":
        key = str(error["loc"][-1])
        home = next(_find_tables_with_key(model, key), "")
        otherwise = home and f"it belongs in [{home}]"
        return f"{field}: unknown key; {suggest_word(key, [*fields], otherwise)}"
    inner = []
    if path and path[-1] in fields:
        inner = list_sections(fields[path[-1]].annotation)
    # An unknown driver: the known ones
    if kind.startswith("union_tag"):
        choices = _sections_at(model, path)
        tag, known = (
            str(error["ctx"].get("tag", "")),
            [str(tag) for section in choices for tag in list_driver_names(section)],
        )
        return (
            f"{field}.driver: {f'{tag!r} is not known here' if tag else 'missing'}; "
            f"{suggest_word(tag, known)}"
        )
    # Whatever our own checks or pydantic state, with the field before it
    message = error["msg"].removeprefix("Value error, ").partition(" for <class")[0]
    if kind == "value_error":  # some begin with the key
        if not field:
            return message
        join = "." if re.match(r"[a-z_0-9]+: ", message) else ": "
        return f"{field}{join}{message}"
    # Forms that a person writes differently in TOML
    if kind == "missing":
        return f"{field}: missing; it has no default"
    if kind in ("dict_type", "model_type"):
        if not field:
            return "input should be an object"
        return f"{field}: write a table, [{field}] and its keys below"
    if kind == "tuple_type":
        return f"{field}: write a list, " + (
            f"[[{field}]] and its keys below" if inner else "in square brackets"
        )
    if kind == "string_pattern_mismatch" and error["ctx"]["pattern"] == MODBUS_URL_PATTERN:
        return (
            f"{field}: {error['input']!r}: expected tcp://HOST:PORT or "
            "rtu:///dev/ttyUSB0?baud=115200"
        )
    # All else: pydantic's message with the value
    value = error["input"]
    shown = ""
    if isinstance(value, (int, float, str, bool)):
        shown = f" (it is {value!r})"
    return f"{field}: {message[:1].lower()}{message[1:]}{shown}"


def suggest_word(word: str, known: list[str], otherwise: str = "") -> str:
    """What a person may have meant by a word that is not known.

    Parameters
    ----------
    word : str
        As written.
    known : list of str
        The words that count.
    otherwise : str
        What to suggest if none is similar; empty: all that are known.
    """
    near = difflib.get_close_matches(word, known, n=1, cutoff=0.5)
    if near:
        return f"did you mean {near[0]}?"
    return otherwise or (f"known: {', '.join(known)}" if known else "remove it")


def _find_tables_with_key(model: type[BaseModel], key: str, prefix: str = "") -> Iterator[str]:
    """Yield the tables that have a key."""
    for name, field in model.model_fields.items():
        for section in list_sections(field.annotation):
            if key in section.model_fields:
                yield f"{prefix}{name}"
            yield from _find_tables_with_key(section, key, f"{prefix}{name}.")


def _choose_error(errors: list[ErrorDetails]) -> ErrorDetails:
    """The most helpful error: an unknown key is often a misspelling of one reported missing."""
    misspelt = [error for error in errors if error["type"] == "extra_forbidden"]
    if misspelt and errors[0]["type"] == "missing":
        return misspelt[0]
    return errors[0]


def _walk_location(
    model: type[BaseModel], location: tuple[int | str, ...]
) -> tuple[list[int | str], type[BaseModel] | None]:
    """Return the path of a key as in the file, and its section (None if unknown).

    In `location`, the tag of a union's member (`driver = "ventus"`) stands between the table and
    its key.
    """
    path: list[int | str] = []
    inside: type[BaseModel] | None = model
    members: list[type[BaseModel]] = []
    for place, part in enumerate(location):
        last = place + 1 == len(location)
        if tagged := [m for m in members if part in list_driver_names(m)]:
            inside, members = tagged[0], []
            continue
        path.append(part)
        if last or isinstance(part, int):
            continue
        field = None if inside is None else inside.model_fields.get(part)
        members = [] if field is None else list_sections(field.annotation)
        inside = members[0] if members else None
    return path, inside


def _sections_at(model: type[BaseModel], path: list[int | str]) -> list[type[BaseModel]]:
    """Return the sections that may stand at a path as in the file;
    of a list those of its entries.
    """
    found: list[type[BaseModel]] = [model]
    for name in path:
        if isinstance(name, int):
            continue
        fields = [section.model_fields[name] for section in found if name in section.model_fields]
        found = [inner for field in fields for inner in list_sections(field.annotation)]
    return found


def list_sections(annotation: Any) -> list[type[BaseModel]]:
    """Return all sections that a field may hold."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [section for inner in get_args(annotation) for section in list_sections(inner)]


def list_driver_names(section: type[BaseModel]) -> tuple[Any, ...]:
    """Return the values of `driver` that select this section."""
    driver = section.model_fields.get("driver")
    if driver is None:
        return ()
    return get_args(driver.annotation)
