"""The calibrate command from folders to a geometry that `measure` uses."""

from __future__ import annotations

import io
import json
import shutil
import tomllib
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w

from membrane_ctrl.calibration import calibrate, sets
from membrane_ctrl.cli import run
from membrane_ctrl.config.schema import CameraConfig, GeometryConfig, MirrorConfig, OpticsConfig
from membrane_ctrl.geometry.set_tables import move_screen
from membrane_ctrl.metrology.calibration.verdict import CalibrationFinding
from membrane_ctrl.sim.optics.bench_poses import ScreenError
from membrane_ctrl.sim.optics.film_shape import FilmShape, typical_film
from membrane_ctrl.sim.optics.simulate import simulate_set
from membrane_ctrl.sim.optics.simulation_spec import Motion, SimulationSpec, make_artefact_shape

# 16-bit frames of large pixels, each with the noise of the 256 of the paper's camera that it stands
# for
SHRINK = 16
NOISE = 256 * float(np.hypot(0.4, np.sqrt(1 / 12))) / SHRINK
CAMERA = CameraConfig(
    width_px=2448 // SHRINK,
    height_px=2048 // SHRINK,
    pixel_um=3.45 * SHRINK,
    bits=16,
    noise_adu=NOISE,
)
STATED = GeometryConfig(a_mm=2672.0, b_mm=2871.0, alpha_deg=80.9)
TRUE = GeometryConfig(a_mm=2674.0, b_mm=2869.0, alpha_deg=81.2, reference_displacement_um=0.0)
FILM = typical_film(37.1, 500.0, seed=1)
LEANS = ScreenError(0.5, -0.5)
MOVED_UM = (-4000.0, -2000.0, 0.0, 2000.0, 4000.0)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    root = tmp_path_factory.mktemp("calibrate")
    stated = STATED.model_copy(update={"reference_displacement_um": 0.0})
    for k, moved_um in enumerate(MOVED_UM):
        spec = SimulationSpec(
            OpticsConfig(geometry=TRUE, camera=CAMERA),
            FILM,
            motion=Motion(start_um=moved_um),
            laser_noise_um=1.0,
            stated_geometry=stated,
            screen_error=LEANS,
            seed=k + 1,
        )
        simulate_set(root / f"set{k}", spec)
    return [root / f"set{k}" for k in range(len(MOVED_UM))]


@pytest.fixture(scope="module")
def calibrated(folders: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of their calibration, beside `geometry.toml` and a picture."""
    out = tmp_path_factory.mktemp("calibrated")
    captured = io.StringIO()
    with redirect_stdout(captured):
        assert (
            run(["calibrate", *map(str, folders), "--out", str(out / "geometry.toml"), "--json"])
            == 0
        )
    (out / "report.json").write_text(captured.getvalue())
    return out / "report.json"


def figure_error_um(height: Path, truth: Path) -> float:
    """RMS error without the best plane; the truth is the twin's film at the measured points."""
    measured, moved = np.load(height), float(np.load(truth)["displacement_um"][0])
    x, y = np.meshgrid(measured["x_mm"], measured["y_mm"])
    seen = np.isfinite(measured["h_mm"])
    error = measured["h_mm"][seen] - FILM.height_mm(x[seen], y[seen], moved)
    plane = np.stack([np.ones(seen.sum()), x[seen], y[seen]], axis=1)
    return 1e3 * float(np.std(error - plane @ np.linalg.lstsq(plane, error, rcond=None)[0]))


def test_from_folders_to_a_better_figure(
    folders: list[Path], calibrated: Path, tmp_path: Path
) -> None:
    out, report = calibrated.with_name("geometry.toml"), json.loads(calibrated.read_text())
    assert report["verdict"] == "ok"
    assert report["findings"] == []
    assert calibrated.with_name("geometry-residuals.png").stat().st_size > 10_000
    assert report["hash"] == tomllib.loads(out.read_text())["calibration"]["hash"]
    found = {row["name"]: row for row in report["parameters"]}
    for name, true in (
        ("a_mm", 2.0),
        ("alpha_deg", 0.3),
        ("screen_turn_x_deg", 0.5),
        ("screen_turn_y_deg", -0.5),
    ):
        # the signs of the twin's turns are the parameters' but for the rows' own sense
        assert abs(abs(found[name]["value"]) - abs(true)) < 4 * found[name]["sigma"], name
        assert found[name]["sigma"] < found[name]["sigma_before"], name
    assert (
        found["focal_relative"]["sigma"] < 0.1 * found["focal_relative"]["sigma_before"]
    )  # lens and screen are free
    before, after = (tmp_path / name for name in ("before", "after"))
    assert run(["measure", str(folders[2]), "--out", str(before), "--no-pictures"]) == 0
    assert (
        run(
            [
                "measure",
                str(folders[2]),
                "--geometry",
                str(out),
                "--out",
                str(after),
                "--no-pictures",
            ]
        )
        == 0
    )
    used = json.loads((after / "result.json").read_text())["geometry"]
    assert (used["hash"], used["file"]) == (report["hash"], str(out))
    truth = folders[2] / "truth.npz"
    assert figure_error_um(before / "height.npz", truth) > 10
    claimed = json.loads((after / "result.json").read_text())["uncertainty"]["figure_rms_um"]
    assert figure_error_um(after / "height.npz", truth) < 2 * claimed < 12


@pytest.mark.usefixtures("undrawn")
def test_uncertainty_draws_from_the_file(
    folders: list[Path], calibrated: Path, tmp_path: Path
) -> None:
    out, where = calibrated.with_name("geometry.toml"), tmp_path / "uncertainty"
    words = [
        "uncertainty",
        str(folders[2]),
        "--geometry",
        str(out),
        "--out",
        str(where),
        "--trials",
        "20",
    ]
    assert run([*words, "--workers", "1"]) == 0
    assert where.is_dir()


def test_the_ring_in_the_picture_gives_the_pose_of_the_camera(
    folders: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pose, out = tmp_path / "pose.toml", tmp_path / "geometry.toml"
    assert run(["calibrate-pose", str(folders[2]), "--out", str(pose), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert abs(found["values"]["a_mm"] - 2.0) < 3 * found["sigmas"]["a_mm"]
    assert found["sigmas"]["camera_pitch_deg"] < 0.01
    words = [
        "calibrate",
        *map(str, folders[::2]),
        "--prior",
        str(pose),
        "--out",
        str(out),
        "--json",
        "--no-pictures",
    ]
    assert run(words) == 0
    report = json.loads(capsys.readouterr().out)
    pitch = next(row for row in report["parameters"] if row["name"] == "camera_pitch_deg")
    assert pitch["sigma_before"] == found["sigmas"]["camera_pitch_deg"]
    assert abs(pitch["value"]) < 4 * pitch["sigma_before"]  # the pose is now the stated one


def test_a_rejected_calibration_leaves_the_old_geometry(
    folders: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "geometry.toml"
    out.write_text("old")
    backwards = []
    for k, folder in enumerate(folders[:3]):
        copy = tmp_path / f"set{k}"
        shutil.copytree(folder, copy)
        text = (copy / "capture.toml").read_text()
        lines = [
            f"displacement_um = {-float(line.split('=')[1])}"
            if line.startswith("displacement_um")
            else line
            for line in text.splitlines()
        ]
        (copy / "capture.toml").write_text("\n".join(lines))
        backwards.append(copy)
    assert run(["calibrate", *map(str, backwards), "--out", str(out)]) == 3
    printed = capsys.readouterr()
    assert "the laser counts the wrong way" in printed.out
    assert "old geometry remains in use" in printed.err
    assert out.read_text() == "old"


def test_a_set_with_a_bad_frame_is_used_with_a_word(
    folders: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spoilt = tmp_path / "spoilt"
    shutil.copytree(folders[4], spoilt)
    shutil.copy(
        spoilt / "x_sin_1.png", spoilt / "x_sin_2.png"
    )  # as from a camera that was not triggered
    words = [
        "calibrate",
        str(folders[0]),
        str(folders[2]),
        str(spoilt),
        "--out",
        str(tmp_path / "g.toml"),
    ]
    assert run([*words, "--json", "--no-pictures"]) == 0
    report = json.loads(capsys.readouterr().out)
    (finding,) = report["findings"]
    assert not finding["fatal"]
    assert finding["description"].startswith("spoilt: x_sin_2.png omitted: "), finding


def test_one_pressure_is_not_enough(
    folders: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["calibrate", str(folders[0]), "--out", str(tmp_path / "g.toml"), "--json"]) == 3
    assert "only 0 µm apart" in json.loads(capsys.readouterr().out)["findings"][0]["description"]


def test_sets_of_different_rigs_are_named(
    folders: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other"
    shutil.copytree(folders[1], other)
    text = (other / "capture.toml").read_text().replace("a_mm = 2672.0", "a_mm = 2600.0")
    (other / "capture.toml").write_text(text)
    assert run(["calibrate", str(folders[0]), str(other), "--out", str(tmp_path / "g.toml")]) == 2
    assert "other/capture.toml: geometry.a_mm: differs from" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--free", "radius_mm"], "radius_mm is not a parameter"),
        (["--free", "bow_mm=wide"], "wide is not a number"),
        (["--free", "bow_mm=-1"], "a sigma must be above 0"),
        (
            ["--free", "focal_relative=0"],
            "nothing is exact: state how well focal_relative is known",
        ),
    ],
)
def test_wrong_options_are_named(
    folders: list[Path], capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert run(["calibrate", str(folders[0]), *arguments]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.usefixtures("undrawn")
def test_the_report_notes_sets_that_state_different_references(
    folders: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Simulated sets without a common reference are of different benches, and the refusal named a
    creeping camera.
    """
    other = tmp_path / "other"
    shutil.copytree(folders[0], other)
    text = (other / "capture.toml").read_text()
    assert "reference_displacement_um = 0.0" in text
    (other / "capture.toml").write_text(
        text.replace("reference_displacement_um = 0.0", "reference_displacement_um = -4000.0")
    )
    run(["calibrate", str(folders[2]), str(other), "--out", str(tmp_path / "geometry.toml")])
    captured = capsys.readouterr()
    assert (
        "the sets state reference_displacement_um from -4000 to 0 µm" in captured.out + captured.err
    )
    run(["calibrate", str(folders[2]), str(folders[0]), "--out", str(tmp_path / "geometry.toml")])
    captured = capsys.readouterr()
    assert "the sets state" not in captured.out + captured.err


def test_a_refusal_of_sets_with_different_references_names_these_first() -> None:
    crept, wide = (
        CalibrationFinding(True, "camera or screen crept", (1,)),
        CalibrationFinding(False, "wide"),
    )
    bundle = sets.Bundle((), OpticsConfig(), 0.0, ("no rim",), "the sets state two references")
    found = calibrate._judge_sets([crept, wide], bundle)
    assert [(each.fatal, each.description) for each in found] == [
        (True, "the sets state two references; if it was not: camera or screen crept"),
        (False, "wide"),
        (False, "no rim"),
    ]
    assert found[0].sets == (1,)
    one = calibrate._judge_sets([crept], replace(bundle, bench_doubt=""))
    assert [each.description for each in one] == ["camera or screen crept", "no rim"]


def test_sets_without_a_solution_name_different_references_first(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bundle = sets.Bundle((), OpticsConfig(), 0.0, ("no rim",), "the sets state two references")

    def fail(*_: object) -> None:
        raise ValueError("no solution")

    monkeypatch.setattr(calibrate, "read_sets", lambda *_: bundle)
    monkeypatch.setattr(calibrate, "problem_of", lambda *_: None)
    monkeypatch.setattr(calibrate.verdict, "check_before_solving", lambda _: ())
    monkeypatch.setattr(calibrate, "solve_any_film", fail)
    assert run(["calibrate", str(tmp_path), "--json", "--out", str(tmp_path / "new.toml")]) == 3
    findings = json.loads(capsys.readouterr().out)["findings"]
    assert [finding["description"] for finding in findings] == [
        "the sets state two references; if it was not: no solution",
        "no rim",
    ]


def test_a_set_given_twice_is_refused(
    folders: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["calibrate", str(folders[0]), str(folders[0])]) == 2
    assert "given twice" in capsys.readouterr().err


def set_of(folder: Path, film: FilmShape, mirror: MirrorConfig | None = None, **more: Any) -> Path:
    """One more set of the bench of `folders`."""
    optics = OpticsConfig(geometry=TRUE, camera=CAMERA, mirror=mirror or MirrorConfig())
    stated = STATED.model_copy(update={"reference_displacement_um": 0.0})
    simulate_set(
        folder, SimulationSpec(optics, film, stated_geometry=stated, screen_error=LEANS, **more)
    )
    return folder


SPHERE = {
    "form": "sphere",
    "curvature_radius_mm": 3400.0,
    "curvature_radius_sigma_mm": 0.34,
    "vertex_sigma_mm": 0.05,
}


@pytest.fixture(scope="module")
def sphere(tmp_path_factory: pytest.TempPathFactory) -> Path:
    shape = make_artefact_shape(3400.0, 450.0, 1e-3, -5e-4)
    mirror = MirrorConfig(radius_mm=450.0, analysis_radius_mm=440.0)
    return set_of(
        tmp_path_factory.mktemp("known") / "sphere", shape, mirror, artefact=SPHERE, laser=False
    )


def test_a_sphere_beside_the_film_sharpens_the_sag(
    folders: list[Path],
    sphere: Path,
    calibrated: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    alone = json.loads(calibrated.read_text())
    assert alone["artefact_advice"]["sag_um"] < 0.5 * alone["uncertainty"]["sag_um"]
    out = tmp_path / "g.toml"
    assert (
        run(
            [
                "calibrate",
                str(sphere),
                str(folders[2]),
                "--out",
                str(out),
                "--json",
                "--no-pictures",
            ]
        )
        == 0
    )
    report = json.loads(capsys.readouterr().out)
    assert [row["surface"] for row in report["sets"]] == ["sphere", "film"]
    assert report["uncertainty"]["sag_um"] < 0.5 * alone["uncertainty"]["sag_um"]
    found = {row["name"]: row for row in report["parameters"]}
    for name, true in (
        ("a_mm", 2.0),
        ("b_mm", -2.0),
        ("focal_relative", 0.0),
        ("pitch_relative", 0.0),
    ):
        assert abs(found[name]["value"] - true) < 4 * found[name]["sigma"], name
    assert tomllib.loads(out.read_text())["calibration"]["sets"] == ["sphere", "set2"]


@pytest.mark.parametrize(
    ("was", "becomes", "message"),
    [
        (
            "curvature_radius_sigma_mm = 0.34",
            "",
            "artefact.curvature_radius_sigma_mm: a sphere needs it",
        ),
        ('form = "sphere"', 'form = "flat"', "artefact.curvature_radius_mm: a flat has none"),
        (
            "curvature_radius_mm = 3400.0",
            "curvature_radius_mm = 400.0",
            "must exceed mirror.radius_mm",
        ),
        ('form = "sphere"', 'form = "cone"', "artefact.form"),
    ],
)
def test_an_artefact_that_is_not_described_is_refused(
    sphere: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    was: str,
    becomes: str,
    message: str,
) -> None:
    text = (sphere / "capture.toml").read_text()
    assert was in text
    (tmp_path / "capture.toml").write_text(text.replace(was, becomes))
    assert run(["calibrate", str(tmp_path), "--out", str(tmp_path / "g.toml")]) == 2
    assert message in capsys.readouterr().err


def test_artefacts_alone_are_refused(
    sphere: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["calibrate", str(sphere), "--out", str(tmp_path / "g.toml")]) == 2
    assert "a calibration needs a set of the film" in capsys.readouterr().err
    assert run(["film", str(sphere), "--out", str(tmp_path / "film")]) == 2
    assert "sphere/capture.toml: artefact: a set of no film" in capsys.readouterr().err


SHIFT_MM = (0.0, 0.0, -300.0)


@pytest.fixture(scope="module")
def far_and_near(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The film with the screen further away, and the screen itself, tilted to two sides."""
    root, rail = (
        tmp_path_factory.mktemp("screens"),
        {"shift_mm": list(SHIFT_MM), "shift_sigma_mm": 0.05},
    )
    stated = STATED.model_copy(update={"reference_displacement_um": 0.0})
    there = move_screen(TRUE, (0.03, -0.04, -299.95))
    spec = SimulationSpec(
        OpticsConfig(geometry=there, camera=CAMERA),
        FILM,
        motion=Motion(start_um=1.5),
        stated_geometry=stated,
        screen_error=LEANS,
        screen_moved=rail,
        seed=11,
    )
    simulate_set(root / "far", spec)
    truth, hand, pixels = (
        root / "truth.toml",
        root / "hand.toml",
        CAMERA.model_dump(exclude_none=True),
    )
    truth.write_text(
        tomli_w.dumps(
            {"optics": {"geometry": TRUE.model_dump(exclude_none=True), "camera": pixels}}
        )
    )
    hand.write_text(tomli_w.dumps({"geometry": stated.model_dump(exclude_none=True)}))
    for seed in ("5", "8"):
        words = [
            "--config",
            str(truth),
            "--stated",
            str(hand),
            "--artefact",
            "screen:900",
            "--seed",
            seed,
        ]
        assert run(["simulate", str(root / f"screen{seed}"), *words]) == 0
    return [root / "far", root / "screen5", root / "screen8"]


@pytest.mark.usefixtures("undrawn")
def test_a_moved_screen_and_the_screen_itself_sharpen_the_sag(
    folders: list[Path],
    far_and_near: list[Path],
    calibrated: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    sets = [*map(str, far_and_near), *map(str, folders)]  # in any order
    assert run(["calibrate", *sets, "--out", str(tmp_path / "g.toml"), "--json"]) == 0
    report, alone = json.loads(capsys.readouterr().out), json.loads(calibrated.read_text())
    assert report["findings"] == []
    assert [row["surface"] for row in report["sets"]] == ["screen", "screen", *["film"] * 5]
    assert all(row["noise_ratio"] < 1.2 for row in report["sets"])
    assert report["uncertainty"]["sag_um"] < 0.65 * alone["uncertainty"]["sag_um"]
    found = {row["name"]: row for row in report["parameters"]}
    for name, true in (
        ("a_mm", 2.0),
        ("b_mm", -2.0),
        ("alpha_deg", 0.3),
        ("focal_relative", 0.0),
        ("bow_mm", 0.0),
    ):
        assert abs(found[name]["value"] - true) < 4 * found[name]["sigma"], name
    assert found["focal_relative"]["sigma"] < 1e-4


@pytest.mark.parametrize(
    ("which", "was", "becomes", "message"),
    [
        (0, "shift_mm", "shift", "screen_moved.shift_mm"),
        (0, "shift_sigma_mm = 0.05", "shift_sigma_mm = 0.0", "screen_moved.shift_sigma_mm"),
        (
            1,
            'form = "screen"',
            'form = "screen"\nvertex_mm = 1.0',
            "the screen itself needs nothing but its form",
        ),
    ],
)
def test_a_screen_that_is_not_described_is_refused(
    far_and_near: list[Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    which: int,
    was: str,
    becomes: str,
    message: str,
) -> None:
    text = (far_and_near[which] / "capture.toml").read_text()
    assert was in text
    (tmp_path / "capture.toml").write_text(text.replace(was, becomes, 1))
    assert run(["calibrate", str(tmp_path), "--out", str(tmp_path / "g.toml")]) == 2
    assert message in capsys.readouterr().err


def test_a_moved_screen_needs_the_film_with_the_screen_in_its_place(
    folders: list[Path],
    far_and_near: list[Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    far, direct = str(far_and_near[0]), str(far_and_near[1])
    for beside in ([], [str(folders[0])], [direct]):
        assert run(["calibrate", far, *beside, "--out", str(tmp_path / "g.toml")]) == 2
        assert "far/capture.toml: screen_moved: needs a set of the film" in capsys.readouterr().err
    assert run(["calibrate", direct, "--out", str(tmp_path / "g.toml")]) == 2
    assert "a calibration needs a set of the film" in capsys.readouterr().err
    assert run(["film", direct, "--out", str(tmp_path / "film")]) in (2, 3)
    assert not (tmp_path / "g.toml").exists()


def test_a_film_that_moves_within_its_sets_calibrates(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A drift that brings the y frames to another bowl than the x frames; the laser saw it, with
    its noise.
    """
    moving = []
    for k, drift_um_per_s in enumerate((12.0, -20.0)):
        motion = Motion(start_um=(-4000.0, 4000.0)[k], drift_um_per_s=drift_um_per_s)
        moving.append(
            set_of(tmp_path / f"{k}", FILM, motion=motion, laser_noise_um=1.0, seed=k + 20)
        )
    words = [
        "calibrate",
        *map(str, moving),
        "--out",
        str(tmp_path / "g.toml"),
        "--json",
        "--no-pictures",
    ]
    assert run(words) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["findings"] == []
    # the fringes see the steps of one axis; the laser's noise of 1 µm leaves ripples of up to five
    # times the noise
    assert all(row["noise_ratio"] < 1.5 for row in report["sets"])
    found = {row["name"]: row for row in report["parameters"]}
    assert abs(found["alpha_deg"]["value"] - 0.3) < 4 * found["alpha_deg"]["sigma"] < 0.08
