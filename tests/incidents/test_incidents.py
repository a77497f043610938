"""Every incident of this folder through today's control code (`membrane-ctrl replay RUN --to-test
NAME`).
"""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.incidents import check_incident, read_incident

HERE = Path(__file__).parent
FOLDERS = sorted(path.parent for path in HERE.glob("*/incident.toml"))


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_the_incident_is_decided_as_expected(folder: Path) -> None:
    assert check_incident(read_incident(folder)) == []
