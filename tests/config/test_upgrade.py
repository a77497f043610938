"""A file with keys of a former release is upgraded; comments, order and other keys stay."""

from __future__ import annotations

from pathlib import Path

import pytest

from membrane_ctrl.config.upgrade import CHANGED_KEYS, ChangedKey, upgrade_file, upgrade_text
from membrane_ctrl.model.errors import InputError

RENAMED = ChangedKey("1.1.0", "2027-01-01", "loop.gain", "loop.kp_per_s", "the unit is in the name")
MOVED = ChangedKey("1.1.0", "2027-01-01", "recording.band_um", "limits.band_um", "it is a limit")
REMOVED = ChangedKey("1.2.0", "2027-06-01", "loop.old", "", "it had no effect")
ALL = (RENAMED, MOVED, REMOVED)
TEXT = """\
# my bench
[loop]
gain = 0.5  # tuned in May
ti_s = 7.0
old = true

[recording]
band_um = 3.0
"""


def test_keys_are_renamed_moved_and_removed_and_comments_stay() -> None:
    upgraded = upgrade_text(TEXT, ALL)
    assert upgraded.changes == ALL
    assert "# my bench" in upgraded.text
    assert "kp_per_s = 0.5" in upgraded.text
    assert "[limits]\nband_um = 3.0" in upgraded.text
    assert "old" not in upgraded.text
    assert upgrade_text(upgraded.text, ALL).changes == ()


def test_the_file_is_written_only_on_request_and_the_former_one_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(TEXT)
    difference = upgrade_file(path, False, ALL)
    assert "-gain = 0.5" in difference
    assert path.read_text() == TEXT
    upgrade_file(path, True, ALL)
    assert (tmp_path / "lab.toml.former").read_text() == TEXT
    assert upgrade_file(path, True, ALL) == ""


def test_two_names_of_one_key_are_refused() -> None:
    with pytest.raises(InputError, match="both there"):
        upgrade_text("[loop]\ngain = 1.0\nkp_per_s = 2.0\n", ALL)


def test_a_file_that_stays_wrong_is_refused_and_kept(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    path.write_text("[loop]\ngain = -1.0\n")
    with pytest.raises(InputError, match="kp_per_s"):
        upgrade_file(path, True, ALL)
    assert path.read_text() == "[loop]\ngain = -1.0\n"


def test_every_entry_has_a_release_and_a_date() -> None:
    for change in (*CHANGED_KEYS, *ALL):
        assert change.release in change.words
        assert len(change.date) == 10
