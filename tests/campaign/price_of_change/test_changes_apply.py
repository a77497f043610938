"""Each change whose price the campaign measures applies to the present source, which imports."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import pytest
import test_price_of_a_column
import test_price_of_a_rule
import test_price_of_a_sensor_role
from changed_source import ChangedSource

CHANGED = (
    "firmware_iface.roles, membrane_ctrl.controller.safety, membrane_ctrl.controller.controller"
)


@pytest.mark.parametrize(
    "change",
    [test_price_of_a_column, test_price_of_a_rule, test_price_of_a_sensor_role],
    ids=lambda module: module.__name__,
)
def test_the_changed_source_imports(change: ModuleType, tmp_path: Path) -> None:
    source = ChangedSource.copy_to(tmp_path)
    change.apply_change(source)
    source.run_python("-c", f"import {CHANGED}")
