"""Configurations are read, checked and saved; strangers' names reach no other file."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest

from membrane_ctrl.model.errors import InputError
from membrane_ctrl.service.configuration_editor import (
    FORMER_FOLDER,
    TEXT_BYTES_MAX,
    ConfigurationEditor,
)

GOOD = "[loop]\nkp_per_s = 0.5\n"
BETTER = "# slower\n[loop]\nkp_per_s = 0.4\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    found = tmp_path / "configurations"
    found.mkdir()
    (found / "lab.toml").write_text(GOOD)
    return found


def test_a_text_is_saved_and_the_former_one_kept(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "lab.toml").chmod(0o600)
    editor = ConfigurationEditor(folder)
    read = editor.read("lab")
    assert read.text == GOOD
    saved = editor.save("lab", BETTER, read.digest, "anna")
    assert (folder / "lab.toml").read_text() == BETTER, "with its comments"
    assert stat.S_IMODE((folder / "lab.toml").stat().st_mode) == 0o600
    (former,) = editor.list_former("lab")
    assert (folder / FORMER_FOLDER / former).read_text() == GOOD
    assert editor.save("lab", GOOD, saved.digest, "anna").text == GOOD
    assert len(editor.list_former("lab")) == 2
    assert "anna has saved lab" in capsys.readouterr().err


def test_a_new_name_makes_a_new_file_and_overwrites_none(folder: Path) -> None:
    editor = ConfigurationEditor(folder)
    assert editor.save("night", BETTER, "", "anna").text == BETTER
    assert editor.list_former("night") == []
    with pytest.raises(InputError, match="another person has changed it"):
        editor.save("lab", BETTER, "", "anna")
    assert (folder / "lab.toml").read_text() == GOOD


def test_what_somebody_else_has_saved_meanwhile_is_not_overwritten(folder: Path) -> None:
    first, second = ConfigurationEditor(folder), ConfigurationEditor(folder)
    digest = first.read("lab").digest
    second.save("lab", BETTER, digest, "bob")
    with pytest.raises(InputError, match="load it again"):
        first.save("lab", GOOD, digest, "anna")
    (folder / "lab.toml").unlink()
    with pytest.raises(InputError, match="load it again"):
        first.save("lab", GOOD, digest, "anna")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[loop\n", "not valid TOML"),
        ("[loop]\nkp = 1\n", "kp"),
        ("[loop]\nkp_per_s = 0,5\n", "write 0.5"),
        ("[pump]\nstall_fraction = 0.9\n", "pump.stall_fraction"),
        ("x = 1\n" * 50_000, "longer than"),
        (".".join("a" * 60) + " = 1\n", "more than 50 parts"),
        ("a = " + "[" * 5000, "not valid TOML"),
    ],
)
def test_what_fails_the_check_is_not_saved(folder: Path, text: str, message: str) -> None:
    editor = ConfigurationEditor(folder)
    checked = editor.check("lab", text)
    assert not checked.is_usable
    assert any(message in line for line in checked.errors), checked
    assert not any(str(folder) in line for line in checked.errors)
    with pytest.raises(InputError):
        editor.save("lab", text, editor.read("lab").digest, "anna")
    assert (folder / "lab.toml").read_text() == GOOD
    assert not (folder / FORMER_FOLDER).exists()


def test_warnings_do_not_refuse(folder: Path) -> None:
    text = '[bridges]\nrole = "operate"\n[bridges.epics]\n'
    editor = ConfigurationEditor(folder)
    checked = editor.check("lab", text)
    assert checked.is_usable
    assert any("bridges.role" in line for line in checked.warnings)
    editor.save("lab", text, editor.read("lab").digest, "anna")


@pytest.mark.parametrize(
    "name",
    [
        "",
        ".",
        "..",
        "../secret",
        "/etc/passwd",
        "lab.toml/../../secret",
        "former/lab-x",
        "a\0b",
        "a\nb",
        ".hidden",
        "twin",
        "x" * 65,
        "läb",
        "lab ",
    ],
)
def test_names_of_strangers_reach_no_file(folder: Path, name: str) -> None:
    (folder.parent / "secret.toml").write_text(GOOD)
    editor = ConfigurationEditor(folder)
    for call in (
        lambda: editor.read(name),
        lambda: editor.check(name, GOOD),
        lambda: editor.save(name, BETTER, "", "anna"),
        lambda: editor.list_former(name),
    ):
        with pytest.raises(InputError, match="not the name of a configuration"):
            call()
    assert (folder.parent / "secret.toml").read_text() == GOOD
    assert sorted(each.name for each in folder.iterdir()) == ["lab.toml"]


def test_links_and_other_things_are_neither_read_nor_replaced(folder: Path) -> None:
    secret = folder.parent / "secret.toml"
    secret.write_text(GOOD)
    (folder / "link.toml").symlink_to(secret)
    (folder / "dangling.toml").symlink_to(folder.parent / "none.toml")
    (folder / "folder.toml").mkdir()
    editor = ConfigurationEditor(folder)
    for name in ("link", "dangling", "folder"):
        with pytest.raises(InputError):
            editor.read(name)
        with pytest.raises(InputError):
            editor.save(name, BETTER, "", "anna")
    assert secret.read_text() == GOOD
    assert not (folder.parent / "none.toml").exists()


def test_a_file_that_is_no_text_or_too_long_is_refused(folder: Path) -> None:
    editor = ConfigurationEditor(folder)
    (folder / "lab.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(InputError, match="not UTF-8"):
        editor.read("lab")
    (folder / "lab.toml").write_bytes(b"#" * (TEXT_BYTES_MAX + 1))
    with pytest.raises(InputError, match="above the limit"):
        editor.read("lab")


def test_fifty_former_files_are_kept(folder: Path) -> None:
    editor = ConfigurationEditor(folder)
    digest = editor.read("lab").digest
    for number in range(53):
        digest = editor.save("lab", f"{GOOD}# {number}\n", digest, "anna").digest
    former = editor.list_former("lab")
    assert len(former) == 50
    assert (folder / FORMER_FOLDER / former[0]).read_text() == f"{GOOD}# 51\n"
