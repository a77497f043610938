"""Build step of `pyproject.toml`: states the commit of the source in a wheel and in a source
archive.
"""

import sys
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py
from setuptools.command.sdist import sdist

sys.path.insert(0, str(Path(__file__).parent))

from membrane_ctrl.model import program


def _write_commit(root: str) -> None:
    (Path(root) / program.PACKAGE.name / program.BUILD_FILE).write_text(
        program.program_commit() + "\n"
    )


class BuildWithCommit(build_py):
    """Copies the sources of a wheel; an editable one keeps describing its checkout."""

    def run(self) -> None:
        super().run()
        if not self.editable_mode:
            _write_commit(self.build_lib)


class ArchiveWithCommit(sdist):
    """Copies the sources of an archive."""

    def make_release_tree(self, base_dir: str, files: list[str]) -> None:
        super().make_release_tree(base_dir, files)
        _write_commit(base_dir)


setup(cmdclass={"build_py": BuildWithCommit, "sdist": ArchiveWithCommit})
