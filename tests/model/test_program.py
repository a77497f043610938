"""The commit of the running source: from the build, from git, from `.git` without git,
or unknown.
"""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from membrane_ctrl import __version__
from membrane_ctrl.model import program
from membrane_ctrl.model.program import (
    file_origin,
    find_commit,
    program_identity,
    remove_origin,
    stated_program,
)


def git(folder: Path, *words: str) -> str:
    author = ("-c", "user.name=a", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false")
    done = subprocess.run(
        ["git", *author, *words], cwd=folder, check=True, capture_output=True, text=True
    )
    return done.stdout.strip()


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    folder = tmp_path / "checkout"
    folder.mkdir()
    git(folder, "init", "--quiet", "--initial-branch", "main")
    (folder / "file").write_text("one")
    git(folder, "add", "file")
    git(folder, "commit", "--quiet", "-m", "one")
    git(folder, "tag", "v9")
    return folder


@pytest.fixture
def without_git(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("PATH", "/nowhere")
    return checkout


def test_a_clean_checkout_has_its_commit_and_a_modified_one_is_marked(checkout: Path) -> None:
    commit = git(checkout, "rev-parse", "HEAD")[:12]
    assert find_commit(checkout) == commit
    (checkout / "file").write_text("two")
    assert find_commit(checkout) == f"{commit}-dirty"


def test_without_git_the_commit_is_read_from_the_branch(without_git: Path) -> None:
    commit = (without_git / ".git" / "refs" / "heads" / "main").read_text().strip()
    assert find_commit(without_git) == commit[:12]


@pytest.mark.parametrize(
    ("head", "commit"),
    [
        ("0123456789abcdef0123456789abcdef01234567", "0123456789ab"),
        ("ref: refs/heads/gone", ""),
        ("ref: ../file", ""),
        ("", ""),
        ("\x1b[31m", ""),
        ("ref: /etc/hostname", ""),
    ],
    ids=["detached", "no such branch", "outside", "empty", "other bytes", "absolute"],
)
def test_without_git_another_head_gives_its_commit_or_none(
    without_git: Path, head: str, commit: str
) -> None:
    (without_git / ".git" / "HEAD").write_text(head)
    assert find_commit(without_git) == commit


def test_a_folder_inside_another_checkout_has_no_commit(checkout: Path) -> None:
    (checkout / "site-packages").mkdir()
    assert find_commit(checkout / "site-packages") == ""


def test_a_damaged_checkout_has_no_commit(tmp_path: Path) -> None:
    (tmp_path / ".git").mkdir()
    assert find_commit(tmp_path) == ""


def test_the_commit_of_a_build_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(program, "PACKAGE", tmp_path)
    program.program_commit.cache_clear()
    assert program.program_commit() == ""
    assert program_identity() == f"membrane-ctrl {__version__}"
    (tmp_path / program.BUILD_FILE).write_text("0123456789ab-dirty\n")
    program.program_commit.cache_clear()
    assert program_identity() == f"membrane-ctrl {__version__} (0123456789ab-dirty)"
    program.program_commit.cache_clear()


def test_a_file_states_format_program_and_commit() -> None:
    origin = file_origin("membrane-test/1")
    assert list(origin) == ["schema", "program", "commit"]
    assert stated_program(origin) == program_identity()


def test_the_origin_of_a_file_is_checked_and_removed() -> None:
    table: dict[str, object] = {**file_origin("membrane-test/1"), "value": 3}
    remove_origin(table, "membrane-test/1")
    assert table == {"value": 3}
    for other in ({}, {"schema": "membrane-test/2"}, {"schema": None}):
        with pytest.raises(ValueError, match="expected 'membrane-test/1'"):
            remove_origin(dict(other), "membrane-test/1")


@pytest.mark.parametrize(
    ("table", "stated"),
    [
        ({}, ""),
        ({"program": 3}, ""),
        ({"program": "x 1"}, "x 1"),
        ({"program": "x 1", "commit": 7}, "x 1"),
        ({"commit": "ab"}, ""),
    ],
)
def test_a_file_from_elsewhere_may_state_less(table: dict[str, object], stated: str) -> None:
    assert stated_program(table) == stated
