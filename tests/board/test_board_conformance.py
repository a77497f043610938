"""The C firmware passes the conformance test: in memory, and as a program on a pseudo terminal and on TCP."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from firmware_iface.board_settings import record
from firmware_iface.conformance import Conformance, examine
from tests.board.build_board import built
from tests.board.virtual_board import SETTINGS, VirtualBoard, VirtualLink

_FINDINGS = 21


async def test_the_firmware_conforms(virtual_board: VirtualBoard) -> None:
    link = VirtualLink(virtual_board)
    findings = await Conformance(link, link.sleep).run()
    assert [(found.check, found.problem) for found in findings if found.problem] == []
    assert len(findings) == _FINDINGS


@pytest.fixture(scope="session")
def host_program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built("board", tmp_path_factory.mktemp("host"), "cc")


@pytest.fixture
def host_board(host_program: Path, tmp_path: Path) -> Iterator[dict[str, str]]:
    """The firmware as a program: where its line, its TCP port and its film are."""
    settings = tmp_path / "settings.bin"
    settings.write_bytes(record({**SETTINGS, "silence_us": 50_000}))
    with subprocess.Popen([str(host_program), str(settings)], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        words = process.stdout.readline().split()
        yield dict(zip(words[::2], words[1::2], strict=True))
        process.terminate()
        assert process.wait(5) == 0


@pytest.mark.real_time
async def test_the_host_program_conforms_on_both_lines(host_board: dict[str, str]) -> None:
    for url in (f"tcp://127.0.0.1:{host_board['tcp']}", f"rtu://{host_board['rtu']}?baud=115200&parity=N"):
        findings = await examine(url)
        assert [(found.check, found.problem) for found in findings if found.problem] == []
        assert len(findings) == _FINDINGS


def test_the_host_program_names_what_is_wrong(host_program: Path, tmp_path: Path) -> None:
    missing = tmp_path / "none.bin"
    found = subprocess.run([str(host_program), str(missing)], capture_output=True, text=True, check=False)
    assert (found.returncode, found.stdout) == (4, "")
    assert "none.bin: No such file" in found.stderr
