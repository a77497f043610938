"""Ten thousand transactions of each link under random faults: no wrong value is believed."""

from __future__ import annotations

import pytest

from benchmarks.links import LINKS, audit


@pytest.mark.parametrize("name", LINKS)
def test_no_wrong_value_is_believed(name: str) -> None:
    found = audit(name, 10_000, seed=7)
    assert found.wrong == 0
    assert found.transactions >= 10_000
    assert found.believed > 0.7 * found.transactions  # and it is not by refusing everything
