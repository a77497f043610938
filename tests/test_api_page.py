"""The examples of docs/reference/api.md run, in their order, where a run, a set and a configuration
are."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from membrane_ctrl.config.schema import CameraConfig, OpticsConfig
from membrane_ctrl.sim.optics.film_shape import typical_film
from membrane_ctrl.sim.optics.simulate import simulate_set
from membrane_ctrl.sim.optics.simulation_spec import SimulationSpec
from tests.support.review_runs import written

PAGE = Path(__file__).parents[1] / "docs" / "reference" / "api.md"


def test_the_examples_of_the_page_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    written(tmp_path / "logs", 0.05)
    optics = OpticsConfig(camera=CameraConfig(width_px=204, height_px=170, pixel_um=41.4))
    simulate_set(str(tmp_path / "set"), SimulationSpec(optics, typical_film(37.1, 500.0, seed=1)))
    (tmp_path / "lab.toml").write_text("[limits]\nband_um = 3.0\n")
    monkeypatch.chdir(tmp_path)
    space: dict[str, object] = {}
    for example in re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL):
        exec(compile(example, PAGE.name, "exec"), space)
    band, first, spread, verdict, _ = capsys.readouterr().out.splitlines()
    assert band == "3.0"
    assert re.fullmatch(r"2026-11-21 18:01:00\.\d+\+00:00 hold", first)
    assert 0.1 < float(spread) < 1.0
    assert verdict.startswith("ok")
    assert space["cycles"].num_rows == 45  # type: ignore[attr-defined]
