"""A copy of the product's source in which one fact is changed, and programs that run from it."""

from __future__ import annotations

import ast
import difflib
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[3]
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

    def add_field(self, path: str, owner: str, text: str, before: str = "") -> None:
        """Add a field or a method to a class.

        Parameters
        ----------
        path : str
            Of the module, relative to the folder.
        owner : str
            Name of the class.
        text : str
            Lines of the field, without indentation.
        before : str
            The field that follows it; without one it is the last.
        """
        (body,) = (
            node.body
            for node in ast.walk(self._parse(path))
            if isinstance(node, ast.ClassDef) and node.name == owner
        )
        indentation = " " * body[0].col_offset
        lines = "".join(f"{indentation}{line}\n" if line else "\n" for line in text.splitlines())
        if not before:
            end_line = body[-1].end_lineno
            assert end_line is not None
            self._insert(path, end_line + 1, 0, lines)
            return
        (line,) = (
            node.lineno
            for node in body
            if isinstance(node, ast.AnnAssign) and ast.unparse(node.target) == before
        )
        self._insert(path, line, 0, lines)

    def add_argument(self, path: str, beside: str, text: str) -> None:
        """Add an argument in front of the keyword argument `beside=...`, which must be passed in
        one place of the module.
        """
        (keyword,) = (
            node
            for node in ast.walk(self._parse(path))
            if isinstance(node, ast.keyword) and node.arg == beside
        )
        indentation = " " * keyword.col_offset
        self._insert(path, keyword.lineno, keyword.col_offset, f"{text},\n{indentation}")

    def add_row(self, path: str, table: str, text: str) -> None:
        """Add the first row of a table: of the tuple that is assigned to the name `table`."""
        (rows,) = (
            node.value.elts
            for node in self._parse(path).body
            if isinstance(node, ast.AnnAssign)
            and ast.unparse(node.target) == table
            and isinstance(node.value, ast.Tuple)
        )
        self._insert(path, rows[0].lineno, rows[0].col_offset, f"{text.strip()},\n    ")

    def set_constant(self, path: str, name: str, value: int) -> None:
        """Give a constant of a module another value."""
        (literal,) = (
            node.value
            for node in self._parse(path).body
            if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == name
        )
        assert isinstance(literal, ast.Constant)
        assert literal.end_col_offset is not None
        length = literal.end_col_offset - literal.col_offset
        self._insert(path, literal.lineno, literal.col_offset, str(value), replaced=length)

    def count_places(self) -> int:
        """Return the number of places at which the packages differ from the repository's: runs of
        changed lines.
        """
        count = 0
        for package in PACKAGES:
            for file in sorted((self.folder / package).rglob("*.py")):
                original = ROOT / file.relative_to(self.folder)
                matcher = difflib.SequenceMatcher(
                    None,
                    original.read_text(encoding="utf-8").splitlines(),
                    file.read_text(encoding="utf-8").splitlines(),
                    autojunk=False,
                )
                count += sum(tag != "equal" for tag, *_ in matcher.get_opcodes())
        return count

    def _parse(self, path: str) -> ast.Module:
        return ast.parse((self.folder / path).read_bytes())

    def _insert(self, path: str, line: int, byte: int, text: str, replaced: int = 0) -> None:
        """Insert a text at a byte of a line (from 1), in place of `replaced` bytes."""
        file = self.folder / path
        lines = file.read_bytes().splitlines(keepends=True)
        start = sum(len(each) for each in lines[: line - 1]) + byte
        content = b"".join(lines)
        file.write_bytes(content[:start] + text.encode() + content[start + replaced :])

    def run_python(self, *words: object) -> str:
        """Run the interpreter on the changed source; returns its standard output. Fails unless it
        ends with 0.
        """
        environment = os.environ | {"PYTHONPATH": str(self.folder)}
        environment.pop("NUMBA_CACHE_DIR", None)  # compiled code stays in the copy
        command = [sys.executable, *(str(word) for word in words)]
        done = subprocess.run(
            command, cwd=self.folder, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
        return done.stdout

    def run_program(self, *words: object) -> str:
        """Run `membrane-ctrl` of the changed source, as `run_python`."""
        return self.run_python("-m", "membrane_ctrl", *words)
