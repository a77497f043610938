"""The checklist of a release: what cannot be looked up neither passes nor fails."""

from __future__ import annotations

import json

import pytest

from tests.support.release_check import (
    MISSING,
    NOT_DONE,
    PASSED,
    NotDoneError,
    ReleaseItem,
    judge_audit,
    print_results,
)

CLEAN = {"name": "numpy", "version": "2.0", "vulns": []}
SKIPPED = {"name": "scipy", "skip_reason": "Dependency not found on PyPI and could not be audited"}
BROKEN = {"name": "jinja2", "version": "2.0", "vulns": [{"id": "PYSEC-1"}]}


def audit(*packages: dict[str, object]) -> str:
    return json.dumps({"dependencies": packages, "fixes": []})


def test_known_vulnerabilities_are_named() -> None:
    assert judge_audit(audit(CLEAN), "") == ""
    assert judge_audit(audit(CLEAN, BROKEN, SKIPPED), "") == "known vulnerabilities: jinja2"


@pytest.mark.parametrize("output", ["", "{", "[]", audit(), audit(CLEAN, SKIPPED)])
def test_packages_that_were_not_looked_up_are_not_done(output: str) -> None:
    """pip-audit ends with 0 and "No known vulnerabilities found" where its service is missing."""
    with pytest.raises(NotDoneError, match="no network"):
        judge_audit(output, "WARNING\nconnection refused")


def test_what_was_not_done_is_repeated_at_the_end(capsys: pytest.CaptureFixture[str]) -> None:
    item = ReleaseItem("vulnerabilities", "no dependency has a known one", lambda: "")
    assert print_results([(item, NOT_DONE, "no network: timeout")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "not done vulnerabilities  no network: timeout"
    assert lines[-1] == "not a complete check: vulnerabilities not done on this machine"
    assert print_results([(item, NOT_DONE, ""), (item, MISSING, "x")]) == 1
    assert print_results([(item, PASSED, "")]) == 0
