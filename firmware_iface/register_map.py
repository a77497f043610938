"""The register map: loaded from `registers.toml`, checked, and used to turn registers into values
and back.
"""

import math
import struct
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

DEFAULT_PATH = Path(__file__).with_name("registers.toml")
SCHEMA = "membrane-registers/1"

# struct code and length in 16-bit words; big-endian structs give the big word first
_TYPES = {"u16": ("H", 1), "u32": ("I", 2), "i32": ("i", 2), "f32": ("f", 2)}
_RANGES = {"u16": (0, 2**16 - 1), "u32": (0, 2**32 - 1), "i32": (-(2**31) + 1, 2**31 - 1)}
# an integer has no NaN; the most negative one has no positive twin and is the customary substitute
I32_NO_VALUE = -(2**31)
_SUFFIXES = {"s": "_s", "um": "_um", "Pa": "_pa", "degC": "_c", "fraction": "_fraction", "1": ""}
_ADDRESSES = 2**16
_READ_MAX_WORDS = 125  # Modbus application protocol 1.1b3, function code 3
_REGISTER_KEYS = {
    "name",
    "address",
    "type",
    "unit",
    "counts_per_unit",
    "min",
    "max",
    "meaning",
    "since",
}


class RegisterMapError(ValueError):
    """The map file is unusable; the message names the register and the remedy."""


@dataclass(frozen=True, slots=True)
class Register:
    """One quantity of the device."""

    name: str  # ends in its unit
    address: int  # of its first word
    type: str  # "u16", "u32", "i32" or "f32"
    unit: str  # "1" for a pure number
    counts_per_unit: int  # value = raw / counts_per_unit
    minimum: float  # limit of a write, in the unit; infinite where nothing may be written
    maximum: float
    access: str  # "ro" or "rw"
    meaning: str  # one line for people
    since: int = 1  # the first map version that has it

    @property
    def words(self) -> int:
        """Its length in 16-bit registers."""
        return _TYPES[self.type][1]

    def allows(self, value: float) -> bool:
        """Whether a write of this value is within the limits; NaN is not."""
        return self.minimum <= value <= self.maximum

    def to_raw(self, value: float) -> float:
        """The number on the wire. Raises ValueError if the type cannot hold the value."""
        if self.type == "f32":
            return value
        counts = value * self.counts_per_unit
        low, high = _RANGES[self.type]
        if low <= counts <= high:  # False for NaN
            return round(counts)
        if math.isnan(value) and self.type == "i32":
            return I32_NO_VALUE
        raise ValueError(f"{self.name} = {value:g} {self.unit} does not fit its {self.type}")

    def to_value(self, raw: float) -> float:
        """The value in the register's unit; NaN for "no value"."""
        if self.type == "i32" and raw == I32_NO_VALUE:
            return math.nan
        return raw / self.counts_per_unit


@dataclass(frozen=True, slots=True)
class Block:
    """Registers without a gap between them, moved in one transaction."""

    name: str
    access: str
    meaning: str
    registers: tuple[Register, ...]
    layout: struct.Struct

    @property
    def address(self) -> int:
        """Of its first word."""
        return self.registers[0].address

    @property
    def count(self) -> int:
        """Its length in words."""
        return self.layout.size // 2

    def encode(self, values: Mapping[str, float]) -> list[int]:
        """Values by name to words, big word first. Raises ValueError
        if one does not fit its type.
        """
        raws = [register.to_raw(values[register.name]) for register in self.registers]
        return list(struct.unpack(f">{self.count}H", self.layout.pack(*raws)))

    def decode(self, words: Sequence[int]) -> dict[str, float]:
        """Words, big word first, to values by name. Raises ValueError if there are not `count` of
        them.
        """
        if len(words) != self.count:
            raise ValueError(f"block {self.name} has {self.count} registers, not {len(words)}")
        raws = self.layout.unpack(struct.pack(f">{self.count}H", *words))
        return {
            register.name: register.to_value(raw)
            for register, raw in zip(self.registers, raws, strict=True)
        }


@dataclass(frozen=True, slots=True)
class FaultBit:
    """One bit of `latched_faults`."""

    bit: int
    name: str
    meaning: str
    since: int = 1

    @property
    def mask(self) -> int:
        """The bit as a number."""
        return 1 << self.bit


@dataclass(frozen=True, slots=True)
class RegisterMap:
    """The whole map."""

    map_version: int
    device_kind: int
    blocks: tuple[Block, ...]
    faults: tuple[FaultBit, ...]

    def __iter__(self) -> Iterator[Register]:
        """All registers by address."""
        return (register for block in self.blocks for register in block.registers)

    def block(self, name: str) -> Block:
        """The block of that name. Raises KeyError."""
        return {block.name: block for block in self.blocks}[name]

    def register(self, name: str) -> Register:
        """The register of that name. Raises KeyError."""
        return {register.name: register for register in self}[name]

    def make_fault_mask(self, name: str) -> int:
        """The bit of the fault of that name, as a number. Raises KeyError."""
        return {fault.name: fault.mask for fault in self.faults}[name]

    def fault_since(self, name: str) -> int:
        """The first map version whose boards latch the fault of that name. Raises KeyError."""
        return {fault.name: fault.since for fault in self.faults}[name]

    def of_version(self, version: int) -> "RegisterMap":
        """The map of boards of an earlier version. Raises
        RegisterMapError for an unknown version.
        """
        if not 1 <= version <= self.map_version:
            raise RegisterMapError(f"map version {version} is none of 1..{self.map_version}")
        # Registers are only ever added at the end of a block (`_parse_block` checks it), so what an
        # earlier version has keeps its addresses, and blocks may be missing as a whole.
        had = {
            block: [register for register in block.registers if register.since <= version]
            for block in self.blocks
        }
        blocks = [
            make_block(block.name, block.access, block.meaning, found)
            for block, found in had.items()
            if found
        ]
        faults = tuple(fault for fault in self.faults if fault.since <= version)
        return RegisterMap(version, self.device_kind, tuple(blocks), faults)


def make_block(name: str, access: str, meaning: str, registers: Sequence[Register]) -> Block:
    """Make a block of consecutive registers.

    Parameters
    ----------
    name, access, meaning : str
        As in `registers.toml`.
    registers : sequence of Register
        In the order of their addresses, without gaps.
    """
    layout = struct.Struct(">" + "".join(_TYPES[register.type][0] for register in registers))
    return Block(name, access, meaning, tuple(registers), layout)


@cache
def load_default_map() -> RegisterMap:
    """The map that comes with this package."""
    return load_map(DEFAULT_PATH)


@cache
def list_known_maps() -> dict[int, RegisterMap]:
    """The maps by version: that of this package, and the earlier ones whose boards still run."""
    newest = load_default_map()
    return {version: newest.of_version(version) for version in range(1, newest.map_version + 1)}


def load_map(path: Path) -> RegisterMap:
    """Read and check a map.

    Raises RegisterMapError for a file that is not a map, and for overlaps, gaps, wrong order,
    unknown types or keys, missing limits and names that do not end in their unit.
    """
    try:
        return parse_map(tomllib.loads(path.read_text(encoding="utf-8")))
    except (OSError, tomllib.TOMLDecodeError, RegisterMapError) as error:
        raise RegisterMapError(f"{path}: {error}") from error


def parse_map(table: Mapping[str, Any]) -> RegisterMap:
    """A map from its TOML table. Raises RegisterMapError."""
    if table.get("schema") != SCHEMA:
        raise RegisterMapError(f'schema is {table.get("schema")!r}, expected "{SCHEMA}"')
    try:
        blocks = tuple(_parse_block(entry) for entry in table["block"])
        faults = tuple(
            FaultBit(entry["bit"], entry["name"], entry["meaning"], entry.get("since", 1))
            for entry in table["fault"]
        )
        found = RegisterMap(table["map_version"], table["device_kind"], blocks, faults)
    except KeyError as error:
        raise RegisterMapError(f"{error.args[0]} is missing") from error
    _check_order(found)
    return found


def _parse_block(entry: Mapping[str, Any]) -> Block:
    name, access = entry["name"], entry["access"]
    if access not in ("ro", "rw"):
        raise RegisterMapError(f'block {name}: access is {access!r}, expected "ro" or "rw"')
    registers = [_parse_register(register, access) for register in entry["registers"]]
    if not registers:
        raise RegisterMapError(f"block {name} has no registers")
    block = make_block(name, access, entry["meaning"], registers)
    if block.count > _READ_MAX_WORDS:
        raise RegisterMapError(
            f"block {name} has {block.count} words; one transaction carries {_READ_MAX_WORDS}"
        )
    # Without gaps, and in the order of the map's versions: an earlier version is a beginning of it.
    for before, after in pairwise(registers):
        _check_sequence(before, after)
        if after.address > before.address + before.words:
            raise RegisterMapError(f"block {name}: gap between {before.name} and {after.name}")
        if after.since < before.since:  # the earlier map would have a gap
            raise RegisterMapError(
                f"block {name}: {after.name} is older than {before.name} before it"
            )
    return block


def _parse_register(entry: Mapping[str, Any], access: str) -> Register:
    name = entry["name"]
    if unknown := set(entry) - _REGISTER_KEYS:
        raise RegisterMapError(f"{name}: unknown key {sorted(unknown)[0]}")
    for key in ("address", "type", "meaning"):
        if key not in entry:
            raise RegisterMapError(f"{name}: {key} is missing")
    register = Register(
        name=name,
        address=entry["address"],
        type=entry["type"],
        unit=entry.get("unit", "1"),
        counts_per_unit=entry.get("counts_per_unit", 1),
        minimum=entry.get("min", math.inf),
        maximum=entry.get("max", -math.inf),
        access=access,
        meaning=entry["meaning"],
        since=entry.get("since", 1),
    )
    _check_register(register)
    return register


def _check_register(register: Register) -> None:
    # A name ends in its unit, so that no reader of the registers can mistake it.
    name = register.name
    if register.type not in _TYPES:
        raise RegisterMapError(f"{name}: type {register.type!r} is none of {', '.join(_TYPES)}")
    if register.unit not in _SUFFIXES:
        raise RegisterMapError(f"{name}: unit {register.unit!r} is none of {', '.join(_SUFFIXES)}")
    if not name.endswith(_SUFFIXES[register.unit]):
        raise RegisterMapError(f"{name}: the name must end in {_SUFFIXES[register.unit]}")
    if not 0 <= register.address <= _ADDRESSES - register.words:
        raise RegisterMapError(
            f"{name}: address {register.address} is outside 0..{_ADDRESSES - register.words}"
        )
    if register.counts_per_unit <= 0 or (register.type == "f32" and register.counts_per_unit != 1):
        raise RegisterMapError(f"{name}: counts_per_unit must be above 0, and 1 for an f32")
    has_limits = register.minimum <= register.maximum
    if has_limits != (register.access == "rw"):
        raise RegisterMapError(f"{name}: a rw register needs min <= max, a ro one has no limits")
    if has_limits:
        try:
            register.to_raw(register.minimum), register.to_raw(register.maximum)
        except ValueError as error:
            raise RegisterMapError(f"{name}: a limit is out of its type: {error}") from error


def _check_order(found: RegisterMap) -> None:
    registers = list(found)
    for register in registers:
        if not 1 <= register.since <= found.map_version:
            raise RegisterMapError(
                f"{register.name}: since must be a map version, 1..{found.map_version}"
            )
    for before, after in pairwise(registers):
        _check_sequence(before, after)
    names = [register.name for register in registers]
    if twice := {name for name in names if names.count(name) > 1}:
        raise RegisterMapError(f"{sorted(twice)[0]} is there twice")
    bits = [fault.bit for fault in found.faults]
    if len(set(bits)) != len(bits) or not all(0 <= bit <= 15 for bit in bits):
        raise RegisterMapError("fault bits must be different and within 0..15")


def _check_sequence(before: Register, after: Register) -> None:
    if after.address < before.address:
        raise RegisterMapError(
            f"{after.name} (address {after.address}) comes after {before.name}: order them"
        )
    if after.address < before.address + before.words:
        raise RegisterMapError(f"{after.name} (address {after.address}) overlaps {before.name}")
