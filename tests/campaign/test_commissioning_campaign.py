"""Whole commissioning sessions in virtual time: on the twin with rendered pictures, tuning and an
hour of hold, and on benches whose physics share no code with the twin.

    python -m tests.campaign.test_commissioning_campaign FOLDER [STAGE ...]

runs or resumes the session on the twin with a hold of five minutes; named stages begin with the
mirror at its depth.
"""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from membrane_ctrl.commissioning.guide.emulated_bench import EmulatedBench
from membrane_ctrl.commissioning.guide.session_state import (
    CheckRecord,
    CheckVerdict,
    read_tables,
    write_tables,
)
from membrane_ctrl.commissioning.guide.stage import SessionPlan
from membrane_ctrl.config.schema import Config
from membrane_ctrl.config.toml_file import load_toml
from membrane_ctrl.hold.virtual_hold import VirtualHold
from membrane_ctrl.measure.simulate import shrink_camera
from membrane_ctrl.model.errors import Exit
from membrane_ctrl.sim import plant, virtual_bench
from tests.commissioning.guided import Person, QuickBench, run_stages, state_of
from tests.worlds.eleven_benches import BENCHES, Bench
from tests.worlds.foreign_plant import ForeignPlant, ForeignPump, foreign_bench

pytestmark = pytest.mark.campaign
HOUR = SessionPlan()
SHORT = SessionPlan(settled_s=10.0, leak_s=60.0, hold_s=300.0)
OPTICS = {
    "camera.driver": "aravis",
    "screen.driver": "pygame",
    "screen.width_px": "900",
    "screen.height_px": "900",
    "screen.pixel_mm": "0.5",
}
DESK = ("mirror", "devices")
LEAK_REL = 0.25  # of weather and laser noise over a minute


def checks_of(folder: Path) -> dict[str, CheckRecord]:
    return {check.name: check for record in state_of(folder).records for check in record.checks}


def run_on_twin(
    folder: Path, *names: str, plan: SessionPlan = HOUR, is_filled: bool = False
) -> tuple[Exit, Person]:
    """Run or resume a session with a camera of a quarter of the resolution."""
    bench = EmulatedBench(VirtualHold)
    person = Person(**OPTICS)
    if not (folder / "lab.toml").exists():
        run_stages(folder, bench, person, *DESK)
        tables = read_tables(folder)
        camera = shrink_camera(Config().optics.camera, 4)
        tables["optics"]["camera"] = camera.model_dump(exclude_none=True)
        write_tables(folder, tables)
    if is_filled:
        config = load_toml(folder / "lab.toml", Config)
        bench.use_mirror(virtual_bench.VirtualBench(plant.Plant(config.twin, config.pump)))
    return run_stages(folder, bench, person, *names, plan=plan), person


@pytest.mark.timeout(1800)
def test_a_session_with_pictures_tuning_and_an_hour(tmp_path: Path) -> None:
    code, person = run_on_twin(tmp_path)
    assert code == Exit.DONE, person.text
    found = checks_of(tmp_path)
    assert found["held"].measured == "60 min"
    assert found["tuning"].verdict == CheckVerdict.PASSED
    assert not [check for check in found.values() if check.verdict == CheckVerdict.FAILED]


@pytest.mark.parametrize("bench", BENCHES, ids=lambda bench: bench.name)
def test_a_foreign_bench_at_its_depth(bench: Bench, tmp_path: Path) -> None:
    """Leak and hold are judged as they are, whichever pump and laser there are."""
    emulated = QuickBench()
    emulated.use_mirror(foreign_bench(bench.plant(1)))
    person = Person(**{"mirror.pump_ml_per_s": "6"})
    run_stages(tmp_path, emulated, person, *DESK)
    config = bench.config()
    tables = read_tables(tmp_path)
    tables["pump"] = config.pump.model_dump(exclude_none=True)
    tables["loop"] = config.loop.model_dump(exclude_none=True)
    write_tables(tmp_path, tables)
    person = Person(**{"leak.after": "continue", "hold.after": "continue"})
    run_stages(tmp_path, emulated, person, "leak", "hold", plan=SHORT)
    found = checks_of(tmp_path)
    leak_um_per_s = float(found["leak at the held depth"].measured.split()[0])
    assert leak_um_per_s == pytest.approx(bench.leak_um_per_s, rel=LEAK_REL), person.text
    assert found["faults during the hold"].verdict == CheckVerdict.PASSED, person.text
    std = found["standard deviation of the error during the hold"]
    within = float(std.measured.split()[0]) <= 1.0
    assert (std.verdict == CheckVerdict.PASSED) == within


def test_a_film_of_another_law_is_refused_with_its_remedy(tmp_path: Path) -> None:
    """Two fifths of its pressure are tension: at a tenth of the depth the gauge shows 20 Pa more
    than the configured film needs."""
    foreign = ForeignPlant(ForeignPump("top unreachable", full_um_per_s=88.0), seed=2)
    foreign.lower(500.0)
    emulated = QuickBench()
    emulated.use_mirror(foreign_bench(foreign))
    run_stages(tmp_path, emulated, Person(), *DESK)
    person = Person()
    assert run_stages(tmp_path, emulated, person, "inflation", plan=SHORT) == Exit.INTERRUPTED
    assert "laser_gauge_apart" in person.text
    assert "for another film set [optics.mirror" in person.text
    assert emulated.bench.board.pump_fraction == 0.0


def test_an_unstated_dead_zone_fills_the_mirror(tmp_path: Path) -> None:
    """The pump gives nothing below a tenth of its drive, and was stated as proportional: the loop
    finds the command.
    """
    foreign = ForeignPlant(ForeignPump("straight", full_um_per_s=88.0), seed=2, tension_share=0.0)
    foreign.lower(500.0)
    emulated = QuickBench()
    emulated.use_mirror(foreign_bench(foreign))
    run_stages(tmp_path, emulated, Person(), *DESK)
    person = Person()
    run_stages(tmp_path, emulated, person, "inflation", plan=SHORT)
    assert "holding 37.10 mm" in person.text
    record = state_of(tmp_path).find_record("inflation")
    assert record is not None, person.text
    assert not record.failed


def test_a_laser_at_the_wrong_depth_is_refused(tmp_path: Path) -> None:
    foreign = ForeignPlant(
        ForeignPump("top unreachable", full_um_per_s=88.0), seed=2, tension_share=0.0
    )
    foreign.lower(6000.0)
    emulated = QuickBench()
    emulated.use_mirror(foreign_bench(foreign))
    run_stages(tmp_path, emulated, Person(), *DESK)
    emulated.bench.wrong.laser_offset_um = 8000.0  # mounted 8 mm too far away
    person = Person()
    run_stages(tmp_path, emulated, person, "inflation", plan=SHORT)
    record = state_of(tmp_path).find_record("inflation")
    assert record is None  # must pass before the next stage
    assert "find which of them is wrong: laser mount" in person.text
    assert emulated.bench.board.pump_fraction == 0.0


if __name__ == "__main__":
    where = Path(sys.argv[1])
    where.mkdir(parents=True, exist_ok=True)
    filled = len(sys.argv) > 2 and "inflation" not in sys.argv
    ended, seen = run_on_twin(where, *sys.argv[2:], plan=SHORT, is_filled=filled)
    print(seen.text)
    sys.exit(ended)
