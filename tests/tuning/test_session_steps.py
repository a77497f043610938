"""Verification, shape loop, watch and files of a session, each by itself on made-up data."""

from __future__ import annotations

import json
import math
import tomllib
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

from membrane_ctrl.config.schema import Config, LoopConfig, PumpConfig
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.errors import InputError
from membrane_ctrl.model.program import program_identity, stated_program
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.telemetry import ShapeState
from membrane_ctrl.sessions import folder as plain
from tests.worlds.foreign_plant import ForeignPlant, ForeignPump, foreign_bench, foreign_config
from tuning import journal
from tuning.gains_file import SCHEMA, GainsFile, PlantSection, load_gains, save_gains
from tuning.identification.closed_loop import Gains
from tuning.identification.disturbance import DisturbanceModel, observe_disturbance
from tuning.identification.noise_spectrum import Noise
from tuning.identification.plant_model import PlantModel
from tuning.identification.record import Record
from tuning.identification.record_file import load_record, save_record
from tuning.identification.shape_loop_fit import STEP_UM, find_unfit_reason, fit_shape_loop
from tuning.identification.shape_loop_trial import try_time_constant
from tuning.identification.weather_gains import WeatherGain
from tuning.options import TuneOptions
from tuning.proposal.loop_health import judge_health
from tuning.proposal.model_bench import ModelBench
from tuning.proposal.prediction import predict_loop
from tuning.proposal.verification import (
    SETTLE_LEAST_S,
    STAGES,
    VerificationTrial,
    estimate_centre_std_um,
    estimate_growth_sigma,
    estimate_sensitivity,
    explain_no_benefit,
    find_settling_time_s,
    judge_stage,
)
from tuning.rigs.bench_rig import Rig
from tuning.rigs.hold_rig import HoldRig
from tuning.twin_hold import TwinHold

PLANT = PlantModel(1.0, 0.08, 0.15, 1.24)
WEATHER = DisturbanceModel(Noise(1.0, 0.01, 0.01, 12.0, 0.02), None, None)
LOOP = LoopConfig(feedforward_barometer=False, feedforward_temperature=False)


@cache
def held(
    loop: LoopConfig,
    plant: PlantModel = PLANT,
    duration_s: float = 600.0,
    weather: DisturbanceModel = WEATHER,
) -> tuple[Record, ModelBench]:
    """A hold of the model's own bench, settled; nobody changes it."""
    bench = ModelBench(plant, weather, PumpConfig(), 3)
    rig = Rig(bench, loop, PumpConfig(), plant.holding_flow_um_per_s)
    rig.hold(30.0)
    return rig.hold(duration_s), bench


def test_the_centre_s_deviation_is_seen_through_ten_times_the_noise() -> None:
    record, bench = held(LOOP)
    true_um = float(np.std(bench.true_um[1500:]))
    trial = VerificationTrial(PLANT, WEATHER, LOOP, LOOP)
    assert estimate_centre_std_um(record.displacement_um, trial, WEATHER, LOOP) == pytest.approx(
        true_um, rel=0.2
    )


def test_a_slow_loop_is_given_longer_to_forget_the_change() -> None:
    assert find_settling_time_s(LOOP) == SETTLE_LEAST_S
    slow = LOOP.model_copy(update={"kp_per_s": 0.247, "ti_s": 19.94})
    # the slowest root of s^2 + 0.247 s + 0.01239 is at 0.0701 per s
    assert find_settling_time_s(slow) == pytest.approx(4 / 0.0701, rel=0.01)
    assert find_settling_time_s(slow.model_copy(update={"ti_s": 3600.0})) <= 120.0


def test_a_look_passes_good_gains_and_names_what_is_wrong_with_bad_ones() -> None:
    record, _ = held(LOOP)
    about_um = np.zeros(len(record))
    assert (
        judge_stage(record, about_um, VerificationTrial(PLANT, WEATHER, LOOP, LOOP), 1.5).reason
        == ""
    )
    slow = LOOP.model_copy(update={"kp_per_s": 0.1, "ti_s": 60.0})
    record, _ = held(slow)
    stage = judge_stage(record, about_um, VerificationTrial(PLANT, WEATHER, LOOP, slow), 1.1)
    assert stage.growth > 1.3
    assert "times that of the previous gains" in stage.reason


@pytest.mark.parametrize(
    ("kp_per_s", "reason"), [(0.1, ""), (0.03, "times that of the previous gains")]
)
def test_a_deviation_that_was_predicted_and_accepted_is_no_failure(
    kp_per_s: float, reason: str
) -> None:
    """Gains chosen knowing what they cost; those that cost more than was predicted still fail."""
    chosen = LOOP.model_copy(update={"kp_per_s": 0.1, "ti_s": 60.0})
    record, _ = held(LOOP.model_copy(update={"kp_per_s": kp_per_s, "ti_s": 60.0}))
    stage = judge_stage(
        record,
        np.zeros(len(record)),
        VerificationTrial(PLANT, WEATHER, LOOP, chosen, accepted=True),
        1.1,
    )
    assert stage.growth > 1.1
    assert reason in stage.reason
    assert bool(stage.reason) == bool(reason)


def test_gains_that_change_nothing_are_no_better_beyond_the_error() -> None:
    """The same gains, and gains that differ by 2 %, against gains with half the deviation."""
    slow = LOOP.model_copy(update={"kp_per_s": 0.1, "ti_s": 60.0})
    record, _ = held(LOOP)
    about_um = np.zeros(len(record))
    for before, better in (
        (LOOP, False),
        (LOOP.model_copy(update={"kp_per_s": 1.02 * LOOP.kp_per_s}), False),
        (slow, True),
    ):
        trial = VerificationTrial(PLANT, WEATHER, before, LOOP)
        stage = judge_stage(record, about_um, trial, 1.1)
        assert not stage.reason
        assert 0.02 < stage.growth_sigma < 0.15
        assert stage.is_better == better
        assert bool(explain_no_benefit(stage, trial)) != better
    accepted = replace(trial, before=LOOP, accepted=True)
    assert explain_no_benefit(judge_stage(record, about_um, accepted, 1.1), accepted) == ""


def test_gains_without_margin_are_replaced_even_if_the_deviation_stays() -> None:
    sharp = LOOP.model_copy(update={"kp_per_s": 2.6, "ti_s": 6.0})
    record, _ = held(LOOP)
    trial = VerificationTrial(PLANT, WEATHER, sharp, LOOP)
    stage = replace(judge_stage(record, np.zeros(len(record)), trial, 1.1), growth=1.0)
    assert not stage.is_better
    assert explain_no_benefit(stage, trial) == ""


def test_a_short_record_shows_no_benefit() -> None:
    record, _ = held(LOOP)
    trial = VerificationTrial(PLANT, WEATHER, LOOP, LOOP)
    minute = record.cut(0.0, 60.0)
    stage = judge_stage(minute, np.zeros(len(minute)), trial, 2.0)
    assert math.isinf(stage.growth_sigma)
    assert not stage.is_better
    assert explain_no_benefit(stage, trial) == ""


def test_the_error_of_a_ratio_is_that_of_drawn_records() -> None:
    """Two loops that share most of their weather, 60 records of ten minutes at 10 Hz."""
    rng = np.random.default_rng(4)
    ratios: list[float] = []
    sigmas: list[float] = []
    for _ in range(60):
        common, own, other = (
            lfilter([0.1], [1.0, -0.97], rng.standard_normal(6000)) for _ in range(3)
        )
        pair = common + 0.5 * own, common + 0.5 * other
        stds = [float(part.std()) for part in pair]
        ratios.append(stds[0] / stds[1])
        sigmas.append(estimate_growth_sigma(*pair, *stds, 0.1))
    assert float(np.std(ratios)) == pytest.approx(
        math.sqrt(float(np.mean(np.square(sigmas))) - 0.03**2), rel=0.3
    )


def test_a_plant_with_less_margin_than_designed_shows_in_the_readings() -> None:
    """Gain and delay that have grown since: the model is content, the spectrum is not."""
    loop = LOOP.model_copy(update={"kp_per_s": 1.0, "ti_s": 8.0, "measurement_filter_s": 0.1})
    changed = replace(PLANT, gain=2.0, dead_time_s=0.35, leak_um_per_s=2.48)
    record, _ = held(loop, changed)
    stage = judge_stage(
        record, np.zeros(len(record)), VerificationTrial(PLANT, WEATHER, loop, loop), 100.0
    )
    assert stage.ms > 2.0
    assert "less margin than designed" in stage.reason


def test_doors_and_a_pulsating_pump_are_no_lack_of_margin() -> None:
    """Four doors that ring at 0.8 Hz, and a pump that pulsates at 1.3 Hz all the time."""
    record, _ = held(LOOP)
    time_s = np.arange(len(record)) * record.dt_s
    disturbed_um = record.displacement_um + 0.3 * np.sin(2 * np.pi * 1.3 * time_s)
    for at_s in (40.0, 190.0, 320.0, 500.0):
        since_s = np.maximum(time_s - at_s, 0.0)
        disturbed_um += 4.0 * np.sin(2 * np.pi * 0.8 * since_s) * np.exp(-0.4 * since_s)
    trial = VerificationTrial(PLANT, WEATHER, LOOP, LOOP)
    assert estimate_sensitivity(disturbed_um, trial, WEATHER) < 2.0


STORM_PUMP = PumpConfig(
    start_fraction=0, stall_fraction=0, curve_fraction=(0.0, 1.0), curve_um_per_s=(0.0, 5.3)
)
STORM_MODEL = PlantModel(1.0, 0.4, 0.3, 0.2)


def in_a_storm(loop: LoopConfig) -> tuple[Record, float]:
    """Ten minutes on a tight mirror of the second world, whose weather asks for less than no flow;
    true deviation.
    """
    plant = ForeignPlant(ForeignPump("straight", 5.3, 0.4, 0.3), 7, 3.0, 0.2, True, 0.5, False)
    config = foreign_config(rate_hz=10.0).model_copy(update={"loop": loop, "pump": STORM_PUMP})
    link = TwinHold(config, bench=foreign_bench(plant))
    rig = HoldRig(link, "tester")
    rig.hold(100.0)
    record = rig.hold(600.0)
    return record, float(np.std([row.truth_displacement_um for row in link.rows[-len(record) :]]))


def test_the_gains_before_are_judged_in_the_very_weather_of_the_new_ones() -> None:
    """It asks for less than no flow for minutes: its spectrum says less than half of what the gains
    before had.
    """
    before = foreign_config(
        rate_hz=10.0, feedforward_barometer=False, feedforward_temperature=False
    ).loop
    after = before.model_copy(update={"kp_per_s": 0.35, "ti_s": 20.0})
    record, after_um = in_a_storm(after)
    _, before_um = in_a_storm(before)
    weather = observe_disturbance(record, STORM_MODEL, after)
    trial = VerificationTrial(STORM_MODEL, weather, before, after, pump=STORM_PUMP)
    stage = judge_stage(record, np.zeros(len(record)), trial, 1.1)
    assert stage.std_um == pytest.approx(after_um, rel=0.05)
    assert stage.before_um == pytest.approx(before_um, rel=0.05)
    assert (
        predict_loop(Gains.from_config(before), STORM_MODEL, weather, before).std_um
        < 0.5 * before_um
    )


@pytest.mark.parametrize(
    ("verify_s", "until_s"),
    [(600.0, [60.0, 180.0, 300.0, 600.0]), (300.0, [60.0, 180.0, 300.0]), (30.0, [30.0])],
)
def test_a_short_verification_has_no_shorter_stages(verify_s: float, until_s: list[float]) -> None:
    """A gust of five seconds is half of what 30 s see, and took good gains back."""
    assert TuneOptions.stages.fget is not None
    stages = TuneOptions.stages.fget(SimpleNamespace(verify_s=verify_s))
    assert [until for until, _ in stages] == until_s
    assert stages[-1][1] == STAGES[-1][1]


def test_a_setpoint_that_moved_is_no_deviation() -> None:
    record, _ = held(LOOP)
    walk_um = 5.0 * np.sin(np.arange(len(record)) * 1e-4)
    moved = replace(record, displacement_um=record.displacement_um + walk_um)
    trial = VerificationTrial(PLANT, WEATHER, LOOP, LOOP)
    plain_um = estimate_centre_std_um(record.displacement_um, trial, WEATHER, LOOP)
    assert estimate_centre_std_um(
        moved.displacement_um - walk_um, trial, WEATHER, LOOP
    ) == pytest.approx(plain_um, rel=1e-9)


def shapes(
    count: int, start_s: float, sag_um: float, sigma_um: float, drift_um: np.ndarray
) -> list[ShapeEstimate]:
    rng = np.random.default_rng(int(start_s))
    s = zernike_projection()
    made = []
    for k in range(count):
        seen_um = sag_um + sigma_um * rng.standard_normal()
        made.append(
            ShapeEstimate(
                start_s + 2.0 * k,
                "fringes",
                seen_um * s,
                0.0,
                np.outer(s, s),
                seen_um,
                1.0,
                sag_um + float(drift_um[k]),
                1.0,
                1.0,
                80.0,
                0.0,
                "ok",
            )
        )
    return made


def test_the_shape_loop_s_sensitivity_noise_and_time_constant() -> None:
    still = np.zeros(2000)
    levels = [
        shapes(60, 10_000.0 + 200 * k, 37_100.0 + at, 0.3, still)
        for k, at in enumerate((0.0, STEP_UM, 0.0))
    ]
    drift = (
        np.cumsum(np.random.default_rng(5).standard_normal(2000)) * 0.05 * math.sqrt(2.0)
    )  # 0.05 µm/sqrt(s)
    found = fit_shape_loop(levels, shapes(2000, 0.0, 37_100.0, 0.3, drift), zernike_projection())
    assert found.agreement == pytest.approx(1.0)
    assert found.scale == pytest.approx(1.0, abs=0.05)
    assert found.sigma_um == pytest.approx(0.3, rel=0.1)
    assert found.drift_seen
    assert found.drift_um_per_sqrt_h == pytest.approx(3.0, rel=0.3)
    assert found.time_constant_s == pytest.approx(max(20.0, 0.3 * math.sqrt(2.0) / 0.05), rel=0.3)


def test_a_drift_that_is_not_seen_asks_for_minutes() -> None:
    still = np.zeros(400)
    levels = [
        shapes(40, 10_000.0 + 200 * k, 37_100.0 + at, 1.0, still)
        for k, at in enumerate((0.0, STEP_UM, 0.0))
    ]
    found = fit_shape_loop(levels, shapes(400, 0.0, 37_100.0, 1.0, still), zernike_projection())
    assert not found.drift_seen
    assert found.drift_um_per_sqrt_h < 2.0
    assert found.time_constant_s > 60.0


class OuterRig:
    """A hold whose shapes during the trial are given; notes its commands."""

    loop = LOOP

    def __init__(self, trial: list[ShapeEstimate], tracking: float = 1.0) -> None:
        self.shapes: list[ShapeEstimate] = []
        self.messages: list[tuple[float, float] | str] = []
        self._trial, self._tracking = trial, tracking

    def set_gains(
        self, loop: LoopConfig, why: str, trial_s: float, shape_s: float = math.nan
    ) -> None:
        self.messages.append((trial_s, shape_s))

    def keep_gains(self) -> None:
        self.messages.append("keep")

    def ticks(self, duration_s: float) -> list[SimpleNamespace]:
        self.shapes += self._trial
        codes = [
            ShapeState.TRACKING if k < 100 * self._tracking else ShapeState.SUSPENDED
            for k in range(100)
        ]
        return [SimpleNamespace(shape_state=code) for code in codes]


@pytest.mark.parametrize(
    ("after_s", "um_per_min", "tracking", "words"),
    [
        (60.0, 0.0, 1.0, ""),
        (60.0, 1.0, 1.0, ""),
        (600.0, 0.0, 1.0, ""),
        (600.0, 1.0, 1.0, "the next shape is predicted to"),
        (2.0, 0.0, 1.0, "the next shape is predicted to"),
        (60.0, 0.0, 0.5, "tracked only 50% of the trial"),
    ],
)
def test_a_time_constant_is_kept_if_it_predicts_the_shapes(
    after_s: float, um_per_min: float, tracking: float, words: str
) -> None:
    drift_um = um_per_min / 60 * 2.0 * np.arange(400)
    earlier = shapes(100, 0.0, 37_100.0, 0.3, drift_um[:100])
    rig = OuterRig(shapes(300, 200.0, 37_100.0, 0.3, drift_um[100:]), tracking)
    done = try_time_constant(rig, (40.0, after_s), earlier, zernike_projection(), 600.0)  # type: ignore[arg-type]
    assert words in done.reason
    assert bool(words) == bool(done.reason)
    assert rig.messages[0] == (720.0, after_s)
    assert rig.messages[1:] == (
        ["keep"] if not words else [(1.0, pytest.approx(math.nan, nan_ok=True))]
    )


def test_a_figure_that_does_not_answer_the_setpoint_is_not_tuned_on() -> None:
    still = np.zeros(400)
    levels = [
        shapes(40, 10_000.0 + 200 * k, 37_100.0 + at, 0.3, still)
        for k, at in enumerate((0.0, STEP_UM, 0.0))
    ]
    found = fit_shape_loop(levels, shapes(400, 0.0, 37_100.0, 0.3, still), zernike_projection())
    assert find_unfit_reason(found) == ""
    assert "calibrate the camera first" in find_unfit_reason(replace(found, scale=0.7))
    assert "calibrate the camera first" in find_unfit_reason(replace(found, agreement=0.5))


def test_a_rolled_back_time_constant_leaves_the_gains_of_its_session(tmp_path: Path) -> None:
    journal.append_entry(tmp_path, journal.make_entry("kept", "s1", "eve", "why", LOOP, LOOP))
    journal.append_entry(
        tmp_path, journal.make_entry("kept", "s1", "eve", "why", LOOP, LOOP, None, (40.0, 62.0))
    )
    assert journal.find_roll_back(tmp_path).shape_s == (40.0, 62.0)
    assert journal.find_roll_back(tmp_path, gains_only=True).shape_s is None
    journal.append_entry(
        tmp_path,
        journal.make_entry("rolled_back", "s1", "eve", "why", LOOP, LOOP, None, (40.0, 62.0)),
    )
    assert journal.find_roll_back(tmp_path).shape_s is None
    assert "shape loop 62 -> 40 s" in journal.format_history(journal.read_entries(tmp_path))


def gains_file(plant: PlantModel) -> GainsFile:
    section = PlantSection(
        gain=plant.gain,
        dead_time_s=plant.dead_time_s,
        lag_s=plant.lag_s,
        leak_um_per_s=plant.leak_um_per_s,
        gain_sigma=0.02,
        delay_sigma_s=0.01,
    )
    return GainsFile(
        author="eve",
        date_utc="2026-01-01",
        reason="test",
        source="test",
        data_sha256="0",
        predicted_std_um=0.2,
        least_std_um=0.15,
        plant=section,
        loop=LOOP,
    )


def test_a_loop_in_order_suggests_nothing_and_an_aged_one_states_why() -> None:
    record, _ = held(LOOP)
    about_um = np.zeros(len(record))
    fresh = judge_health(record, about_um, LOOP, gains_file(PLANT))
    assert fresh.suggestions == ()
    assert fresh.leak_um_per_s == pytest.approx(1.24, abs=0.1)
    assert fresh.gain == pytest.approx(1.0, abs=3 * fresh.gain_sigma)
    leaky = judge_health(record, about_um, LOOP, gains_file(replace(PLANT, leak_um_per_s=0.8)))
    assert any("leak" in suggestion for suggestion in leaky.suggestions)


@pytest.mark.parametrize("gain", [0.6, pytest.param(1.0, marks=pytest.mark.campaign)])
def test_the_gain_is_seen_although_the_feed_forward_cancels_the_weather(gain: float) -> None:
    """A slow loop whose flow is nearly all feed-forward; the pump as it was, and one that has lost
    40 %.
    """
    rest = Noise(1.0, 1e-4, 1e-4, 12.0, 0.02)
    barometer = WeatherGain(-0.36, 0.01, 2 * 1.2**2 / 30, 0.05, 0.0)
    weather = DisturbanceModel(
        rest, barometer, WeatherGain(123.0, 1.0, 2 * 0.05**2 / 300, 0.002, 12.0)
    )
    loop = LoopConfig(kp_per_s=0.25, ti_s=20.0)
    record, _ = held(loop, replace(PLANT, gain=gain), weather=weather)
    found = judge_health(record, np.zeros(len(record)), loop, gains_file(PLANT))
    assert found.gain == pytest.approx(gain, abs=0.12)
    assert any(suggestion.startswith("k is") for suggestion in found.suggestions) == (gain < 1)


def test_a_glance_is_too_short_to_judge() -> None:
    record, _ = held(LOOP, duration_s=60.0)
    with pytest.raises(ValueError, match="too short"):
        judge_health(record, np.zeros(len(record)), LOOP, gains_file(PLANT))


@dataclass(frozen=True, slots=True)
class Inner:
    values: tuple[float, ...]
    loop: LoopConfig | None


@dataclass(frozen=True, slots=True)
class Outer:
    inner: Inner
    flag: bool
    name: str


def test_results_come_back_from_their_file_as_they_were(tmp_path: Path) -> None:
    value = Outer(Inner((1.0, math.inf, -2.5), LOOP), True, "x")
    plain.write_session_file(tmp_path / "a.json", value)
    assert plain.read_session_file(tmp_path / "a.json", Outer) == value
    (tmp_path / "a.json").write_text("{}")
    with pytest.raises(InputError, match="damaged"):
        plain.read_session_file(tmp_path / "a.json", Outer)


def test_a_record_with_any_wrong_byte_is_one_line(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    path = tmp_path / "experiments.npz"
    save_record(path, Record(0.02, *(rng.normal(size=60) for _ in range(4))))
    good = path.read_bytes()
    refused = 0
    for place in range(0, len(good), 3):
        data = bytearray(good)
        data[place] ^= 0xFF
        path.write_bytes(data)
        try:
            load_record(path)  # a wrong date in the archive changes nothing
        except InputError:
            refused += 1
    assert refused > len(good) / 3 * 0.7


def test_the_journal_survives_a_torn_line(tmp_path: Path) -> None:
    journal.append_entry(tmp_path, journal.make_entry("kept", "s1", "eve", "why", LOOP, LOOP))
    with (tmp_path / "tuning" / "journal.jsonl").open("a") as file:
        file.write('{"time_utc": "2026')
    assert [line.session for line in journal.read_entries(tmp_path)] == ["s1"]
    assert journal.find_roll_back(tmp_path).session == "s1"


@pytest.mark.parametrize("place", ["tuning", "tuning/journal.jsonl"])
def test_the_journal_follows_no_link(tmp_path: Path, place: str) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "journal.jsonl").write_text("theirs\n")
    link = tmp_path / "logs" / place
    link.parent.mkdir(parents=True)
    link.symlink_to(elsewhere if place == "tuning" else elsewhere / "journal.jsonl")
    with pytest.raises(InputError, match="link"):
        journal.append_entry(
            tmp_path / "logs", journal.make_entry("kept", "s1", "eve", "why", LOOP, LOOP)
        )
    with pytest.raises(InputError, match="link"):
        journal.read_entries(tmp_path / "logs")
    assert (elsewhere / "journal.jsonl").read_text() == "theirs\n"


def test_each_json_file_of_a_session_states_format_and_program(tmp_path: Path) -> None:
    opened = plain.create_session(tmp_path, "night", "ann", "twin", Config(), LOOP)
    plain.write_session_file(opened.file_path("applied.json"), {"trial_s": 3.0})
    for name in ("session.json", "applied.json"):
        table = json.loads(opened.file_path(name).read_text())
        assert table["schema"] == plain.SCHEMA
        assert stated_program(table) == program_identity()
    assert plain.open_session(opened.path).head == opened.head


def test_a_gains_file_states_format_and_program(tmp_path: Path) -> None:
    path = tmp_path / "gains.toml"
    save_gains(path, gains_file(PLANT))
    table = tomllib.loads(path.read_text())
    assert table["schema"] == SCHEMA
    assert stated_program(table) == program_identity()
    path.write_text(path.read_text().replace("membrane-gains/1", "membrane-gains/2"))
    with pytest.raises(InputError, match="schema"):
        load_gains(path)


@pytest.mark.parametrize("content", ["{}", "[]", "3", '{"schema": "membrane-live-calibration/1"}'])
def test_a_session_of_another_format_is_refused(tmp_path: Path, content: str) -> None:
    opened = plain.create_session(tmp_path, "night", "ann", "twin", Config(), LOOP)
    opened.file_path("session.json").write_text(content)
    with pytest.raises(InputError, match=r"session\.json: damaged"):
        plain.open_session(opened.path)


def test_a_folder_in_place_of_a_result_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "proposal.json").mkdir()
    session = plain.SessionFolder(tmp_path, plain.SessionHead("", "", "", "", LOOP), Config())
    with pytest.raises(InputError, match="cannot be removed"):
        session.begin_step("design")


def test_nothing_to_roll_back_is_reported(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no kept gains"):
        journal.find_roll_back(tmp_path)
