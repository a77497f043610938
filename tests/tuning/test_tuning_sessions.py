"""Whole sessions on the twin: what they must reach, with few seeds; `benchmarks.tuning.sessions`
has sixteen.
"""

from __future__ import annotations

import ast
from pathlib import Path

import numpy as np
import pytest

import tuning
from membrane_ctrl.config.schema import LoopConfig, PumpConfig
from tests.studies.tuning_sessions import SESSIONS, Case, TwinBench, session
from tuning.identification.closed_loop import Gains
from tuning.identification.disturbance import observe_disturbance
from tuning.identification.experiments import fit_experiments, run_experiments
from tuning.identification.fit_quality import FitQuality
from tuning.proposal.candidate import NAMES, PRESENT
from tuning.proposal.candidate_table import format_markdown
from tuning.proposal.design import RefusedError, propose_gains
from tuning.proposal.model_bench import ModelBench
from tuning.proposal.preview import preview_loop
from tuning.proposal.robustness import evaluate_robustness, sample_plants
from tuning.rigs.bench_rig import Rig

RATIO_MAX = {
    "quiet, 1 µm": 1.15,
    "typical, 1 µm": 1.15,
    "gusty, 1 µm": 1.5,
    "quiet, 0.3 µm": 1.25,
    "typical, 0.3 µm": 1.25,
}


@pytest.mark.parametrize(
    ("name", "rules"),
    [
        ("typical, 1 µm", False),
        *(
            pytest.param(name, name == "typical, 1 µm", marks=pytest.mark.campaign)
            for name in RATIO_MAX
        ),
    ],
)
def test_a_session_reaches_what_it_must(name: str, rules: bool) -> None:
    figures = session(SESSIONS[name], 3, rules)
    # a run of 600 s has a standard deviation that scatters by some per cent
    assert figures["ours_ratio"] < 1.05 * RATIO_MAX[name]
    assert 0.7 < figures["predicted_over_achieved"] < 1.3
    assert 0.7 < figures["preview_um"] / figures["ours_um"] < 1.3
    assert abs(figures["ours_bias_um"]) < 0.1
    assert abs(figures["gain_error"]) < 0.05 + figures["gain_sigma"]
    assert abs(figures["delay_error_s"]) < 0.05
    assert abs(figures["dead_time_error_s"]) < 0.1
    assert figures["excursion_um"] < 10.0
    assert figures["ms"] <= 1.42
    for key, factor in (("default_um", 1.0), ("simc_um", 1.0), ("amigo_um", 1.0), ("zn_um", 3.0)):
        assert key not in figures or factor * figures["ours_um"] < figures[key], key


@pytest.mark.campaign
def test_with_weather_sensors_and_bleed_it_beats_the_laser_alone() -> None:
    laser_only_least_um = 0.149
    figures = session(SESSIONS["typical, 1 µm, barometer, thermometer, bleed doubled"], 3)
    assert figures["ours_um"] < 0.7 * laser_only_least_um
    assert 0.7 < figures["predicted_over_achieved"] < 1.3


@pytest.fixture(scope="module")
def designed():  # type: ignore[no-untyped-def]
    """One characterised bench: identified, disturbance, loop."""
    case = Case()
    bench = TwinBench(case, 4)
    rig = Rig(bench, case.loop(), PumpConfig(), case.holding_flow_um_per_s)
    found = fit_experiments(run_experiments(rig)).identified
    rig.hold(30.0)
    return found, observe_disturbance(rig.hold(300.0), found.model, case.loop()), case.loop()


def test_a_proposal_is_complete_and_its_table_readable(designed) -> None:  # type: ignore[no-untyped-def]
    found, weather, loop = designed
    proposal = propose_gains(found, weather, loop, PumpConfig(), FitQuality("ok", ()))
    assert proposal.chosen is proposal.candidates[0]
    assert {row.name for row in proposal.candidates} <= {*NAMES, PRESENT}
    assert proposal.robustness.stable_fraction == 1.0
    assert proposal.robustness.ms_p95 < 1.6
    assert proposal.loop.kp_per_s == proposal.chosen.gains.kp_per_s
    assert 0.2 < proposal.preview.load_peak_um < 2.5
    text = format_markdown(proposal.candidates)
    assert len(text.splitlines()) == 2 + len(proposal.candidates)
    assert len({line.count("|") for line in text.splitlines()}) == 1
    assert "ziegler-nichols" in text


def test_refused_data_are_not_designed_on(designed) -> None:  # type: ignore[no-untyped-def]
    found, weather, loop = designed
    with pytest.raises(RefusedError, match="run the relay again"):
        propose_gains(
            found, weather, loop, PumpConfig(), FitQuality("refused", ("run the relay again",))
        )


def test_a_leak_beyond_the_pump_is_refused(designed) -> None:  # type: ignore[no-untyped-def]
    found, weather, loop = designed
    with pytest.raises(RefusedError, match="leak"):
        propose_gains(
            found, weather, loop, PumpConfig(flow_full_um_per_s=0.5), FitQuality("ok", ())
        )


def test_hand_made_gains_that_are_unstable_are_seen_in_preview_and_robustness(designed) -> None:  # type: ignore[no-untyped-def]
    found, weather, loop = designed
    wild = LoopConfig.model_validate(loop.model_dump() | {"kp_per_s": 12.0, "ti_s": 0.5})
    assert evaluate_robustness(Gains.from_config(wild), found, weather, wild).stable_fraction == 0.0
    assert preview_loop(wild, PumpConfig(), found.model, weather, duration_s=30.0).std_um > 0.5


def test_sampled_plants_have_the_fit_s_scatter(designed) -> None:  # type: ignore[no-untyped-def]
    found, _, _ = designed
    gains = np.array([plant.gain for plant in sample_plants(found, 400)])
    assert gains.std() == pytest.approx(found.sigma.gain, rel=0.15)
    assert gains.mean() == pytest.approx(found.model.gain, abs=0.2 * found.sigma.gain)


def test_the_preview_bench_repeats_itself(designed) -> None:  # type: ignore[no-untyped-def]
    found, weather, _ = designed
    runs = []
    for seed in (1, 1, 2):
        bench = ModelBench(found.model, weather, PumpConfig(), seed)
        runs.append([bench.exchange(0.31, 0.0).displacement_um for _ in range(50)])
    assert runs[0] == runs[1] != runs[2]


OF_THE_TWIN = "twin_hold.py"  # starts the simulated bench for `tune run --twin`


@pytest.mark.parametrize(
    "file",
    sorted(path for path in Path(tuning.__file__).parent.rglob("*.py") if path.name != OF_THE_TWIN),
    ids=lambda p: p.name,
)
def test_tuning_imports_nothing_of_the_simulated_bench(file: Path) -> None:
    """A tuner that knew the simulator would tune the simulator."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        assert not any(name.startswith("membrane_ctrl.sim") for name in names)
