"""What a review says in words and shows in maps: figures, detected events,
names of overlaid runs.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.chunk import RrdReader

from membrane_ctrl.config.schema import Config
from membrane_ctrl.recorder.blueprint import list_learned_plots
from membrane_ctrl.review import open_run
from membrane_ctrl.review.viewer.blueprints import ReviewBlueprint, labels_of
from membrane_ctrl.review.viewer.command import ReviewOptions, make_review
from membrane_ctrl.run_files import shapes
from tests.support.review_runs import set_summary, written
from tests.worlds.nights import Planted

FIGURES = {
    "duration_s": 360.0,
    "states": [{"state": "lower"}],
    "fault_count": 2,
    "faults": [{"name": "laser_lost"}],
    "leak_um_per_s": None,
    "cycles": 90,
    "cycles_rejected": 1,
    "geometry": {"hash": "ae735b0b", "file": None},
    "missed_ticks": 0,
    "ticks": 3600,
}
HELD = {
    "of": "true",
    "held_s": 300,
    "std_um": 0.1234,
    "mean_um": None,
    "in_band": 0.98,
    "faults_s": 36,
    "paused_s": 0,
}
DOORS = [
    Planted("pressure step", 100.0, 20.0),
    Planted("pressure step", 250.0, -15.0),
    Planted("laser lost", 300.0, 4),
]


@pytest.fixture(scope="module")
def night(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = written(tmp_path_factory.mktemp("layer"), 0.1, DOORS)
    with (folder / "events.jsonl").open("a") as file:
        for at_s, texts in (
            (200.0, {"kind": "command", "command": "pause"}),
            (210.0, {"kind": "command", "command": "hold", "refused": "no"}),
            (250.0, {"kind": "pump", "scale": 1.05, "sigma": 0.1, "correction": 1.0}),
            (
                300.0,
                {
                    "kind": "fault",
                    "name": "laser_lost",
                    "cause": "no reading",
                    "remedy": "clean it",
                },
            ),
            (850.0, {"kind": "pump", "scale": 0.82, "sigma": 0.04, "correction": 0.95}),
        ):
            file.write(json.dumps({"mono_s": at_s, **texts}) + "\n")
    return folder


def reviewed(folders: list[Path], file: Path) -> dict[str, dict[str, list[Any]]]:
    """Every component of every entity of a review, as lists in order of time."""
    make_review([open_run(folder) for folder in folders], ReviewOptions(folders), file)
    found: dict[str, dict[str, list[Any]]] = {}
    for chunk in RrdReader(file).stream():
        batch = chunk.to_record_batch()
        of_path = found.setdefault(chunk.entity_path, {})
        for name in batch.schema.names:
            if ":" in name:
                of_path.setdefault(name, []).extend(batch.column(name).to_pylist())
    return found


def test_the_page_states_the_figures_of_the_summary(night: Path, tmp_path: Path) -> None:
    def page(**changes: object) -> str:
        set_summary(night, **changes)
        return str(reviewed([night], tmp_path / "r.rrd")["/summary"]["TextDocument:text"][0][0])

    assert "missing or damaged" in page(**FIGURES, held={"std_um": "much"})
    rows = dict(
        line.strip("| ").split(" | ")
        for line in page(held=HELD).splitlines()
        if line.count(" | ") == 1
    )
    assert rows["std of 1 s means, true centre"] == "0.123 µm"
    assert rows["1 s means within ±2 µm"] == "98 %"
    assert rows["time in faults"] == "0:00:36 (10 %)"
    assert (rows["geometry"], rows["faults"]) == ("ae735b0b", "2")
    assert "mean error" not in rows  # unknown


def test_lines_stand_where_something_happened_and_are_named_with_its_size(
    night: Path, tmp_path: Path
) -> None:
    layer = reviewed([night], tmp_path / "r.rrd")
    (door,) = layer["/found/lines/pressure_step"]["SeriesLines:names"]
    assert door[0].startswith("2 of pressure step, -1")
    assert door[0].endswith(" Pa")
    (lost,) = layer["/found/lines/laser_lost"]["SeriesLines:names"]
    assert lost == ["laser lost, 4 s"]
    texts = [text for (text,) in layer["/found"]["TextLog:text"]]
    assert [text[9:22] for text in texts] == ["pressure step", "pressure step", "laser lost, 4"]
    assert (
        len(layer["/marks/pause"]["Scalars:scalars"])
        == len(layer["/marks/fault"]["Scalars:scalars"])
        == 3
    )
    assert "/marks/command" not in layer  # it was refused
    assert layer["/state/controller"]["StateChange:state"] == [
        ["hold"],
        [None],
    ]  # another run may last longer
    (fault,) = (text for (text,) in layer["/events"]["TextLog:text"] if "Fault" in text)
    assert "Do: clean it" in fault


def test_what_was_learned_of_the_pump_is_drawn_with_its_error(night: Path, tmp_path: Path) -> None:
    """The recording's own layout had it, a review did not."""
    pump = reviewed([night], tmp_path / "r.rrd")["/pump/scale"]
    assert pump["Measurements:values"] == [[1.05, 1.0], [0.82, 0.95]]
    assert np.array(pump["Measurements:variances"]) == pytest.approx(
        np.array([[0.01, 0.0], [0.0016, 0.0]])
    )


@pytest.mark.parametrize(
    ("config", "plots"),
    [({}, 0), ({"pump": {"probe_um": 0.1}}, 1), ({"estimator": {"process_value": "estimate"}}, 3)],
)
def test_the_loop_s_tab_has_what_the_loop_learns(
    config: dict[str, dict[str, Any]], plots: int
) -> None:
    assert len(list_learned_plots(Config.model_validate(config))) == plots
    tab = ReviewBlueprint(("",), "utc", None, Config.model_validate(config))._make_loop_tab()
    assert len(list(tab.contents)) == 5 + plots


def test_maps_are_those_of_the_cycles_in_stated_colours(night: Path, tmp_path: Path) -> None:
    layer = reviewed([night], tmp_path / "r.rrd")
    spans = {
        kind: layer[f"/shape/map/{kind}"]["DepthImage:depth_range"][-1][0]
        for kind in ("scatter", "difference")
    }
    cycles = open_run(night).shapes()
    axis = np.linspace(-0.99, 0.99, 50)
    x, y = (part[np.hypot(*np.meshgrid(axis, axis)) < 0.99] for part in np.meshgrid(axis, axis))
    heights_um = cycles.heights_um(x, y)
    assert spans["scatter"] == pytest.approx(
        [0.0, np.quantile(heights_um.std(axis=0, ddof=1), 0.99)], rel=0.05
    )
    assert spans["difference"][0] == -spans["difference"][1] <= -0.5
    parameters = cycles.parameters_um()
    change = shapes.change_map_um(parameters[9] - parameters[0])
    row, column = 30, 61
    place = ((column + 0.5) * 2 / shapes.MAP_PX - 1, 1 - (row + 0.5) * 2 / shapes.MAP_PX)
    ends = cycles.heights_um(*(np.array([part]) for part in place))[:, 0]
    assert change[row, column] == pytest.approx(ends[9] - ends[0], abs=1e-5)
    (page,) = layer["/shape/legend"]["TextDocument:text"]
    assert f"| standard deviation | 0 to {spans['scatter'][1]:.2g} µm |" in page[0]


def test_overlaid_runs_have_their_names(night: Path, tmp_path: Path) -> None:
    layer = reviewed(
        [night, written(tmp_path, 0.02, name="20261122T180000Z-b c")], tmp_path / "r.rrd"
    )
    for path, name in (("/night", "night"), (r"/b\ c", "b c")):
        (lines,) = layer[f"{path}/overview/truth/error"]["SeriesLines:names"]
        assert lines == [f"{name}: true error, mean µm"]
        assert f"{path}/summary" in layer


def test_names_of_overlaid_runs_distinguish_them() -> None:
    first, second = "20261121T180000Z-a", "20261122T180000Z-a"
    assert labels_of([first]) == [""]
    assert labels_of([first, second]) == [first, second]
    assert labels_of([first, first]) == [f"{first} (1)", f"{first} (2)"]
    assert labels_of([first, "copy"]) == ["a", "copy"]
