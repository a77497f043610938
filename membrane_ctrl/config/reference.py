"""What each key means: `docs/reference/configuration.md`, the JSON schema and `config explain`, all
made from the schema.

Range and default come from pydantic, the unit from the key's name, meaning and advice from the text
below the key.
"""

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema

from firmware_iface import driver_kind, drivers
from firmware_iface.roles import ROLES
from membrane_ctrl.config.attribute_texts import list_attribute_texts
from membrane_ctrl.config.schema import Config
from membrane_ctrl.config.toml_file import suggest_word
from membrane_ctrl.model.errors import InputError

_ADVICE = re.compile(r"(?<=[.;?])\s+(?=(?:Change|Leave|Lower|Raise|Set)\b)")
_UNITS = {
    "adu": "counts",
    "baud": "Bd",
    "bits": "bits",
    "bytes": "bytes",
    "cycles": "cycles",
    "day": "day",
    "days": "days",
    "db": "dB",
    "deg": "deg",
    "fraction": "1",
    "gb": "GB",
    "h": "h",
    "hz": "Hz",
    "k": "K",
    "khz": "kHz",
    "mb": "MB",
    "m": "m",
    "min": "min",
    "mm": "mm",
    "ms": "ms",
    "mw": "mW",
    "n": "N",
    "nm": "nm",
    "pa": "Pa",
    "percent": "%",
    "ppm": "ppm",
    "px": "px",
    "s": "s",
    "s2": "s2",
    "um": "µm",
}
_PAGE = """\
# Configuration

Made from the schema by `make generate`; do not edit.

The configuration is one TOML file in UTF-8. Omitted keys use their defaults; most benches need only `[devices]`.
`membrane-ctrl config init` writes a first file, `membrane-ctrl check` checks it, and
`membrane-ctrl config explain KEY` shows a part of this page.

An editor can complete and check keys. Write the schema beside the file with
`membrane-ctrl config schema > membrane-ctrl.schema.json`, and make `#:schema ./membrane-ctrl.schema.json` the file's
first line (taplo, or Even Better TOML in VS Code). The schema checks each key alone; `check` also compares keys
with each other and with the devices.

Relative file names start at the configuration's folder. Numbers have a decimal point. The default `none` means that
the key is absent."""  # noqa: E501


@dataclass(frozen=True, slots=True)
class Key:
    """A key of a table, as text; `unit` is empty for what is no quantity, `advice` states when to
    change it.
    """

    name: str
    unit: str
    range: str
    default: str
    meaning: str
    advice: str


@dataclass(frozen=True, slots=True)
class TableHelp:
    """A table and where it may stand; one of a device has the name of its driver, and of several
    equal `many`.
    """

    places: tuple[str, ...]
    driver: str
    many: bool
    meaning: str
    keys: tuple[Key, ...]

    @property
    def title(self) -> str:
        """How the table begins in the file, or each of its places."""
        headers = ", ".join(f"[[{place}]]" if self.many else f"[{place}]" for place in self.places)
        if not self.driver:
            return headers
        return f'{headers} driver = "{self.driver}"'


class _TomlSchema(GenerateJsonSchema):
    """The schema of TOML tables, each key with the text below its attribute.

    TOML has no null: an optional key is one that may be absent.
    """

    def model_schema(self, schema: Any) -> dict[str, Any]:
        table = super().model_schema(schema)
        section = schema["cls"]
        texts = list_attribute_texts(section)
        for name, field in section.model_fields.items():
            key = table.get("properties", {}).get(field.alias or name)
            if key is not None and field.description is None and name in texts:
                key["description"] = texts[name]
        return table

    def nullable_schema(self, schema: Any) -> dict[str, Any]:
        return self.generate_inner(schema["schema"])

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False


@cache
def json_schema(root: type[BaseModel] = Config) -> dict[str, Any]:
    """The JSON schema of a configuration file, or of a table's class, with texts. Treat it as
    constant.
    """
    schema = root.model_json_schema(schema_generator=_TomlSchema)
    chosen = set(re.findall(r'"\w+": "#/\$defs/(\w+)"', json.dumps(schema)))
    for name, table in [*schema.get("$defs", {}).items(), (root.__name__, schema)]:
        for field in table["properties"].values():
            if "description" in field:
                field["description"] = " ".join(field["description"].split())
            if field.get("default", 0) is None:
                del field["default"]
        # from a union, by the driver: the file must name it, although the class has a default
        if name in chosen:
            table["required"] = sorted({*table.get("required", ()), "driver"})
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


@cache
def list_tables() -> tuple[TableHelp, ...]:
    """Every table of a configuration in the order of the schema, each once. Raises KeyError for an
    unknown unit.
    """
    schema = json_schema()
    places: dict[str, list[tuple[str, Any]]] = {}
    for place, name, default in _walk_tables(schema, "", schema, Config().model_dump(mode="json")):
        places.setdefault(name, []).append((place, default))
    return tuple(_make_table(schema["$defs"][name], found) for name, found in places.items())


def _walk_tables(
    schema: Any, prefix: str, table: Any, defaults: Any
) -> Iterator[tuple[str, str, Any]]:
    """Yield each table below another, outermost first: its place, the name of its class, its
    defaults.
    """
    for key, field in table["properties"].items():
        place = f"{prefix}{key}"
        for name in re.findall(r'"\$ref": "#/\$defs/(\w+)"', json.dumps(field)):
            inner = defaults.get(key) if isinstance(defaults, dict) else None
            # below a table that is absent by default
            if inner is None and field.get("type") == "array":
                inner = []
            yield place, name, inner
            yield from _walk_tables(schema, f"{place}.", schema["$defs"][name], inner)


def _make_table(table: Any, found: list[tuple[str, Any]]) -> TableHelp:
    """The help of a table, from its part of the JSON schema and the places that have it."""
    defaults = next((default for _, default in found if isinstance(default, dict)), {})
    required = table.get("required", ())
    keys = []
    for name, field in table["properties"].items():
        # Another table, or the name of this one
        is_table = "$ref" in json.dumps({**field, "items": None})
        if is_table or (name == "driver" and "const" in field):
            continue
        # The docstring of a key: what it means, then when to change it
        meaning, *advice = _ADVICE.split(" ".join(field.get("description", "").split()), maxsplit=1)
        default = "required"
        if name not in required:
            default = _format_default(defaults.get(name, field.get("default")))
        keys.append(
            Key(name, unit_of(name), _describe_range(field), default, meaning, "".join(advice))
        )
    driver = table["properties"].get("driver", {}).get("const", "")
    places = tuple(dict.fromkeys(place for place, _ in found))
    many = any(isinstance(default, list) for _, default in found)
    return TableHelp(
        places, driver, many, " ".join(table.get("description", "").split()), tuple(keys)
    )


def find_explained(word: str) -> tuple[TableHelp, ...]:
    """The tables, or parts of them, that a word names: `loop`, `loop.kp_per_s`, `kp_per_s`,
    `devices.pump`, `ventus`.

    Raises InputError with the nearest names.
    """
    # A table has each of its places and its driver as names; a key those with its own behind them
    wanted, found, known = word.strip("[]` "), [], []
    for table in list_tables():
        prefixes = [name for name in (*table.places, table.driver) if name]
        names = {
            key.name: {key.name, *(f"{prefix}.{key.name}" for prefix in prefixes)}
            for key in table.keys
        }
        known += [*prefixes, *(name for key in names.values() for name in sorted(key))]
        if wanted in prefixes:
            keys = table.keys
        else:
            keys = tuple(key for key in table.keys if wanted in names[key.name])
        if keys or wanted in prefixes:
            found.append(replace(table, keys=keys))
    # A driver of another package is loaded only if it is asked for; then the nearest names
    found = found or _of_other_packages(wanted)
    if not found:
        inside = sorted({name for name in known if wanted and wanted in name}, key=len)[:3]
        if inside:
            near = f"did you mean {' or '.join(inside)}?"
        else:
            near = suggest_word(wanted, known, "see `config reference`")
        raise InputError(f"{word}: no such key or table; {near}")
    return tuple(found)


def _of_other_packages(word: str) -> list[TableHelp]:
    """Return the table of each installed driver of this name, whose package is loaded. Raises
    InputError.
    """
    found = []
    for kind in drivers.KINDS:
        if all(entry.name != word for entry in drivers.list_installed(kind.group)):
            continue
        try:
            driver = drivers.load_driver(word, kind)
        except ValueError as error:
            raise InputError(str(error)) from None
        places = [(place, None) for place in _places_of_driver(driver, kind)]
        try:
            table = _make_table(json_schema(driver.Settings), places)
        except Exception as error:  # whatever its settings are
            raise InputError(
                f"{word}: its settings cannot be shown: {type(error).__name__}: {error}"
            ) from error
        found.append(replace(table, driver="external"))
    return found


def _places_of_driver(driver: Any, kind: driver_kind.DriverKind) -> list[str]:
    """Return the tables in which a driver may be named."""
    if kind is drivers.CAMERAS:
        return ["devices.camera"]
    if kind is drivers.SCREENS:
        return ["devices.screen"]
    return [f"devices.{name}" for name, role in ROLES.items() if hasattr(driver, role.reads)]


def unit_of(name: str) -> str:
    """Return the unit at the end of a key's name: `um/s` of `flow_max_um_per_s`,
    empty without one.
    """
    words = name.split("_")
    if words[-1] not in _UNITS or (len(words) == 1 and words[0] not in ("baud", "bits")):
        return ""
    if words[-2:-1] != ["per"]:
        return _UNITS[words[-1]]
    return f"{_UNITS.get(words[-3], '1')}/{_UNITS[words[-1]]}"


def _describe_range(field: Any) -> str:
    """Return the valid values of a key, in words."""
    if "const" in field or "enum" in field:
        return ", ".join(str(value) for value in field.get("enum", [field.get("const")]))
    kind = field.get("type", "")
    if kind in ("number", "integer"):
        return _list_limits(field) + (", whole" if kind == "integer" else "")
    if kind == "array":
        parts = field.get("prefixItems")
        if parts:
            return f"{len(parts)} x ({_describe_range(parts[0])})"
        return f"list of {_describe_range(field['items'])}"
    if kind == "boolean":
        return "true, false"
    if "pattern" in field:
        return f"text like `{field['pattern']}`"
    if "$ref" in field or "oneOf" in field:
        return "a table"
    if field.get("format") == "path":
        return "a file"
    return "text"


def _list_limits(field: Any) -> str:
    """Return the limits of a number; a key of another package may lack one or both."""
    low = "any"
    if "exclusiveMinimum" in field:
        low = f"above {field['exclusiveMinimum']:g}"
    elif "minimum" in field:
        low = f"{field['minimum']:g}"
    high = "any"
    if "exclusiveMaximum" in field:
        high = f"below {field['exclusiveMaximum']:g}"
    elif "maximum" in field:
        high = f"{field['maximum']:g}"
    if low == "any" and high == "any":
        return "any number"
    return f"{low} .. {high}"


def _format_default(default: Any) -> str:
    """Return a default as in TOML; "none" for an absent key."""
    if isinstance(default, list) and default and isinstance(default[0], dict):
        return f"{len(default)} tables"
    if default is None:
        return "none"
    return json.dumps(default)


def make_reference_page() -> str:
    """docs/reference/configuration.md."""
    lines = _PAGE.splitlines()
    for table in list_tables():
        lines += ["", f"## {_make_heading(table)}", "", f"`{table.title}`: {table.meaning}"]
        if table.keys:
            lines += [
                "",
                "| key | unit | range | default | meaning | when to change it |",
                "|---|---|---|---|---|---|",
            ]
        for key in table.keys:
            cells = (
                f"`{key.name}`",
                key.unit,
                key.range,
                f"`{key.default}`",
                key.meaning,
                key.advice,
            )
            lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join([*lines, ""])


def _make_heading(table: TableHelp) -> str:
    """Return a heading of the page, which names no other table."""
    if not table.driver:
        return table.places[0]
    if sum(other.driver == table.driver for other in list_tables()) == 1:
        return table.driver
    devices = ", ".join(place.removeprefix("devices.") for place in table.places)
    return f"{table.driver}: {devices}"
