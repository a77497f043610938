"""`calibrate --live` on a hold in virtual time: aborted, continued, with a bad set, and adopted."""

from __future__ import annotations

import io
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from live_bench import CAMERA, TRUE, LiveBench, config

from membrane_ctrl.calibration import live as command
from membrane_ctrl.cli import run
from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.geometry.file import read_geometry
from membrane_ctrl.model.telemetry import ShapeState

WORDS = ["calibrate", "--live", "--no-pictures"]
OLD = "a_mm = 2672.0\nb_mm = 2871.0\nalpha_deg = 80.9\n"


@pytest.fixture
def bench(tmp_path: Path) -> LiveBench:
    place = tmp_path / "bench.toml"
    place.write_text(OLD)
    return LiveBench(tmp_path / "run", config(place))


@pytest.fixture
def live(bench: LiveBench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The command line on the bench instead of a running hold."""

    @contextmanager
    def link(*_: object, **__: object) -> Iterator[LiveBench]:
        yield bench

    monkeypatch.setattr(command, "live_hold", link)
    return [*WORDS, "--logs", str(tmp_path / "logs")]


def session_in(tmp_path: Path) -> Path:
    return next((tmp_path / "logs" / "calibration").iterdir())


def answer(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    monkeypatch.setattr("sys.stdin", Terminal(text))


def test_from_a_hold_to_a_geometry_with_an_abort_and_a_bad_set_on_the_way(
    bench: LiveBench,
    live: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bench.interrupt_at = 2
    answer(monkeypatch, "y\n")
    assert run([*live, "--range-um", "4000", "--sets", "3"]) == 130
    printed = capsys.readouterr().err
    assert "3 of 3 sets from -2000 to 2000 µm" in printed
    assert "a figure after these sets: sag +-" in printed
    assert "limits.gauge_pressure_max_pa allow" in printed
    session = session_in(tmp_path)
    assert f"continue with --session {session}" in printed
    assert [path.name for path in (session / "sets").iterdir()] == ["set-1"]
    row = bench.hold.rows[-1]
    assert row.target_um == 0.0  # where it was
    assert abs(row.displacement_um) < 5.0
    assert row.shape_state != ShapeState.OFF  # as it was
    assert (tmp_path / "bench.toml").read_text() == OLD

    bench.config = bench.config.model_copy(
        update={"optics": OpticsConfig(camera=CAMERA, geometry=TRUE)}
    )
    assert run([*live, "--session", str(session), "--yes"]) == 2
    assert "set-1: camera or geometry differs from that of run" in capsys.readouterr().err
    bench.config = bench.hold.config
    bench.fails = ["rejected: somebody walked by"]
    answer(monkeypatch, "y\nno\n")
    assert run([*live, "--session", str(session)]) == 0
    printed = capsys.readouterr()
    assert "2 of 3 sets" in printed.err
    assert bench.captures == 2 + 3  # the bad one again, not the one that was there
    assert bench.hold.rows[-1].target_um == 0.0
    assert not [row for row in bench.hold.rows if row.fault]
    assert "not adopted; `membrane-ctrl calibrate --live --session" in printed.err
    assert (tmp_path / "bench.toml").read_text() == OLD

    monkeypatch.setattr(command, "live_hold", None)  # all sets are there: no hold is needed
    assert run([*live, "--session", str(session), "--yes"]) == 0
    printed = capsys.readouterr()
    new = tomllib.loads((tmp_path / "bench.toml").read_text())
    assert new["geometry"]["reference_displacement_um"] == 0.0
    found = {name: (value, sigma) for name, value, sigma in rows_of(printed.out)}
    for name, true, known in (("a_mm", 2.0, 2.0), ("b_mm", -2.0, 2.0), ("alpha_deg", 0.3, 0.3)):
        value, sigma = found[name]
        assert abs(value - true) < 4 * sigma, name
        assert sigma < known, name
    assert "in use: by hand" in printed.err
    assert (
        f"adopted: {tmp_path / 'bench.toml'}; the previous one is {tmp_path / 'bench-'}"
        in printed.err
    )
    assert next(tmp_path.glob("bench-*.toml")).read_text() == OLD
    assert read_geometry(tmp_path / "bench.toml").origin.calibrated_utc


def rows_of(report: str) -> Iterator[tuple[str, float, float]]:
    for line in report.splitlines():
        words = line.split()
        if len(words) > 3 and words[0] in ("a_mm", "b_mm", "alpha_deg"):
            yield words[0], float(words[1]), float(words[2])


def test_a_set_that_is_bad_twice_ends_it_and_the_mirror_comes_back(
    bench: LiveBench, live: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench.fails = ["camera: no trigger", "camera: no trigger"]
    assert run([*live, "--range-um", "1000", "--sets", "2", "--yes"]) == 3
    assert "no good set in two attempts: camera: no trigger" in capsys.readouterr().err
    assert abs(bench.hold.rows[-1].displacement_um) < 5.0
    assert not list((session_in(tmp_path) / "sets").glob("*"))


def test_a_fault_on_the_way_is_left_to_the_safety_table(
    bench: LiveBench, live: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench.dark_at = 1
    assert run([*live, "--range-um", "1000", "--sets", "2", "--yes"]) == 4
    printed = capsys.readouterr().err
    assert "the mirror is not held, but in state fault (" in printed
    assert "the mirror is left to the client in command; the shape loop is off" in printed
    assert (
        bench.asked[-1].value == 500.0
    )  # on its way to the second set; no command after the fault


def test_who_cannot_wait_for_the_way_back_leaves_the_hold_on_it(
    bench: LiveBench, live: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    bench.interrupt_at = 1
    bench.interrupts_again = True
    assert run([*live, "--range-um", "1000", "--sets", "2", "--yes"]) == 130
    printed = capsys.readouterr().err
    assert "left: the hold continues its ramp to 0 µm; then switch the shape loop on" in printed
    assert bench.hold.rows[-1].target_um == 0.0
    assert bench.hold.rows[-1].displacement_um < -100.0


def test_setpoints_that_are_out_of_reach_now_are_refused(
    bench: LiveBench, live: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench.fails = ["camera: no trigger"] * 2
    assert run([*live, "--range-um", "2000", "--sets", "2", "--yes"]) == 3
    bench.config = config(displacement_max_um=500.0)
    assert run([*live, "--session", str(session_in(tmp_path)), "--yes"]) == 2
    assert "the sets from -1000 to 1000 µm are beyond -4440 to 440" in capsys.readouterr().err


def test_nothing_moves_without_a_confirmation(
    bench: LiveBench,
    live: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert run(live) == 2
    assert "confirm with --yes" in capsys.readouterr().err
    answer(monkeypatch, "n\n")
    assert run(live) == 2
    assert "nothing was moved" in capsys.readouterr().err
    assert bench.asked == []
    assert not (tmp_path / "logs").exists()


def test_without_a_camera_nothing_begins(
    bench: LiveBench, live: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    bench.blind = True
    assert run([*live, "--yes"]) == 4
    assert "no shape within 90 s; does this run have a camera" in capsys.readouterr().err
    assert bench.asked == []


def test_somebody_elses_setpoint_ends_it(
    bench: LiveBench, live: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    bench.meddles_at = 3  # after the setpoint of the first set
    assert run([*live, "--range-um", "1000", "--yes"]) == 4
    assert "someone else moved the setpoint to 77 µm" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "or use --live to take them from a running hold"),
        (["--live", "set"], "omit SET... and --out"),
        (["set", "--yes"], "need --live"),
        (["--live", "--free", "nonsense"], "nonsense is not a parameter"),
        (["--live", "--session", "nowhere"], "nowhere/session.json"),
        (["--live", "--session", "nowhere", "--sets", "3"], "omit --range-um and --sets"),
    ],
)
def test_bad_usage(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["calibrate", *words]) == 2
    printed = capsys.readouterr().err
    assert message in printed
    assert len(printed.splitlines()) == 1


def test_no_hold_is_running(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run([*WORDS, "--logs", str(tmp_path), "--yes"]) == 4
    assert "no hold is listening" in capsys.readouterr().err
