"""Writes the files generated from the register map: `docs/reference/registers.md`,
`membrane_board.h` and the board's table.

Run `python -m firmware_iface.generate` after changing the map; with `--check` it writes nothing and
exits with 1 if a file is out of date.
"""

import argparse
import sys
from pathlib import Path

from firmware_iface.register_map import I32_NO_VALUE, Block, Register, RegisterMap, load_default_map

_HERE = Path(__file__).resolve().parent
HEADER_PATH = _HERE / "membrane_board.h"
TABLE_PATH = _HERE / "board" / "core" / "register_table.h"
DOCS_PATH = _HERE.parent / "docs" / "reference" / "registers.md"
_SOURCE = "firmware_iface/registers.toml with python -m firmware_iface.generate"


def make_markdown(registers: RegisterMap) -> str:
    """The map as a page for people."""
    lines = [
        "# Registers of the membrane pump board",
        "",
        f"Generated from {_SOURCE}; do not edit.",
        "",
        f"Map version {registers.map_version}, device kind {registers.device_kind} "
        f"(0x{registers.device_kind:04X}).",
        "`since` is the first map version that has a register; a board of an earlier version "
        "has the map without it.",
        "",
        "Modbus holding registers, function codes 3 (read), 6 and 16 (write) and 23 (write, "
        "then read); addresses",
        "count from 0; 32-bit values have the big word first. value = raw / counts per unit.",
        f"An `i32` of {I32_NO_VALUE} means that there is no value. A write outside the "
        "limits is answered with",
        "exception 3 and changes nothing; one to a read-only or unknown address, or to half "
        "a value, with 2.",
        "From map version 2 on, a part of a block is refused with 2, and a write without the "
        "active claim with 6",
        "while a program holds the board, with 3 otherwise ([firmware](firmware.md#claim)).",
    ]
    for block in registers.blocks:
        lines += ["", *_markdown_block(block)]
    lines += ["", "## Faults", "", "Bits of `latched_faults` and `clear_faults`.", ""]
    lines += ["| bit | name | since | meaning |", "|---|---|---|---|"]
    lines += [
        f"| {fault.bit} | `{fault.name}` | {fault.since} | {fault.meaning} |"
        for fault in registers.faults
    ]
    return "\n".join(lines) + "\n"


def _markdown_block(block: Block) -> list[str]:
    last = block.address + block.count - 1
    return [
        f"## {block.name}: {block.address}..{last}, {block.access}",
        "",
        block.meaning,
        "",
        "| address | name | type | unit | counts per unit | limits | access | since | meaning |",
        "|---|---|---|---|---|---|---|---|---|",
        *(_markdown_row(register) for register in block.registers),
    ]


def _markdown_row(register: Register) -> str:
    limits = ""
    if register.access == "rw":
        limits = f"{register.minimum:g} .. {register.maximum:g}"
    return (
        f"| {register.address} | `{register.name}` | {register.type} | {register.unit} | "
        f"{register.counts_per_unit} | {limits} | {register.access} | {register.since} | "
        f"{register.meaning} |"
    )


def c_header(registers: RegisterMap) -> str:
    """The map as a C header (C89 and later, preprocessor only) for authors of firmware."""
    lines = [
        f"/* Registers of the membrane pump board. Generated from {_SOURCE}; do not edit.",
        " * Modbus holding registers, addresses from 0, big word first. value = raw / "
        "COUNTS_PER_UNIT. */",
        "#ifndef MEMBRANE_BOARD_H",
        "#define MEMBRANE_BOARD_H",
        "",
        _format_define("MAP_VERSION", f"{registers.map_version}u"),
        _format_define("DEVICE_KIND", f"0x{registers.device_kind:04X}u"),
        _format_define("I32_NO_VALUE", f"({I32_NO_VALUE + 1} - 1)", "there is no value"),
    ]
    for block in registers.blocks:
        lines += ["", f"/* {block.name} ({block.access}): {block.meaning} */"]
        lines += [_format_define(f"BLOCK_{block.name}_ADDRESS", f"{block.address}u")]
        lines += [_format_define(f"BLOCK_{block.name}_WORDS", f"{block.count}u")]
        for register in block.registers:
            lines += _c_register(register)
    lines += ["", "/* bits of latched_faults and clear_faults */"]
    lines += [
        _format_define(f"FAULT_{fault.name}", f"0x{fault.mask:04X}u", fault.meaning)
        for fault in registers.faults
    ]
    return "\n".join([*lines, "", "#endif"]) + "\n"


def c_table(registers: RegisterMap) -> str:
    """The map as tables in C11: the blocks, and the limits of every
    register that can be written.
    """
    limited = [register for register in registers if register.access == "rw"]
    return "\n".join(
        [
            f"/* Blocks of registers and limits of writes. Generated from {_SOURCE}; do not "
            "edit. */",
            "#ifndef MEMBRANE_REGISTER_TABLE_H",
            "#define MEMBRANE_REGISTER_TABLE_H",
            "",
            "#include <stdbool.h>",
            "#include <stdint.h>",
            "",
            "struct register_block {",
            "    uint32_t address;",
            "    uint32_t words;",
            "    bool writable;",
            "};",
            "",
            "struct register_limits {",
            "    uint32_t address;",
            "    uint32_t words;",
            "    uint32_t low;",
            "    uint32_t high;",
            "};",
            "",
            f"#define REGISTER_BLOCKS_COUNT {len(registers.blocks)}u",
            f"#define REGISTER_LIMITS_COUNT {len(limited)}u",
            "",
            "static const struct register_block REGISTER_BLOCKS[REGISTER_BLOCKS_COUNT] = {",
            *(
                (
                    f"    {{{block.address}u, {block.count}u, "
                    f"{str(block.access == 'rw').lower()}}}, /* {block.name} */"
                )
                for block in registers.blocks
            ),
            "};",
            "",
            "static const struct register_limits REGISTER_LIMITS[REGISTER_LIMITS_COUNT] = {",
            *(
                f"    {{{register.address}u, {register.words}u, "
                f"{register.to_raw(register.minimum):.0f}u, "
                f"{register.to_raw(register.maximum):.0f}u}}, /* {register.name} */"
                for register in limited
            ),
            "};",
            "",
            "#endif",
            "",
        ]
    )


def _c_register(register: Register) -> list[str]:
    lines = [
        _format_define(
            f"{register.name}_ADDRESS",
            f"{register.address}u",
            f"{register.type}: {register.meaning}",
        )
    ]
    if register.counts_per_unit != 1:
        lines.append(
            _format_define(f"{register.name}_COUNTS_PER_UNIT", str(register.counts_per_unit))
        )
    if register.access == "rw":
        lines.append(
            _format_define(f"{register.name}_MIN_RAW", f"{register.to_raw(register.minimum):.0f}")
        )
        lines.append(
            _format_define(f"{register.name}_MAX_RAW", f"{register.to_raw(register.maximum):.0f}")
        )
    return lines


def _format_define(name: str, value: str, comment: str = "") -> str:
    return f"#define MEMBRANE_{name.upper()} {value}" + (f" /* {comment} */" if comment else "")


def main(arguments: list[str] | None = None) -> int:
    """Write the files, or report which are out of date; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m firmware_iface.generate", description=__doc__)
    parser.add_argument(
        "--check", action="store_true", help="write nothing; exit with 1 when a file is out of date"
    )
    check = parser.parse_args(arguments).check
    registers = load_default_map()
    stale = False
    files = {
        DOCS_PATH: make_markdown(registers),
        HEADER_PATH: c_header(registers),
        TABLE_PATH: c_table(registers),
    }
    for path, text in files.items():
        if path.exists() and path.read_text(encoding="utf-8") == text:
            continue
        stale = True
        if check:
            print(f"{path} is out of date: run python -m firmware_iface.generate", file=sys.stderr)
        else:
            path.write_text(text, encoding="utf-8")
    return 1 if check and stale else 0


if __name__ == "__main__":
    sys.exit(main())
