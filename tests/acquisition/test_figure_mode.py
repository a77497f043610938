"""`shape.mode = "auto"`: figures are tracked if camera and machine give enough of them."""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.acquisition.figure_mode import Machine, choose_figure_mode, measure_machine
from membrane_ctrl.config.configuration_file import load_configuration
from membrane_ctrl.config.schema import Config, EstimatorConfig, ShapeConfig

AUTO = Config(shape=ShapeConfig(mode="auto"))


def choose(config: Config, processors: int, figure_ms: float) -> tuple[str, str]:
    decided, chosen = choose_figure_mode(
        config, lambda pixels: Machine(processors, figure_ms / 1e3)
    )
    assert chosen is not None
    assert chosen.mode == decided.shape.mode
    assert chosen.processors == processors
    assert chosen.figure_ms == figure_ms
    return decided.shape.mode, chosen.reason


@pytest.mark.parametrize(
    ("processors", "figure_ms", "mode", "words"),
    [
        (2, 10.0, "track", "20 figures a second"),
        (8, 50.0, "track", "10 figures a second"),
        (2, 150.0, "cycle", "3.3 figures a second"),
        (1, 10.0, "cycle", "one processor"),
    ],
)
def test_the_machine_decides(processors: int, figure_ms: float, mode: str, words: str) -> None:
    decided, reason = choose(AUTO, processors, figure_ms)
    assert decided == mode
    assert words in reason


def test_a_stated_mode_stays_and_is_no_decision() -> None:
    for mode in ("cycle", "track"):
        config = Config.model_validate({"shape": {"mode": mode}})
        assert choose_figure_mode(config) == (config, None)


def test_without_figures_nothing_is_tracked_and_without_a_laser_every_frame_counts() -> None:
    off = Config(shape=ShapeConfig(mode="auto", enabled=False))
    assert choose(off, 8, 1.0)[0] == "cycle"
    by_optics = Config(
        shape=ShapeConfig(mode="auto"), estimator=EstimatorConfig(process_value="optics")
    )
    assert choose(by_optics, 1, 1e3)[0] == "track"


def test_a_larger_frame_takes_longer() -> None:
    times_s = [
        np.median([measure_machine(n).figure_s for _ in range(3)]) for n in (1000, 4_000_000)
    ]
    assert times_s[0] < times_s[1]


def test_a_hold_without_a_file_decides_by_itself() -> None:
    config = load_configuration(None)
    assert config.shape.mode == "auto"
    assert config.estimator.process_value == "auto"
