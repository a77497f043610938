"""The files generated from the register map are up to date and agree with it."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from firmware_iface import generate
from firmware_iface.register_map import load_default_map
from tests.support.machine_needs import needs


def test_generated_files_are_up_to_date() -> None:
    assert generate.main(["--check"]) == 0


def test_check_reports_a_stale_file_and_writes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    docs, header = tmp_path / "registers.md", tmp_path / "membrane_board.h"
    docs.write_text("old", encoding="utf-8")
    monkeypatch.setattr(generate, "DOCS_PATH", docs)
    monkeypatch.setattr(generate, "HEADER_PATH", header)
    assert generate.main(["--check"]) == 1
    assert docs.read_text(encoding="utf-8") == "old"
    assert not header.exists()
    assert "registers.md is out of date" in capsys.readouterr().err
    assert generate.main([]) == 0
    assert generate.main(["--check"]) == 0


@needs("cc")
def test_c_header_compiles_and_agrees_with_the_map(tmp_path: Path) -> None:
    registers = load_default_map()
    wanted = {f"{register.name.upper()}_ADDRESS": register.address for register in registers}
    wanted |= {f"BLOCK_{block.name.upper()}_WORDS": block.count for block in registers.blocks}
    wanted |= {f"FAULT_{fault.name.upper()}": fault.mask for fault in registers.faults}
    wanted |= {
        f"{register.name.upper()}_COUNTS_PER_UNIT": register.counts_per_unit
        for register in registers
        if register.counts_per_unit != 1
    }
    wanted |= {
        f"{register.name.upper()}_MAX_RAW": int(register.to_raw(register.maximum))
        for register in registers
        if register.access == "rw"
    }
    wanted |= {
        "MAP_VERSION": registers.map_version,
        "DEVICE_KIND": registers.device_kind,
        "I32_NO_VALUE": -(2**31),
    }
    prints = "\n".join(f'    printf("{name} %ld\\n", (long)MEMBRANE_{name});' for name in wanted)
    source = tmp_path / "main.c"
    source.write_text(
        f'#include <stdio.h>\n#include "membrane_board.h"\nint main(void) {{\n{prints}\n    '
        f"return 0;\n}}\n",
        encoding="utf-8",
    )
    program = tmp_path / "main"
    flags = [
        "-std=c89",
        "-Wall",
        "-Wextra",
        "-Werror",
        "-pedantic",
        f"-I{generate.HEADER_PATH.parent}",
    ]
    subprocess.run(
        ["cc", *flags, str(source), "-o", str(program)], check=True, capture_output=True, text=True
    )
    printed = subprocess.run([str(program)], check=True, capture_output=True, text=True).stdout
    assert {
        name: int(value) for name, value in (line.split() for line in printed.splitlines())
    } == wanted
