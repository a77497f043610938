"""`modes`: what a person reads of the mirror's vibrations, from sets and from runs; files that are
none.
"""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from membrane_ctrl.cli import run as command_line
from membrane_ctrl.model.errors import Exit
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from membrane_ctrl.review.statistics import modes_run
from tests.worlds.vibrating_mirror import THREE_RATES, Planted, watched

CALM = 1e-3 * np.random.default_rng(0).normal(size=(900, ZERNIKE_TERMS))


def tracked(folder: Path, **world: object) -> list[Planted]:
    """A folder with the result of `track`."""
    time_s, coeffs_um, planted = watched(**world)  # type: ignore[arg-type]
    folder.mkdir()
    np.savez(folder / "track.npz", time_s=time_s, coeffs_um=coeffs_um)
    return planted


def test_a_set_gives_a_table_a_picture_and_a_recording(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    planted = tracked(tmp_path / "set", seed=5, lines_hz=(27.0, 48.0), seconds=120.0)
    assert command_line(["modes", str(tmp_path / "set"), "--json"]) == Exit.DONE
    table = json.loads(capsys.readouterr().out)
    assert table == json.loads((tmp_path / "set/modes/modes.json").read_text())
    assert table["searches"] == 2
    seen = sorted(mode["frequency_hz"] for mode in table["modes"])
    assert seen == pytest.approx(sorted(mode.frequency_hz for mode in planted), abs=0.02)
    assert (tmp_path / "set/modes/modes.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "set/modes/modes.rrd").stat().st_size > 10_000


def test_a_mode_that_moves_within_a_week_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Eight runs, a minute of each, the last ones with a film that has lost 3 % of its tension."""
    runs = {}
    for day in range(8):
        line_hz = 48.3 if day < 4 else 48.3 * 0.985
        time_s, coeffs_um, _ = watched(seed=6, lines_hz=(line_hz,), rates_hz=THREE_RATES)
        shapes = SimpleNamespace(
            time_s=time_s, coeffs_um=coeffs_um, verdict=np.full(time_s.size, "ok", "<U8")
        )
        shapes.verdict[::50] = "rejected"
        shapes.coeffs_um[::50] = 1e6
        runs[tmp_path / str(day)] = SimpleNamespace(
            shapes=lambda found=shapes: found, origin_utc=datetime(2026, 11, 1 + day, tzinfo=UTC)
        )
    monkeypatch.setattr(modes_run, "is_run", lambda folder: True)
    monkeypatch.setattr(modes_run, "open_run", runs.__getitem__)
    assert (
        modes_run.modes_command(tuple(runs), tmp_path / "out", as_json=False, pictures=False) == 0
    )
    output = capsys.readouterr().out
    assert "it moved by -1.5%: the film's tension by -3.0%" in output
    assert output.count("mode  ") == 1


@pytest.mark.parametrize(("searches", "seen", "modes"), [(5, 2, 0), (5, 3, 1), (4, 2, 1)])
def test_a_mode_is_in_at_least_half_of_the_searches(searches: int, seen: int, modes: int) -> None:
    line = SimpleNamespace(frequency_hz=48.3, evidence=1.0, is_like=lambda other: True)
    found = [(line,)] * seen + [()] * (searches - seen)
    usual, passing = modes_run._group_lines(np.arange(searches, dtype=float), found)  # type: ignore[arg-type]
    assert len(usual) == modes
    assert passing == (0 if modes else seen)


def test_a_run_without_vibrations_is_reported_as_such(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tracked(tmp_path / "set", seed=1, lines_hz=())
    assert command_line(["modes", str(tmp_path / "set")]) == Exit.DONE
    assert "none that stands out of the noise" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arrays", "code", "message"),
    [
        (None, Exit.BAD_INPUT, "neither a run nor the result of `membrane-ctrl track`"),
        ({"time_s": np.arange(5.0)}, Exit.BAD_INPUT, "lacks an array"),
        (
            {"time_s": np.arange(9.0), "coeffs_um": np.zeros((9, 4))},
            Exit.BAD_INPUT,
            f"9 x 4 numbers where times x terms are 9 x {ZERNIKE_TERMS}",
        ),
        (
            {"time_s": np.array([]), "coeffs_um": np.zeros((0, ZERNIKE_TERMS))},
            Exit.REJECTED,
            "no usable figures",
        ),
        (
            {"time_s": np.arange(90.0), "coeffs_um": np.zeros((90, ZERNIKE_TERMS))},
            Exit.REJECTED,
            "4 a second are needed",
        ),
        (
            {"time_s": np.arange(90) / 20, "coeffs_um": np.zeros((90, ZERNIKE_TERMS))},
            Exit.REJECTED,
            "less than 20 s",
        ),
        (
            {"time_s": np.full(900, 7.0), "coeffs_um": np.zeros((900, ZERNIKE_TERMS))},
            Exit.REJECTED,
            "less than 20 s",
        ),
        (
            {"time_s": np.arange(900) / 20, "coeffs_um": np.zeros((900, ZERNIKE_TERMS))},
            Exit.DONE,
            "",
        ),
        (
            {"time_s": np.full(9, np.nan), "coeffs_um": np.full((9, ZERNIKE_TERMS), np.inf)},
            Exit.REJECTED,
            "no usable figures",
        ),
        (
            {"time_s": np.arange(900) / 20, "coeffs_um": np.full((900, ZERNIKE_TERMS), 1e308)},
            Exit.REJECTED,
            "no usable figures",
        ),
        (
            {"time_s": np.arange(900) / 20 + 1e15 * (np.arange(900) > 450), "coeffs_um": CALM},
            Exit.DONE,
            "",
        ),
        (
            {"time_s": np.arange(900) / 20 + 1e18, "coeffs_um": CALM},
            Exit.REJECTED,
            "less than 20 s",
        ),
    ],
)
def test_what_shows_no_vibrations_is_one_line(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arrays: dict[str, np.ndarray] | None,
    code: Exit,
    message: str,
) -> None:
    if arrays is not None:
        np.savez(tmp_path / "track.npz", **arrays)
    assert command_line(["modes", str(tmp_path)]) == code
    errors = [
        line for line in capsys.readouterr().err.splitlines() if line.startswith("membrane-ctrl: ")
    ]
    assert len(errors) == (code != Exit.DONE)
    assert all(message in line for line in errors)
    assert (tmp_path / "modes").exists() == (code == Exit.DONE)
