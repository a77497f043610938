"""A copy of the product's source in which one fact is changed, and programs that run from it."""

from __future__ import annotations

import ast
import difflib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[3]
PATIENCE_S = 1200.0  # of a busy machine
INTERRUPTED = 130  # exit code
PACKAGES = ("membrane_ctrl", "firmware_iface", "tuning")


@dataclass(frozen=True, slots=True)
class ChangedSource:
    """A folder with the packages of the product.

    Attributes
    ----------
    folder : Path
        Parent of the packages.
    """

    folder: Path

    @classmethod
    def copy_to(cls, folder: Path) -> ChangedSource:
        """Copy the packages, without anything compiled."""
        for name in PACKAGES:
            shutil.copytree(
                ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__")
            )
        return cls(folder)

    def copy_more(self, *names: str) -> None:
        """Copy further folders of the repository: tests, or documents that programs write."""
        for name in names:
            shutil.copytree(
                ROOT / name, self.folder / name, ignore=shutil.ignore_patterns("__pycache__")
            )

    def add_field(self, owner: str, text: str, before: str = "") -> None:
        """Add a field or a property to a class.

        Parameters
        ----------
        owner : str
            Name of the class, of which the packages have one.
        text : str
            Lines of the field, without indentation.
        before : str
            The field that follows it; without one it is the last.
        """

        def owns_fields(node: ast.AST) -> bool:
            return isinstance(node, ast.ClassDef) and node.name == owner

        file, found = self._find_node(f"class {owner}", owns_fields)
        assert isinstance(found, ast.ClassDef)
        indentation = " " * found.body[0].col_offset
        lines = "".join(f"{indentation}{line}\n" if line else "\n" for line in text.splitlines())
        if not before:
            end_line = found.body[-1].end_lineno
            assert end_line is not None
            _insert(file, end_line + 1, 0, lines)
            return
        (line,) = (
            node.lineno
            for node in found.body
            if isinstance(node, ast.AnnAssign) and ast.unparse(node.target) == before
        )
        _insert(file, line, 0, lines)

    def add_argument(self, called: str, beside: str, text: str) -> None:
        """Add an argument to the one call of `called` that has the keyword argument `beside=...`,
        in front of that.
        """

        def passes_beside(node: ast.AST) -> bool:
            return (
                isinstance(node, ast.Call)
                and ast.unparse(node.func).split(".")[-1] == called
                and any(keyword.arg == beside for keyword in node.keywords)
            )

        file, found = self._find_node(f"{called}(", passes_beside)
        assert isinstance(found, ast.Call)
        (keyword,) = (each for each in found.keywords if each.arg == beside)
        indentation = " " * keyword.col_offset
        _insert(file, keyword.lineno, keyword.col_offset, f"{text},\n{indentation}")

    def add_row(self, rows_of: str, text: str) -> None:
        """Add the first row to the one table with the annotation `tuple[rows_of, ...]`."""

        def is_table(node: ast.AST) -> bool:
            return (
                isinstance(node, ast.AnnAssign)
                and ast.unparse(node.annotation) == f"tuple[{rows_of}, ...]"
                and isinstance(node.value, ast.Tuple)
            )

        file, found = self._find_node(f"tuple[{rows_of}, ...]", is_table)
        assert isinstance(found, ast.AnnAssign)
        assert isinstance(found.value, ast.Tuple)
        row = found.value.elts[0]
        _insert(file, row.lineno, row.col_offset, f"{text.strip()},\n{' ' * row.col_offset}")

    def set_constant(self, name: str, value: int) -> None:
        """Give the one constant of this name another value."""

        def is_constant(node: ast.AST) -> bool:
            return isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == name

        file, found = self._find_node(f"{name} = ", is_constant)
        assert isinstance(found, ast.Assign)
        literal = found.value
        assert isinstance(literal, ast.Constant)
        assert literal.end_col_offset is not None
        length = literal.end_col_offset - literal.col_offset
        _insert(file, literal.lineno, literal.col_offset, str(value), replaced=length)

    def _find_node(
        self, contained: str, condition: Callable[[ast.AST], bool]
    ) -> tuple[Path, ast.AST]:
        """The one node of the packages that fulfils a condition, and its module, whose text
        contains the text `contained`.
        """
        found = []
        for file in self._modules():
            text = file.read_text(encoding="utf-8")
            if contained in text:
                found += [(file, node) for node in ast.walk(ast.parse(text)) if condition(node)]
        assert len(found) == 1, f"{contained!r}: {len(found)} places"
        return found[0]

    def _modules(self) -> list[Path]:
        """All modules of the packages."""
        return [
            file for package in PACKAGES for file in sorted((self.folder / package).rglob("*.py"))
        ]

    def count_places(self) -> int:
        """Return the number of places at which the packages differ from the repository's: runs of
        changed lines.
        """
        count = 0
        for file in self._modules():
            original = ROOT / file.relative_to(self.folder)
            matcher = difflib.SequenceMatcher(
                None,
                original.read_text(encoding="utf-8").splitlines(),
                file.read_text(encoding="utf-8").splitlines(),
                autojunk=False,
            )
            count += sum(tag != "equal" for tag, *_ in matcher.get_opcodes())
        return count

    def run_python(self, *words: object) -> str:
        """Run the interpreter on the changed source; returns its standard output. Fails unless it
        ends with 0.
        """
        command = [sys.executable, *(str(word) for word in words)]
        done = subprocess.run(
            command,
            cwd=self.folder,
            env=self._make_environment(),
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
        return done.stdout

    def run_program(self, *words: object) -> str:
        """Run `membrane-ctrl` of the changed source, as `run_python`."""
        return self.run_python("-m", "membrane_ctrl", *words)

    def hold_until(
        self,
        happened: Callable[[list[dict[str, Any]]], bool],
        logs: Path,
        name: str,
        *words: object,
        more_s: float,
    ) -> Path:
        """Hold the twin, for `more_s` seconds after its recorded events fulfil a condition: a slow
        machine takes longer.

        Parameters
        ----------
        happened : callable
            Whether these events are enough.
        logs : Path
            Folder of the runs.
        name : str
            Of the run.
        *words : object
            Further arguments of `hold`.
        more_s : float
            Time from then to the interrupt.

        Returns
        -------
        Path
            Folder of the run.
        """
        printed = self.folder / f"{name}.txt"
        command = [sys.executable, "-m", "membrane_ctrl", "hold", "--twin"]
        command += map(str, ("--logs", logs, "--name", name, *words))
        with printed.open("wb") as output:
            process = subprocess.Popen(
                command,
                cwd=self.folder,
                env=self._make_environment(),
                stdout=output,
                stderr=subprocess.STDOUT,
            )
        try:
            give_up_s = time.monotonic() + PATIENCE_S
            while not happened(_read_events(logs, name)):
                assert time.monotonic() < give_up_s, printed.read_text()[-2000:]
                assert process.poll() is None, printed.read_text()[-2000:]
                time.sleep(0.5)
            time.sleep(more_s)
            process.send_signal(signal.SIGINT)
            assert process.wait(PATIENCE_S) == INTERRUPTED, printed.read_text()[-2000:]
        finally:
            process.kill()
            process.wait()
        (run,) = logs.glob(f"*-{name}")
        return run

    def _make_environment(self) -> dict[str, str]:
        """Environment in which the changed source is imported."""
        environment = os.environ | {"PYTHONPATH": str(self.folder)}
        environment.pop("NUMBA_CACHE_DIR", None)  # compiled code stays in the copy
        return environment


def _insert(file: Path, line: int, byte: int, text: str, replaced: int = 0) -> None:
    """Insert a text at a byte of a line (from 1), in place of `replaced` bytes."""
    lines = file.read_bytes().splitlines(keepends=True)
    start = sum(len(each) for each in lines[: line - 1]) + byte
    content = b"".join(lines)
    file.write_bytes(content[:start] + text.encode() + content[start + replaced :])


def _read_events(logs: Path, name: str) -> list[dict[str, Any]]:
    """Events so far of the run of this name."""
    return [
        json.loads(line)
        for path in logs.glob(f"*-{name}/events.jsonl")
        for line in path.read_text(encoding="utf-8").splitlines()
        if line.endswith("}")
    ]
