"""A commissioning session on the emulated bench in virtual time."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

from firmware_iface.emulators.pump_board import BoardSample
from membrane_ctrl.commissioning.check import DeviceProbe
from membrane_ctrl.commissioning.guide import emulated_bench
from membrane_ctrl.commissioning.guide.bench_access import HandAct, HandMotion
from membrane_ctrl.commissioning.guide.dialogue import Choice, Dialogue
from membrane_ctrl.commissioning.guide.emulated_bench import EmulatedBench
from membrane_ctrl.commissioning.guide.good_readings import select_good
from membrane_ctrl.commissioning.guide.inflation_stages import DepthPoint, judge_law
from membrane_ctrl.commissioning.guide.mirror_design import PAPER_MIRROR
from membrane_ctrl.commissioning.guide.real_bench import RealBench
from membrane_ctrl.commissioning.guide.session import CommissioningSession
from membrane_ctrl.commissioning.guide.session_state import (
    CONFIGURATION,
    HTML,
    PDF,
    SessionState,
    read_state,
)
from membrane_ctrl.commissioning.guide.stage import SessionPlan, StageContext, StageFailedError
from membrane_ctrl.commissioning.guide.text_display import TextDisplay
from membrane_ctrl.config.schema import Config
from membrane_ctrl.config.toml_file import load_toml
from membrane_ctrl.controller.cross_check import cross_check
from membrane_ctrl.hold.virtual_hold import VirtualHold
from membrane_ctrl.model.errors import Exit, InputError
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.truth import Truth
from membrane_ctrl.sim.virtual_bench import VirtualBench
from tests.commissioning.guided import Person, QuickBench, failed_in, run_stages, state_of

DESK = ("mirror", "devices")


@pytest.fixture
def bench() -> QuickBench:
    return QuickBench()


def test_a_whole_session_ends_accepted_with_configuration_and_report(
    tmp_path: Path, bench: QuickBench
) -> None:
    person = Person()
    assert run_stages(tmp_path, bench, person) == Exit.DONE, person.text
    config = load_toml(tmp_path / CONFIGURATION, Config)
    assert not [finding for finding in cross_check(config) if finding.severity == "error"]
    assert config.limits.displacement_min_um == -2000.0  # wider only while the mirror was filled
    assert config.twin.leak_time_constant_s == pytest.approx(1e4, rel=0.25)  # measured, in weather
    html = (tmp_path / HTML).read_text(encoding="utf-8")
    assert "Accepted." in html
    assert "emulated bench" in html
    assert "signed by" in html
    assert (tmp_path / PDF).read_bytes().startswith(b"%PDF")
    assert bench.tuned == ["pump", "run"]
    # A second start finds nothing to do but the signature.
    again = Person()
    assert run_stages(tmp_path, bench, again) == Exit.DONE
    assert again.asked == ["signature"]


def test_the_end_of_input_loses_nothing(tmp_path: Path, bench: QuickBench) -> None:
    class Leaving(Person):
        def read_line(self, key: str, prompt: str) -> str:
            if key == "mirror.modulus_gpa":
                raise EOFError
            return super().read_line(key, prompt)

    person = Leaving(**{"mirror.sag_mm": "30"})
    assert run_stages(tmp_path, bench, person, "mirror") == Exit.INTERRUPTED
    resumed = Person(**{"mirror.sag_mm": [], "mirror.pump_ml_per_s": "100"})
    run_stages(tmp_path, bench, resumed, "mirror")
    facts = state_of(tmp_path).facts
    assert facts is not None
    assert facts.sag_mm == 30.0  # Enter repeats the answer


def test_back_returns_to_the_stage_before(tmp_path: Path, bench: QuickBench) -> None:
    person = Person(**{"devices.kind": ["back", "board"], "mirror.sag_mm": ["37.1", "30"]})
    assert run_stages(tmp_path, bench, person, *DESK) == Exit.DONE
    facts = state_of(tmp_path).facts
    assert facts is not None
    assert facts.sag_mm == 30.0


def test_a_mirror_whose_film_would_yield_is_refused(tmp_path: Path, bench: QuickBench) -> None:
    person = Person(**{"mirror.back_thickness_um": "5"})
    assert run_stages(tmp_path, bench, person, *DESK) == Exit.INTERRUPTED
    assert failed_in(tmp_path, person) == ["yield stress over the stress at the pressure limit"]
    assert "continue" not in person.text


def test_a_clear_film_in_front_is_written_and_taken_back(tmp_path: Path, bench: QuickBench) -> None:
    run_stages(tmp_path, bench, Person(**{"mirror.seen": "through"}), "mirror")
    front = load_toml(tmp_path / CONFIGURATION, Config).optics.mirror.front_film
    assert front is not None
    # The paper's cushion: 10 µm in front of 50 µm
    assert (front.bulge_mm, front.thickness_um) == (pytest.approx(63.4, abs=0.1), 10.0)
    person = Person(**{"mirror.seen": "directly", "devices.kind": ["back", "board"]})
    run_stages(tmp_path, bench, person, *DESK)
    assert load_toml(tmp_path / CONFIGURATION, Config).optics.mirror.front_film is None


def test_a_stated_front_film_stays_without_an_answer(tmp_path: Path, bench: QuickBench) -> None:
    (tmp_path / CONFIGURATION).write_text("[optics.mirror.front_film]\nbulge_mm = 61.0\n")
    run_stages(tmp_path, bench, Person(), "mirror")
    front = load_toml(tmp_path / CONFIGURATION, Config).optics.mirror.front_film
    assert front is not None
    assert front.bulge_mm == 61.0


def test_a_diaphragm_pump_in_place_of_a_proportional_one_stalls_again(
    tmp_path: Path, bench: QuickBench
) -> None:
    first = Person(**{"mirror.pump_kind": "proportional"})
    run_stages(tmp_path, bench, first, "mirror")
    assert load_toml(tmp_path / CONFIGURATION, Config).pump.stall_fraction == 0.0
    second = Person(**{"devices.kind": "back", "mirror.pump_kind": "diaphragm"})
    assert run_stages(tmp_path, bench, second, *DESK) == Exit.INTERRUPTED
    pump = load_toml(tmp_path / CONFIGURATION, Config).pump
    assert (pump.start_fraction, pump.stall_fraction) == (0.22, 0.15)
    assert failed_in(tmp_path, second) == [
        "least flow of the running pump over the leak, as stated"
    ]


def test_a_pump_that_can_only_switch_is_refused(tmp_path: Path, bench: QuickBench) -> None:
    person = Person(**{"mirror.pump_kind": "diaphragm"})
    assert run_stages(tmp_path, bench, person, "mirror") == Exit.INTERRUPTED
    assert failed_in(tmp_path, person) == [
        "least flow of the running pump over the leak, as stated"
    ]


def test_a_typo_asks_again_and_keeps_the_other_answers(tmp_path: Path, bench: QuickBench) -> None:
    person = Person(
        **{
            "devices.kind": "instruments",
            "displacement.driver": "optoncdt1420",
            "displacement.port": "/dev/ttyUSB0",
            "pump.driver": "modbus_map",
            "pump.preset": "none",
            "pump.link": "tcp://192.168.1.40",
            "pump.address": ["three", "3"],
            "pump.raw": ["4000", "4000, 20000"],
            "pump.value": "0, 1",
            "gauge_pressure.driver": "mks_937b",
            "gauge_pressure.port": "/dev/ttyUSB1",
            "vent.driver": "none",
            "barometer.driver": "none",
            "thermometer.driver": "none",
            "interlock1.driver": "none",
        }
    )
    run_stages(tmp_path, bench, person, *DESK)
    devices = load_toml(tmp_path / CONFIGURATION, Config).devices
    assert devices is not None
    assert devices.pump is not None
    assert devices.pump.model_dump()["raw"] == (4000.0, 20000.0)
    assert devices.pump.model_dump()["link"] == "tcp://192.168.1.40"


WIRING = (
    ("gauge_zero", "gauge_offset_pa", 20.0, "gauge reading of the vented mirror"),
    ("gauge_zero", "gauge_stuck", True, "the gauge's last digit moves"),
    ("laser", "no_light", True, "laser sees the card"),
    ("laser", "laser_stuck", True, "laser's sign"),
    ("outputs", "readback_fraction", 0.9, "pump"),
    ("watchdog", "readback_fraction", 0.35, "pump off after the last command, beyond the"),
)


@pytest.mark.parametrize(("stage", "name", "value", "check"), WIRING)
def test_wrong_wiring_is_found(
    tmp_path: Path, bench: QuickBench, stage: str, name: str, value: object, check: str
) -> None:
    run_stages(tmp_path, bench, Person(), *DESK, "probe")
    setattr(bench.bench.wrong, name, value)
    person = Person()
    assert run_stages(tmp_path, bench, person, stage) == Exit.INTERRUPTED
    failed = failed_in(tmp_path, person)
    assert any(found.startswith(check) for found in failed), person.text
    assert bench.bench.board.pump_fraction == 0.0


def test_a_laser_without_a_reading_of_the_flat_film_is_explained(
    tmp_path: Path, bench: QuickBench
) -> None:
    run_stages(tmp_path, bench, Person(), *DESK)
    blind = DeviceProbe("displacement", "/dev/ttyUSB0", problem="no reading")
    bench.probe_devices = lambda config: [blind]  # type: ignore[method-assign]
    person = Person()
    assert run_stages(tmp_path, bench, person, "probe") == Exit.INTERRUPTED
    assert "37.1 mm from displacement 0. Set `zero_mm`" in person.text


def test_a_reversed_laser_is_found(tmp_path: Path, bench: QuickBench) -> None:
    run_stages(tmp_path, bench, Person(), *DESK, "probe")
    bench.laser_sign = -1
    person = Person()
    run_stages(tmp_path, bench, person, "laser")
    assert failed_in(tmp_path, person) == ["laser's sign"]


def test_a_closed_vent_stops_the_pump(tmp_path: Path, bench: QuickBench) -> None:
    run_stages(tmp_path, bench, Person(), *DESK, "probe")
    bench.bench.wrong.gauge_offset_pa = 200.0  # the gas does not get out
    person = Person()
    assert run_stages(tmp_path, bench, person, "outputs") == Exit.INTERRUPTED
    assert "the pump is off, the vent open" in person.text
    assert bench.bench.board.pump_fraction == 0.0


def test_a_pump_that_runs_on_without_its_cable_is_a_reason(
    tmp_path: Path, bench: QuickBench
) -> None:
    run_stages(tmp_path, bench, Person(), *DESK, "probe")
    person = Person(**{"cable_stopped": "n", "cable.after": "continue"})
    assert run_stages(tmp_path, bench, person, "cable") == Exit.REJECTED
    assert "Not accepted: 1 reasons." in (tmp_path / HTML).read_text(encoding="utf-8")


def test_without_interlocks_or_relief_valve_it_is_not_accepted(
    tmp_path: Path, bench: QuickBench
) -> None:
    person = Person(**{"interlock1.driver": "none", "mirror.relief_pa": "0"})
    run_stages(tmp_path, bench, person, *DESK)
    more = Person(
        **{
            "stop_fitted": "n",
            "interlocks.after": "continue",
            "emergency_stop.after": "continue",
            "relief.after": "continue",
        }
    )
    names = ("interlocks", "emergency_stop", "relief")
    assert run_stages(tmp_path, bench, more, *names) == Exit.REJECTED
    assert failed_in(tmp_path, more) == ["interlocks", "emergency stop", "relief valve"]


def test_a_circuit_that_never_opens_is_found(tmp_path: Path, bench: QuickBench) -> None:
    run_stages(tmp_path, bench, Person(), *DESK, "probe")
    bench.move_hand = lambda motion: None  # type: ignore[method-assign]  # wired elsewhere
    person = Person()
    run_stages(tmp_path, bench, person, "interlocks")
    assert "emergency_stop open" in failed_in(tmp_path, person)


PROTECTION = (
    ("emergency_stop", {"stop_stopped": "n"}, "emergency stop"),
    ("emergency_stop", {"stop_fitted": "n"}, "emergency stop"),
    ("relief", {"relief_opened": "n"}, "relief valve opens"),
    ("relief", {"mirror.relief_pa": "700"}, "relief valve's pressure"),
    ("relief", {"mirror.relief_pa": "1500"}, "relief valve's pressure"),
)


@pytest.mark.parametrize(("stage", "answers", "check"), PROTECTION)
def test_a_protection_that_does_not_protect_is_a_reason(
    tmp_path: Path, bench: QuickBench, stage: str, answers: dict[str, str], check: str
) -> None:
    run_stages(tmp_path, bench, Person(**answers), *DESK)
    person = Person(**answers, **{f"{stage}.after": "continue"})
    assert run_stages(tmp_path, bench, person, stage) == Exit.REJECTED
    assert check in failed_in(tmp_path, person)
    assert "Not accepted" in (tmp_path / HTML).read_text(encoding="utf-8")


TWO_CIRCUITS = {
    "interlock2.driver": "board_input",
    "interlock2.name": "door",
    "interlock2.text": "shut the door",
    "interlock2.input": "1",
    "interlock3.driver": "none",
}


def test_every_circuit_is_tried(tmp_path: Path, bench: QuickBench) -> None:
    run_stages(tmp_path, bench, Person(**TWO_CIRCUITS), *DESK)
    person = Person()
    assert run_stages(tmp_path, bench, person, "interlocks") == Exit.DONE, person.text
    for name in ("emergency_stop", "door"):
        for key in (f"open_{name}", f"lose_{name}", f"close_{name}"):
            assert key in person.asked


def test_exchanged_circuits_are_found(tmp_path: Path, bench: QuickBench) -> None:
    run_stages(tmp_path, bench, Person(**TWO_CIRCUITS), *DESK)
    other = {"emergency_stop": "door", "door": "emergency_stop", "": ""}
    move_hand = bench.move_hand

    def move_other(motion: HandMotion) -> None:
        move_hand(replace(motion, name=other[motion.name]))

    bench.move_hand = move_other  # type: ignore[method-assign]
    person = Person()
    run_stages(tmp_path, bench, person, "interlocks")
    assert {"emergency_stop open", "door open"} <= set(failed_in(tmp_path, person))


def test_a_lost_signal_that_reads_closed_is_found(tmp_path: Path, bench: QuickBench) -> None:
    run_stages(tmp_path, bench, Person(), *DESK)
    move_hand = bench.move_hand

    def move_unless_lost(motion: HandMotion) -> None:
        if motion.act is not HandAct.LOSE_SIGNAL:
            move_hand(motion)

    bench.move_hand = move_unless_lost  # type: ignore[method-assign]
    person = Person()
    run_stages(tmp_path, bench, person, "interlocks")
    assert failed_in(tmp_path, person) == ["emergency_stop without its signal"]


def test_a_pump_without_gas_ends_the_inflation(tmp_path: Path, bench: QuickBench) -> None:
    run_stages(tmp_path, bench, Person(), *DESK, "probe")
    bench.bench.wrong.pump_share = 0.0
    person = Person()
    assert run_stages(tmp_path, bench, person, "inflation") == Exit.INTERRUPTED
    assert "the pump is off" in person.text
    assert load_toml(tmp_path / CONFIGURATION, Config).limits.displacement_min_um == -2000.0
    assert bench.bench.board.pump_fraction == 0.0


def context_of(folder: Path, bench: QuickBench, person: Person) -> StageContext:
    state = SessionState(created_utc="", author="", simulated=True, facts=PAPER_MIRROR)
    dialogue = Dialogue(person.display, {}, lambda: None)
    return StageContext(folder, state, dialogue, bench)


@pytest.mark.parametrize(
    ("factor", "zero_um", "failed"),
    [
        (1.0, 0.0, []),
        (2.0, 0.0, ["measured over stated stiffness of the film, or the reverse"]),
        (
            1.0,
            5000.0,
            [
                "pressure against depth, difference from the film's law",
                "measured over stated stiffness of the film, or the reverse",
            ],
        ),
    ],
)
def test_laser_and_gauge_are_compared_by_the_films_law(
    tmp_path: Path, bench: QuickBench, factor: float, zero_um: float, failed: list[str]
) -> None:
    person = Person()
    sags_mm = [37.1 * share for share in (0.1, 0.35, 0.6, 0.8, 0.9, 1.0)]
    points = [
        DepthPoint(sag_mm + 1e-3 * zero_um, factor * 600.0 * (sag_mm / 37.1) ** 3)
        for sag_mm in sags_mm
    ]
    judge_law(context_of(tmp_path, bench, person), points)
    assert failed_in(tmp_path, person) == failed


def test_the_tension_of_clamping_is_no_error_of_laser_or_gauge(
    tmp_path: Path, bench: QuickBench
) -> None:
    person = Person()
    shares = (0.1, 0.35, 0.6, 0.8, 0.9, 1.0)
    points = [DepthPoint(37.1 * s, 600.0 * (0.4 * s + 0.6 * s**3)) for s in shares]
    judge_law(context_of(tmp_path, bench, person), points)
    assert failed_in(tmp_path, person) == []
    assert "pressure by the tension of clamping: 240.0 Pa" in person.text


def test_a_damaged_state_is_named(tmp_path: Path) -> None:
    (tmp_path / "session.json").write_text("{", encoding="utf-8")
    with pytest.raises(InputError, match=r"session\.json: damaged"):
        read_state(tmp_path)


def test_numbers_are_asked_until_they_are_within_limits() -> None:
    answers = ["x", "nan", "-1", "1,103", "12,5"]
    shown: list[str] = []
    display = TextDisplay(lambda key, prompt: answers.pop(0), shown.append)
    dialogue = Dialogue(display, {}, lambda: None)
    assert dialogue.ask_number("sag", "sag", 37.1, 0.1, 100.0, "mm") == 12.5
    assert len(shown) == 4


def test_answers_are_remembered_by_their_meaning() -> None:
    """A number in a list means another choice once the list has changed."""
    answers = ["2", "12,50"]
    remembered: dict[str, str] = {}
    display = TextDisplay(lambda key, prompt: answers.pop(0), lambda line: None)
    dialogue = Dialogue(display, remembered, lambda: None)
    dialogue.ask_choice("port", "port?", [Choice(name="ttyUSB0"), Choice(name="ttyUSB1")])
    dialogue.ask_number("sag", "sag", 37.1, 0.1, 100.0, "mm")
    assert remembered == {"port": "ttyUSB1", "sag": "12.5"}


def test_a_session_on_the_emulated_bench_names_its_option(
    tmp_path: Path, bench: QuickBench
) -> None:
    person = Person(**{"mirror.seen": "quit"})
    assert run_stages(tmp_path, bench, person, "mirror") == Exit.INTERRUPTED
    assert f"`membrane-ctrl commission {tmp_path} --twin` resumes this session" in person.text
    with pytest.raises(InputError, match="add --twin"):
        CommissioningSession(tmp_path, RealBench(), person.display)


def test_a_killed_stage_leaves_its_wider_limit_to_the_next_start(
    tmp_path: Path, bench: QuickBench
) -> None:
    run_stages(tmp_path, bench, Person(), *DESK)
    context = context_of(tmp_path, bench, Person())
    files = [tmp_path / "session.json", tmp_path / CONFIGURATION]
    with context.lend_keys("limits", displacement_min_um=-36_000.0):
        left = [file.read_bytes() for file in files]
    # as a power cut leaves them
    for file, content in zip(files, left, strict=True):
        file.write_bytes(content)
    assert load_toml(tmp_path / CONFIGURATION, Config).limits.displacement_min_um == -36_000.0
    again = Person()
    run_stages(tmp_path, bench, again, *DESK)
    assert load_toml(tmp_path / CONFIGURATION, Config).limits.displacement_min_um == -2000.0
    assert "limits.displacement_min_um" in again.text
    assert state_of(tmp_path).lent == {}


class LossyBench(QuickBench):
    """Every seventh sample of the laser is lost."""

    def _use_bench(self, config: Config) -> VirtualBench:
        bench = super()._use_bench(config)
        sample_of = Plant.sample_of
        plant = bench.plant

        def sample_lossy(truth: Truth) -> BoardSample:
            sample = sample_of(plant, truth)
            is_lost = sample.sample_counter % 7 == 0
            return replace(sample, displacement_quality=1) if is_lost else sample

        plant.sample_of = sample_lossy  # type: ignore[method-assign]
        return bench


def test_lost_samples_of_the_laser_are_no_reason_to_stop(tmp_path: Path) -> None:
    bench = LossyBench()
    run_stages(tmp_path, bench, Person(), *DESK)
    config = load_toml(tmp_path / CONFIGURATION, Config)
    bench.use_mirror(VirtualBench(Plant(config.twin, config.pump)))
    person = Person()
    plan = SessionPlan(settled_s=5.0, leak_s=20.0)
    run_stages(tmp_path, bench, person, "laser", "inflation", "leak", plan=plan)
    assert "nan" not in person.text
    assert "passed: laser's sign" in person.text
    assert failed_in(tmp_path, person) == []


def test_a_laser_that_loses_most_is_named() -> None:
    with pytest.raises(StageFailedError, match="the laser gave 1 readings in 3 samples"):
        select_good([math.nan, 1.0, math.nan], "laser")


def test_each_tuning_of_the_emulated_bench_begins_with_the_configuration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`tune run` continues a session that it finds, and refuses one of another pump's curve."""
    started: list[list[str]] = []

    def note_program(words: list[str], show: object) -> int:
        started.append(words)
        return 0

    monkeypatch.setattr(emulated_bench, "run_shown", note_program)
    bench = EmulatedBench(VirtualHold)
    for command in ("pump", "run"):
        assert bench.run_tuning(tmp_path, Config(), command, print) == 0
    logs = [words[words.index("--logs") + 1] for words in started]
    assert len(set(logs)) == 2
