"""Identification against known truth, its error bars, and what it says of bad data."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic import record, way_um

from tuning.identification.fit_quality import choose_remedy, judge_fit, validate_fit
from tuning.identification.plant_fit import identify_plant
from tuning.identification.plant_model import PlantModel
from tuning.identification.record import Record
from tuning.identification.residual_tests import compute_independence_p, compute_whiteness_p
from tuning.identification.two_gains import fit_two_gains

TRUTH = PlantModel(0.8, 0.09, 0.15, 1.1)


def test_recovers_a_plant_from_nearly_clean_data() -> None:
    found = identify_plant(record(TRUTH, laser_um=0.02, walk_um2_per_s=1e-6))
    assert found.model.gain == pytest.approx(TRUTH.gain, rel=2e-3)
    assert found.model.dead_time_s == pytest.approx(TRUTH.dead_time_s, abs=3e-3)
    assert found.model.lag_s == pytest.approx(TRUTH.lag_s, abs=4e-3)
    assert found.model.leak_um_per_s == pytest.approx(TRUTH.leak_um_per_s, rel=5e-3)


def test_error_bars_cover_the_errors() -> None:
    """Of 16 fits, at 2 sigma 95 % should hold the truth; fewer than 13 would be a chance of 1 in
    150.
    """
    fits = [identify_plant(record(TRUTH, seed=seed, samples=2000)) for seed in range(16)]
    gain = [abs(f.model.gain - TRUTH.gain) <= 2 * f.sigma.gain for f in fits]
    delay = [abs(f.model.delay_s - TRUTH.delay_s) <= 2 * f.sigma.delay_s for f in fits]
    assert sum(gain) >= 13
    assert sum(delay) >= 13
    assert np.mean([f.sigma.gain for f in fits]) < 0.04


def test_residuals_of_the_true_structure_are_white_and_independent_of_the_flow() -> None:
    found = identify_plant(record(TRUTH, seed=5))
    assert found.whiteness_p > 1e-3
    assert found.independence_p > 1e-3


def test_whiteness_and_independence_detect_a_wrong_model() -> None:
    rng = np.random.default_rng(1)
    e, u = rng.standard_normal(4000), rng.standard_normal(4000)
    assert compute_whiteness_p(np.convolve(e, [1.0, 0.3], "same")) < 1e-6
    assert compute_independence_p(e, u) > 1e-3
    assert compute_independence_p(e[3:] + 0.2 * u[:-3], u[3:]) < 1e-6


def test_a_short_or_silent_record_is_refused() -> None:
    whole = record(TRUTH)
    with pytest.raises(ValueError, match="too short"):
        identify_plant(whole.cut(0.0, 1.0))
    with pytest.raises(ValueError, match="tune characterise"):
        identify_plant(replace(whole, flow_um_per_s=np.ones(len(whole))))


def test_good_data_are_ok_and_hold_on_fresh_data() -> None:
    whole = record(TRUTH, samples=5000)
    fitted = identify_plant(whole.cut(0.0, 70.0))
    checked = validate_fit(fitted, whole.cut(70.0, 100.0))
    assert checked.innovation_ratio == pytest.approx(1.0, abs=0.1)
    assert judge_fit(whole, fitted, checked).verdict == "ok"


def test_a_bench_that_changed_is_seen_on_fresh_data() -> None:
    fitted = identify_plant(record(TRUTH, laser_um=0.1))
    checked = validate_fit(fitted, record(replace(TRUTH, gain=1.6), laser_um=0.1, seed=2))
    assert checked.independence_p < 1e-4
    assert judge_fit(record(TRUTH, laser_um=0.1), fitted, checked).verdict == "degraded"


def test_a_slammed_door_is_named_with_its_time() -> None:
    whole = record(TRUTH)
    jumped = replace(
        whole, displacement_um=whole.displacement_um + 12.0 * (np.arange(3000) >= 1500)
    )
    found = judge_fit(jumped, identify_plant(jumped))
    assert found.verdict == "refused"
    assert any("30.0 s" in reason and "relay" in reason for reason in found.reasons)


def test_a_pump_that_does_nothing_is_named() -> None:
    dead = record(replace(TRUTH, gain=1e-9))
    found = judge_fit(dead, identify_plant(dead))
    assert found.verdict == "refused"
    assert "run `tune pump`" in found.reasons[0]


@pytest.mark.parametrize(("gain", "verdict"), [(2.6, "refused"), (0.6, "degraded")])
def test_only_a_strong_pump_beside_which_something_swings_is_mapped(
    gain: float, verdict: str
) -> None:
    """One that starts with more than the leak can only pulse: no gains hold it without swinging."""
    whole = record(replace(TRUTH, gain=gain), laser_um=0.1)
    swing_um = 0.1 * np.sin(2 * np.pi * 1.3 * whole.dt_s * np.arange(len(whole)))
    found = judge_fit(
        whole, identify_plant(replace(whole, displacement_um=whole.displacement_um + swing_um))
    )
    assert (found.verdict, found.pump_unknown) == (verdict, verdict == "refused")
    assert any("coloured" in reason for reason in found.reasons)


def test_too_little_excitation_is_refused_with_the_experiment_that_helps() -> None:
    whole = record(TRUTH, samples=400, laser_um=4.0, walk_um2_per_s=0.5)
    found = judge_fit(whole, identify_plant(whole))
    assert found.verdict == "refused"
    assert any(
        "tune characterise" in reason or "longer" in reason or "tune pump" in reason
        for reason in found.reasons
    )


def test_a_pump_that_saturates_is_distinguished_from_a_straight_one() -> None:
    """Above 2.2 µm/s nothing more comes out, although the record says 4."""
    dt_s, rng = 0.02, np.random.default_rng(3)
    flow = np.repeat(rng.choice([0.4, 1.2, 2.2, 4.0], 120), 30)
    absent = np.full(flow.size, np.nan)
    gains = {}
    for most in (10.0, 2.2):
        came = np.minimum(flow, most)
        y = way_um(came, TRUTH, dt_s) + rng.standard_normal(flow.size)
        found = Record(dt_s, flow, y, absent, absent)
        gains[most] = fit_two_gains(found, identify_plant(found))
    straight, bent = gains[10.0], gains[2.2]
    assert abs(straight.above - straight.below) < 4 * straight.difference_sigma
    assert bent.below - bent.above > 5 * bent.difference_sigma


def test_a_tight_mirror_needs_a_bleed_and_not_a_larger_limit() -> None:
    assert "loop.bleed_fraction larger by 0.01" in choose_remedy(0.26)
    assert "--limit-um" not in choose_remedy(0.26)
    assert "a larger --limit-um" in choose_remedy(1.2)
