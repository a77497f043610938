"""Thousands of transactions of each link under random faults: no wrong value is accepted."""

from __future__ import annotations

import pytest

from tests.studies.link_audit import LINKS, audit


@pytest.mark.parametrize("count", [2_500, pytest.param(10_000, marks=pytest.mark.campaign)])
@pytest.mark.parametrize("name", LINKS)
def test_no_wrong_value_is_accepted(name: str, count: int) -> None:
    found = audit(name, count, seed=7)
    assert found.wrong == 0
    assert found.transactions >= count
    assert found.believed > 0.7 * found.transactions  # and it is not by refusing everything
