"""An installation without the viewer's program records, and names the remedy when asked to show."""

from __future__ import annotations

from pathlib import Path

import pytest

from membrane_ctrl.model.errors import InputError
from membrane_ctrl.recorder import segment_optimizer
from membrane_ctrl.review.viewer import viewer


def test_segments_stay_as_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(segment_optimizer, "_RERUN", tmp_path / "rerun")
    optimizer = segment_optimizer.Optimizer(tmp_path)
    optimizer.add_segment(tmp_path / "0001.rrd")
    assert not optimizer.is_busy


def test_the_viewer_is_missed_with_a_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(viewer.rerun_cli, "__file__", str(tmp_path / "__init__.py"))
    with pytest.raises(InputError, match="copy the run to a machine that has one"):
        viewer.viewer_command("file.rrd")
