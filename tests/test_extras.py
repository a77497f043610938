"""The development environment, in which every test runs, has what the extras install."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from membrane_ctrl.model.optional import find_missing_page_library

EXTRAS = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"][
    "optional-dependencies"
]
# Without them their tests use a stand-in, or are skipped
NOT_INSTALLED_FOR_TESTS = {"alarms", "gpio", "notebooks", "render"}


def names_of(extra: str) -> set[str]:
    return {re.split(r"[<>=!~\[;]", requirement)[0].strip() for requirement in EXTRAS[extra]}


@pytest.mark.parametrize("extra", sorted(set(EXTRAS) - {"dev"} - NOT_INSTALLED_FOR_TESTS))
def test_the_development_environment_has_an_extra(extra: str) -> None:
    assert names_of(extra) <= names_of("dev")


def test_every_library_of_the_page_is_installed_here() -> None:
    assert find_missing_page_library() is None


@pytest.mark.parametrize("missing", ["nicegui", "fastapi_offline", "argon2"])
def test_any_missing_library_of_the_page_is_named(
    missing: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("membrane_ctrl.model.optional.is_installed", lambda name: name != missing)
    assert find_missing_page_library() == missing
