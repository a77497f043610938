"""`simulate` and `measure` from the command line: files, exit codes, and one line for every bad
input.
"""

from __future__ import annotations

import json
import re
import shutil
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tomli_w

from membrane_ctrl.cli import run
from membrane_ctrl.config.optics import SigmasConfig
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from tests.support.real_data import SOFAST, WHY_SKIPPED

SMALL = ["--shrink", "8"]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of one full and one fringes set."""
    folder = tmp_path_factory.mktemp("sets") / "run"
    assert run(["simulate", str(folder), *SMALL, "--sets", "2", "--drift-um-per-s", "2.0"]) == 0
    return folder


@pytest.fixture
def capture_set(made: Path, tmp_path: Path) -> Path:
    """A full set to be spoiled."""
    shutil.copytree(made, tmp_path / "run")
    return tmp_path / "run" / "0000"


def rewrite(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change capture.toml."""
    table = tomllib.loads((folder / "capture.toml").read_text())
    change(table)
    (folder / "capture.toml").write_text(tomli_w.dumps(table))


def measured(folder: Path, out: Path, *options: str) -> tuple[int, dict[str, Any]]:
    """Exit code and result.json."""
    code = run(["measure", str(folder), "--out", str(out), "--no-pictures", *options])
    return code, json.loads((out / "result.json").read_text())


def test_a_full_set(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, result = measured(made / "0000", tmp_path, "--json")
    assert code == 0
    assert json.loads(capsys.readouterr().out) == result
    assert result["schema"] == "membrane-result/1"
    assert result["zernike"] | {"coeffs_um": None} == {
        "index": "noll",
        "first": 1,
        "normalisation": "rms",
        "radius_mm": 500.0,
        "coeffs_um": None,
    }
    assert len(result["zernike"]["coeffs_um"]) == ZERNIKE_TERMS
    assert result["fit"]["converged"]
    assert result["fit"]["last_change_mm"] <= 1e-6
    assert result["quality"]["verdict"] == "ok"
    assert result["quality"]["flagged_frames"] == []
    assert set(result["timing_s"]) == {"load", "phase", "reconstruct"}
    figure = result["figure"]
    assert set(figure["not_given"]) == {"power_um"}
    assert figure["numbers"]["radius_of_curvature_mm"]["value"] == pytest.approx(3440, abs=10)
    for number in figure["numbers"].values():  # the geometry was measured by hand
        assert 0 < number["sigma_noise"] < number["sigma_geometry"]
    noll, osa, fringe = figure["zernike"]
    assert noll["coeffs_um"] == result["zernike"]["coeffs_um"]
    assert sorted(osa["coeffs_um"]) == sorted(noll["coeffs_um"])
    assert (len(fringe["coeffs_um"]), fringe["radius_mm"]) == (37, 475.0)
    truth, maps = np.load(made / "0000" / "truth.npz"), np.load(tmp_path / "height.npz")
    x, y = np.meshgrid(maps["x_mm"], maps["y_mm"])
    assert maps["h_mm"].shape == (maps["y_mm"].size, maps["x_mm"].size)
    middle = maps["x_mm"].size // 2
    assert maps["x_mm"][middle] == 0.0
    assert maps["h_mm"][middle, middle] == pytest.approx(0.0, abs=1e-12)
    assert np.all(np.isnan(maps["h_mm"][np.hypot(x, y) > 480]))
    inside = np.hypot(*np.meshgrid(truth["x_mm"], truth["y_mm"])) < 450
    columns = np.searchsorted(maps["x_mm"], truth["x_mm"]).clip(0, maps["x_mm"].size - 1)
    near = maps["h_mm"][np.ix_(columns, columns)]
    assert (
        np.nanmax(np.abs(near - truth["h_mm"])[inside]) < 1.5
    )  # a cell beside, on a slope of 0.15: sign and place


def test_a_fringes_set_leans_on_its_reference(made: Path, tmp_path: Path) -> None:
    code, result = measured(made / "0001", tmp_path)
    assert code == 0
    truth = np.load(made / "0001" / "truth.npz")
    _, first = measured(made / "0000", tmp_path / "first")
    deeper_um = np.array(result["zernike"]["coeffs_um"]) - first["zernike"]["coeffs_um"]
    grown_mm = truth["h_mm"][100, 200] - np.load(made / "0000" / "truth.npz")["h_mm"][100, 200]
    # Noll 4 of a Hencky bowl is 0.282 of its sag
    assert deeper_um[3] == pytest.approx(282 * grown_mm, rel=0.05)


def test_pictures_report_and_recording(made: Path, tmp_path: Path) -> None:
    options = ["--out", str(tmp_path), "--rerun", "--report", "--nominal-radius-mm", "3400"]
    assert run(["measure", str(made / "0000"), *options]) == 0
    names = {path.stem for path in tmp_path.glob("*.png")}
    assert names == {
        "frames",
        "sag",
        "residual",
        "slopes",
        "modulation",
        "profile",
        "convergence",
        "uncertainty",
        "figure",
        "star",
    }
    page = (tmp_path / "report.html").read_text()
    assert page.count("<img ") == page.count('src="data:image/png;base64,') == len(names)
    assert not re.search("https?:|<script|<link", page)
    figure = json.loads((tmp_path / "result.json").read_text())["figure"]
    depth = 3400 - np.sqrt(3400**2 - 475**2)
    power_um = figure["numbers"]["power_um"]["value"]
    assert power_um == pytest.approx(
        1e3 * (figure["numbers"]["sphere_sag_mm"]["value"] - depth), abs=1e-6
    )
    number, value = 'data-label="number"', 'data-label="value"'  # for a phone, one cell a line
    assert f"<td {number}>power_um</td><td {value}>{power_um:.6g}</td>" in page
    shown = re.findall(r"<img alt=\"(\w+)\"|<pre>|class=\"(verdict \w+)\"", page)
    assert [name or mark for name, mark in shown][:4] == [
        "verdict good",
        "figure",
        "star",
        "residual",
    ]
    assert page.index('alt="figure"') < page.index("power_um") < page.index("<pre>")
    assert figure["not_given"] == {}
    document = (tmp_path / "report.pdf").read_bytes()
    assert document.startswith(b"%PDF-")
    assert document.count(b"/Type /Page ") >= 1 + len(names) / 2
    maps = np.load(tmp_path / "figure.npz")
    assert np.nanmax(maps["deviation_um"]) - np.nanmin(maps["deviation_um"]) == pytest.approx(
        figure["numbers"]["irregularity_pv_um"]["value"]
    )
    assert (tmp_path / "measurement.rrd").stat().st_size > 10_000
    details = json.loads((tmp_path / "details.json").read_text())
    assert details["hencky_sag_mm"] == pytest.approx(37.1, abs=0.05)
    assert details["pressure_equivalent_pa"] == pytest.approx(600, abs=5)
    assert details["rim"]["offset_mm"] < 3


def test_a_nominal_radius_below_the_apertures_is_refused(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        run(["measure", str(made / "0000"), "--out", str(tmp_path), "--nominal-radius-mm", "-400"])
        == 2
    )
    (line,) = capsys.readouterr().err.splitlines()
    assert line == (
        "membrane-ctrl: --nominal-radius-mm -400: must be larger than the aperture's radius, 475 mm"
    )


@pytest.mark.parametrize("frame", ["x_sin_2.png", "y_gray_3.png", "white.png", "black.png"])
def test_a_missing_picture_is_a_rejection_that_names_it(
    capture_set: Path, tmp_path: Path, frame: str
) -> None:
    (capture_set / frame).unlink()
    code, result = measured(capture_set, tmp_path / "out")
    assert code == 3
    assert result["quality"]["verdict"] == "rejected"
    assert result["quality"]["flagged_frames"] == [
        {"file": frame, "reason": "missing: no such file"}
    ]


def test_a_picture_in_colour_is_rejected_with_the_reason(capture_set: Path, tmp_path: Path) -> None:
    assert cv2.imwrite(str(capture_set / "y_sin_1.png"), np.zeros((256, 306, 3), np.uint8))
    code, result = measured(capture_set, tmp_path / "out")
    assert code == 3
    (flag,) = result["quality"]["flagged_frames"]
    assert flag == {"file": "y_sin_1.png", "reason": "unreadable: 3 colour channels instead of one"}


def test_a_torn_picture_is_a_rejection_that_names_it(capture_set: Path, tmp_path: Path) -> None:
    path = capture_set / "x_sin_0.png"
    path.write_bytes(path.read_bytes()[:300])
    code, result = measured(capture_set, tmp_path / "out")
    assert code == 3
    assert [flag["file"] for flag in result["quality"]["flagged_frames"]] == ["x_sin_0.png"]


@pytest.mark.parametrize(
    ("image", "reason"),
    [
        (np.zeros((255, 306), np.uint8), "wrong size"),
        (np.zeros((256, 306), np.uint16), "wrong bit depth"),
    ],
    ids=["size", "depth"],
)
def test_a_frame_of_another_kind_is_named(
    capture_set: Path, tmp_path: Path, image: np.ndarray, reason: str
) -> None:
    assert cv2.imwrite(str(capture_set / "y_sin_1.png"), image)
    code, result = measured(capture_set, tmp_path / "out")
    assert code == 0
    (flag,) = result["quality"]["flagged_frames"]
    assert flag["file"] == "y_sin_1.png"
    assert reason in flag["reason"]


def test_too_many_bad_frames_are_a_rejection(capture_set: Path, tmp_path: Path) -> None:
    (capture_set / "x_sin_2.png").unlink()
    (capture_set / "x_sin_3.png").write_bytes(b"no image")
    code, result = measured(capture_set, tmp_path / "out")
    assert code == 3
    assert result["quality"]["verdict"] == "rejected"
    assert [flag["file"] for flag in result["quality"]["flagged_frames"]] == [
        "x_sin_2.png",
        "x_sin_3.png",
    ]
    assert not (tmp_path / "out" / "height.npz").exists()


def test_all_pixels_dark_is_a_rejection(capture_set: Path, tmp_path: Path) -> None:
    for path in capture_set.glob("*.png"):
        cv2.imwrite(str(path), np.full((256, 306), 5, np.uint8))
    code, result = measured(capture_set, tmp_path / "out")
    assert code == 3
    assert result["zernike"]["coeffs_um"] == [None] * ZERNIKE_TERMS


def _sixteen(folder: Path) -> None:
    for path in folder.glob("*.png"):
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.uint16) * 257)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (
            lambda f: rewrite(f, lambda t: t["geometry"].update(a_mm=2.672)),
            ["capture.toml", "geometry.a_mm", "100"],
        ),
        (lambda f: rewrite(f, lambda t: t["frames"].pop()), ["capture.toml", "frames", "black"]),
        (lambda f: rewrite(f, lambda t: t["frames"].pop(0)), ["x_sin_0"]),
        (lambda f: rewrite(f, lambda t: t["frames"].append(t["frames"][0])), ["x_sin_0", "twice"]),
        (lambda f: rewrite(f, lambda t: t.update(kind="half")), ["kind"]),
        (lambda f: rewrite(f, lambda t: t.update(schema="other/2")), ["schema"]),
        (
            lambda f: rewrite(f, lambda t: t["camera"].update(width_px=400)),
            ["camera.width_px", "306 x 256"],
        ),
        (
            lambda f: rewrite(f, lambda t: t["geometry"].update(a_mm=float("nan"))),
            ["geometry.a_mm"],
        ),
        (
            lambda f: (_sixteen(f), rewrite(f, lambda t: t["camera"].update(bits=8))),
            ["camera.bits = 8", "16 bit"],
        ),
        (lambda f: (f / "capture.toml").write_text("a = = 1"), ["capture.toml", "TOML"]),
        (lambda f: (f / "capture.toml").unlink(), ["capture.toml", "no such file"]),
        (lambda f: [p.unlink() for p in f.glob("*.png")], ["none of the 18 images"]),
    ],
)
def test_bad_input_is_one_line(
    capture_set: Path,
    capsys: pytest.CaptureFixture[str],
    spoil: Callable[[Path], object],
    words: list[str],
) -> None:
    spoil(capture_set)
    assert run(["measure", str(capture_set)]) == 2
    message = capsys.readouterr().err.strip()
    assert "\n" not in message
    assert all(word in message for word in words), message


def test_16_bit_frames_need_no_declaration(capture_set: Path, tmp_path: Path) -> None:
    _sixteen(capture_set)
    code, result = measured(capture_set, tmp_path / "out")
    assert code == 0
    assert result["quality"]["modulation_median_adu"] > 10_000


def test_a_reference_that_is_not_there(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(made / "0001", tmp_path / "alone")
    assert run(["measure", str(tmp_path / "alone")]) == 2
    assert "no such capture set" in capsys.readouterr().err


@pytest.mark.campaign  # --geometry: test_a_geometry_file_with_a_crooked_screen
def test_another_geometry(made: Path, tmp_path: Path) -> None:
    (tmp_path / "geometry.toml").write_text(
        "[geometry]\na_mm = 2680.0\nb_mm = 2871.0\nalpha_deg = 80.9\n"
    )
    _, own = measured(made / "0000", tmp_path / "own")
    _, other = measured(
        made / "0000", tmp_path / "other", "--geometry", str(tmp_path / "geometry.toml")
    )
    assert other["zernike"]["coeffs_um"][3] != pytest.approx(
        own["zernike"]["coeffs_um"][3], abs=1.0
    )


@pytest.mark.parametrize("alpha_deg", [30.0, 1.41])
def test_a_geometry_that_cannot_be_is_refused_with_the_file_that_states_it(
    capture_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], alpha_deg: float
) -> None:
    file = tmp_path / "geometry.toml"
    file.write_text(f"[geometry]\na_mm = 2672.0\nb_mm = 2871.0\nalpha_deg = {alpha_deg}\n")
    assert run(["measure", str(capture_set), "--geometry", str(file)]) == 2
    assert capsys.readouterr().err.startswith(
        f"membrane-ctrl: {file}: geometry.alpha_deg: the pattern ("
    )
    rewrite(capture_set, lambda t: t["geometry"].update(alpha_deg=alpha_deg))
    assert run(["measure", str(capture_set)]) == 2
    (output,) = capsys.readouterr().err.splitlines()
    assert output.startswith(
        f"membrane-ctrl: {capture_set / 'capture.toml'}: geometry.alpha_deg: the pattern ("
    )


def test_unknown_keys_are_reported_and_ignored(
    capture_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rewrite(capture_set, lambda t: t["camera"].update(gain_db=3))
    code, _ = measured(capture_set, tmp_path / "out")
    assert code == 0
    assert "camera.gain_db" in capsys.readouterr().err


def test_simulate_refuses_what_cannot_be(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["simulate", str(tmp_path / "a"), *SMALL, "--fault", "eaten:x_sin_0"]) == 2
    assert "eaten" in capsys.readouterr().err
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    assert run(["simulate", str(tmp_path / "full"), *SMALL]) == 2
    assert "not empty" in capsys.readouterr().err


@pytest.mark.campaign  # test_tutorial.py does the same with a stale x_sin_2
def test_a_simulated_fault_is_found_by_measure(tmp_path: Path) -> None:
    assert (
        run(["simulate", str(tmp_path / "set"), *SMALL, "--fault", "stale:y_sin_3", "--steps", "5"])
        == 0
    )
    code, result = measured(tmp_path / "set", tmp_path / "out")
    assert code == 0
    (flag,) = result["quality"]["flagged_frames"]
    assert flag == {"file": "y_sin_3.png", "reason": "stale: the same picture as y_sin_2"}


def test_a_geometry_file_with_a_crooked_screen(capture_set: Path, tmp_path: Path) -> None:
    short = tomllib.loads((capture_set / "capture.toml").read_text())["geometry"]
    (tmp_path / "screen.txt").write_text("\n".join(" ".join(["0.5"] * 4) for _ in range(3)))
    grid = {"s_x_mm": [-300, -100, 100, 300], "s_y_mm": [-300, 0, 300], "file": "screen.txt"}
    raised = tmp_path / "geometry.toml"
    raised.write_text(tomli_w.dumps({"geometry": {**short, "screen": {"height_map": grid}}}))
    code, found = measured(capture_set, tmp_path / "raised", "--geometry", str(raised))
    assert code == 0
    # a face that stands 0.5 mm off everywhere is a screen 0.5 mm nearer
    nearer = tmp_path / "nearer.toml"
    nearer.write_text(tomli_w.dumps({"geometry": {**short, "b_mm": short["b_mm"] - 0.5}}))
    _, expected = measured(capture_set, tmp_path / "nearer", "--geometry", str(nearer))
    assert found["zernike"]["coeffs_um"] == pytest.approx(
        expected["zernike"]["coeffs_um"], abs=1e-6
    )


def test_an_image_that_ends_too_early(
    capture_set: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    picture = (capture_set / "x_sin_1.png").read_bytes()
    (capture_set / "x_sin_1.png").write_bytes(picture[: len(picture) // 2])
    code, result = measured(capture_set, tmp_path)
    assert code == 3
    assert result["quality"]["flagged_frames"][0]["reason"] == "unreadable: the file ends too early"
    assert "libpng" not in capfd.readouterr().err


def test_a_rim_within_the_stated_sigmas_leaves_the_set_ok_and_uncalibrated(
    capture_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rewrite(capture_set, lambda table: table["geometry"].update(a_mm=2640.0))
    assert measured(capture_set, tmp_path / "result")[0] == 0
    output = capsys.readouterr().out
    assert output.startswith("verdict   ok\n")
    assert "geometry  uncalibrated: " in output
    assert "membrane-ctrl calibrate" in output
    known = json.loads((tmp_path / "result/result.json").read_text())["geometry_known"]
    assert known["state"] == "uncalibrated"
    assert 1.0 < known["rim_sigmas"] < 2.0


def test_a_rim_that_no_stated_sigma_explains_contradicts_the_geometry(
    capture_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    small = {name: 0.01 * sigma for name, sigma in SigmasConfig().model_dump().items()}

    def misstate(table: dict[str, Any]) -> None:
        table["geometry"].update(
            a_mm=2640.0, a_sigma_mm=0.5, b_sigma_mm=0.5, alpha_sigma_deg=0.01, sigmas=small
        )

    rewrite(capture_set, misstate)
    assert measured(capture_set, tmp_path / "result")[0] == 0
    output = capsys.readouterr().out
    assert output.startswith("verdict   degraded: the rim is ")
    assert "check the camera's pose" in output
    known = json.loads((tmp_path / "result/result.json").read_text())["geometry_known"]
    assert known["state"] == "contradicted"


FACET = SOFAST / "measurement_facet.h5"


@pytest.mark.skipif(not FACET.is_file(), reason=WHY_SKIPPED)
def test_frames_of_a_measured_facet(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["measure", str(FACET), "--json"]) == 0
    table = json.loads(capsys.readouterr().out)
    assert table["quality"] == {"verdict": "ok", "reason": "", "flagged_frames": []}


def test_what_is_no_facet_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "x.h5").write_text("no")
    for name in ("x.h5", "none.h5"):
        assert run(["measure", str(tmp_path / name)]) == 2
        assert name in capsys.readouterr().err


@pytest.mark.usefixtures("undrawn")
def test_error_bars(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert measured(made / "0000", tmp_path)[0] == 0
    output = capsys.readouterr().out
    assert "from noise" in output
    assert "largest: principal_x_px" in output
    assert (
        "geometry  uncalibrated: no sigma is stated for any input; data-sheet defaults apply"
        in output
    )
    details = json.loads((tmp_path / "details.json").read_text())["sag_sigma_um"]
    sigma = np.load(tmp_path / "sigma.npz")
    assert (
        sigma["sigma_noise_um"].shape
        == sigma["sigma_geometry_um"].shape
        == (sigma["y_mm"].size, sigma["x_mm"].size)
    )
    assert np.isnan(sigma["sigma_noise_um"][0, 0])
    middle = sigma["x_mm"].size // 2
    assert sigma["sigma_geometry_um"][middle, middle] == pytest.approx(
        0, abs=1e-9
    )  # counted from the vertex
    # what the Monte Carlo of the same set says
    assert (
        run(["uncertainty", str(made / "0000"), "--out", str(tmp_path / "mc"), "--trials", "50"])
        == 0
    )
    trials = json.loads((tmp_path / "mc" / "uncertainty.json").read_text())
    assert details["geometry"] == pytest.approx(
        trials["sag_sigma_um"], rel=0.25
    )  # of 50 trials: 10 % sigma
    assert np.nanmean(sigma["sigma_geometry_um"]) == pytest.approx(
        trials["rmse_um"]["mean"], rel=0.25
    )


def test_a_geometrys_own_covariance_makes_the_error_bars(made: Path, tmp_path: Path) -> None:
    geometry = tomllib.loads((made / "0000" / "capture.toml").read_text())["geometry"]
    covariance = {"names": ["a_mm"], "matrix": [[1e-8]]}
    geometry["sigmas"] = dict.fromkeys(SigmasConfig().model_dump(), 0.0)
    (tmp_path / "g.toml").write_text(
        tomli_w.dumps({"geometry": geometry, "covariance": covariance})
    )
    assert measured(made / "0000", tmp_path / "out", "--geometry", str(tmp_path / "g.toml"))[0] == 0
    details = json.loads((tmp_path / "out" / "details.json").read_text())["sag_sigma_um"]
    assert details["geometry"] < 0.01
    assert "g.toml" in details["geometry_spread"]


@pytest.fixture(scope="module")
def several(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set of three fringe periods whose very first coarser frame is too dark."""
    folder = tmp_path_factory.mktemp("several") / "set"
    options = [
        "--coarser-mm",
        "55.3",
        "--coarser-mm",
        "61.7",
        "--fault",
        "flicker:x_sin_0_of_55.3mm:0.9",
    ]
    assert run(["simulate", str(folder), "--shrink", "12", *options]) == 0
    return folder


def test_a_set_of_several_periods(several: Path, tmp_path: Path) -> None:
    code, result = measured(several, tmp_path)
    assert (code, result["quality"]["verdict"]) == (0, "degraded")
    (flagged,) = result["quality"]["flagged_frames"]
    assert flagged["file"] == "x_sin_0_of_55.3mm.png"
    assert flagged["reason"].startswith("does not agree with the other steps")
    found = np.array(result["zernike"]["coeffs_um"])
    assert np.hypot(*found[4:6]) == pytest.approx(300, abs=0.1)


@pytest.mark.parametrize(
    ("change", "output"),
    [
        (lambda table: table.update(kind="fringes", reference="../0"), "its own period_mm"),
        (lambda table: [row.pop("period_mm", None) for row in table["frames"]], "appears twice"),
        (lambda table: table["frames"].pop(), "needs y_sin_3_of_61.7mm"),
        (
            lambda table: table["frames"][-1].update(period_mm=10.0),
            "is finer than pattern.period_mm",
        ),
        (
            lambda table: table.update(frames=table["frames"][:8]),
            "needs frames of another period_mm",
        ),
    ],
    ids=["kind", "no periods", "a frame is missing", "finer", "one period"],
)
def test_a_bad_set_of_several_periods(
    several: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    change: Callable[[dict[str, Any]], object],
    output: str,
) -> None:
    folder = tmp_path / "set"
    folder.mkdir()
    shutil.copy(several / "capture.toml", folder)
    rewrite(folder, change)
    assert run(["measure", str(folder)]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert output in line
