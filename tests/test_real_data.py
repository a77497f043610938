"""Tests of real frames find their data, or say that they do not."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.real_data import MISSING, describe_skipped_frames, find_real_data


@pytest.mark.parametrize("checkout", ["main", "clones/mine", "a/b/c"])
def test_data_beside_the_checkout_or_above_are_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, checkout: str
) -> None:
    monkeypatch.delenv("MEMBRANE_REAL_DATA", raising=False)
    (tmp_path / checkout).mkdir(parents=True)
    (tmp_path / "shared" / "data").mkdir(parents=True)
    assert find_real_data(tmp_path / checkout) == tmp_path / "shared" / "data"


def test_a_named_folder_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MEMBRANE_REAL_DATA", str(tmp_path / "elsewhere"))
    assert find_real_data(tmp_path) == tmp_path / "elsewhere"


def test_skipped_tests_of_real_frames_are_counted() -> None:
    reasons = [f"Skipped: {MISSING} in /x", "Skipped: no camera", f"Skipped: {MISSING} in /x"]
    assert "2 tests of real frames were skipped" in describe_skipped_frames(reasons)
    assert describe_skipped_frames(reasons[1:2]) == ""
