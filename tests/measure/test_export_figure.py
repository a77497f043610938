"""`export-figure`: every format read back by a program that is not ours, and results that mean
harm.
"""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
from prysm import io as prysm_io
from prysm.polynomials import noll_to_nm, zernike_nm

from membrane_ctrl.cli import run
from membrane_ctrl.model.zernike_terms import NOLL_INDICES, ZERNIKE_TERMS

X, Y = np.linspace(-300, 300, 61), np.linspace(-200, 250, 46)
GX, GY = np.meshgrid(X, Y)
BOWL = (GX**2 + GY**2) / 7000 + 2e-3 * GX - 1e-3 * GY + 0.4
DENT = -0.003 * np.exp(
    -((GX - 150) ** 2 + (GY - 100) ** 2) / 800
)  # to the right of the middle, and above it
HEIGHT = np.where(np.hypot(GX, GY) < 290, BOWL + DENT, np.nan)
COEFFS = [float(j) for j in range(ZERNIKE_TERMS)]


@pytest.fixture
def result(tmp_path: Path) -> Path:
    """A result folder, of a grid that is not square."""
    np.savez(tmp_path / "height.npz", x_mm=X, y_mm=Y, h_mm=HEIGHT)
    (tmp_path / "result.json").write_text(
        json.dumps({"zernike": {"radius_mm": 500.0, "coeffs_um": COEFFS}})
    )
    return tmp_path


def exported(result: Path, form: str, *options: str) -> None:
    """Run the command."""
    assert run(["export-figure", str(result), "--format", form, *options]) == 0


def left() -> np.ndarray:
    """The height without piston, tilt and power, by other means."""
    seen = np.isfinite(HEIGHT)
    rho = np.hypot(GX, GY) / np.hypot(GX, GY)[seen].max()
    design = np.stack([np.ones_like(GX), GX, GY, 2 * rho**2 - 1], axis=-1)
    fit = np.linalg.lstsq(design[seen], HEIGHT[seen], rcond=None)[0]
    return HEIGHT - design @ fit


def test_prysm_reads_the_zygo_file(result: Path) -> None:
    exported(result, "zygo-dat", "--remove", "piston,tilt,power")
    read = prysm_io.read_zygo_dat(result / "figure.dat")
    assert read["meta"]["lateral_resolution"] == pytest.approx(0.010, rel=1e-6)
    np.testing.assert_allclose(read["phase"][::-1], 1e6 * left(), atol=0.02)  # nm
    row, column = np.unravel_index(np.nanargmin(read["phase"]), read["phase"].shape)
    assert row < Y.size / 2 < X.size / 2 < column  # above and to the right


def test_a_deep_bowl_fits_the_zygo_file_in_coarser_steps(
    result: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    np.savez(result / "height.npz", x_mm=X, y_mm=Y, h_mm=3 * HEIGHT)
    exported(result, "zygo-dat")
    assert "steps of 0.0772 nm" in capsys.readouterr().out
    np.testing.assert_allclose(
        prysm_io.read_zygo_dat(result / "figure.dat")["phase"][::-1], 3e6 * HEIGHT, atol=0.1
    )
    np.savez(result / "height.npz", x_mm=X, y_mm=Y, h_mm=30 * HEIGHT)
    assert run(["export-figure", str(result), "--format", "zygo-dat"]) == 2
    assert "holds heights up to 166 mm, not 3" in capsys.readouterr().err


def test_prysm_reads_the_code_v_file(result: Path) -> None:
    exported(result, "codev-int", "--remove", "piston,tilt,power")
    read, meta = prysm_io.read_codev_gridint(result / "figure.int")
    assert meta["data meaning"] == "surface error"
    read = read.reshape(Y.size, X.size)[::-1]  # this version takes columns for rows
    half_step_nm = 1e6 * np.nanmax(np.abs(left())) / 32767 / 2
    np.testing.assert_allclose(read, 1e6 * left(), atol=1.01 * half_step_nm)


def test_a_sphere_without_its_sphere_is_flat(result: Path) -> None:
    ball = 3400 - np.sqrt(3400**2 - (GX - 5) ** 2 - (GY + 9) ** 2)
    np.savez(result / "height.npz", x_mm=X, y_mm=Y, h_mm=np.where(np.isnan(HEIGHT), np.nan, ball))
    exported(result, "zygo-dat", "--remove", "sphere")
    assert np.nanmax(np.abs(prysm_io.read_zygo_dat(result / "figure.dat")["phase"])) < 0.02


def test_pandas_reads_the_points(result: Path) -> None:
    exported(result, "zygo-xyz")
    table = pd.read_csv(
        result / "figure.xyz",
        sep=r"\s+",
        skiprows=14,
        skipfooter=1,
        engine="python",
        names=["j", "i", "z", "rest"],
    )
    read = pd.to_numeric(table["z"], errors="coerce").to_numpy().reshape(Y.size, X.size)
    np.testing.assert_allclose(read[::-1], 1e3 * HEIGHT, atol=1e-6)
    assert table["j"].tolist()[:3] == [0, 1, 2]


def test_h5py_reads_the_map_and_its_terms(result: Path) -> None:
    exported(result, "h5", "--zernike", "osa", "--out", str(result / "other.h5"))
    with h5py.File(result / "other.h5") as file:
        np.testing.assert_array_equal(file["height_mm"], HEIGHT)
        np.testing.assert_array_equal(file["y_mm"], Y)
        assert file["zernike"].attrs["coeffs_um"][1] == 2.0  # OSA 1 is n = 1, m = -1: Noll's j = 3
        assert file["zernike"].attrs["n_m"][1].tolist() == [1, -1]


def test_fringe_terms_are_fitted_to_the_map(result: Path) -> None:
    exported(result, "zygo-xyz", "--zernike", "fringe")
    table = json.loads((result / "figure.xyz.zernike.json").read_text())
    rho, theta = np.hypot(GX, GY) / table["radius_mm"], np.arctan2(GY, GX)
    terms = [zernike_nm(*order, rho, theta, norm=False) for order in table["n_m"]]
    off_um = (1e3 * HEIGHT - np.tensordot(table["coeffs_um"], terms, axes=1))[np.isfinite(HEIGHT)]
    assert np.sqrt(np.mean(off_um**2)) < 0.6  # what 37 terms leave of a narrow dent of 3 µm
    exported(result, "zygo-xyz", "--zernike", "noll")
    table = json.loads((result / "figure.xyz.zernike.json").read_text())
    assert (table["coeffs_um"], table["radius_mm"]) == (COEFFS, 500.0)
    assert [tuple(order) for order in table["n_m"]] == [tuple(noll_to_nm(j)) for j in NOLL_INDICES]


def harmful_header() -> bytes:
    """An array that claims terabytes."""
    text = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000, 1000000), }\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + bytes(64)


def archive(**arrays: bytes) -> bytes:
    """An .npz of raw members."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as packed:
        for name, data in arrays.items():
            packed.writestr(f"{name}.npy", data)
    return out.getvalue()


def saved(values: object) -> bytes:
    """An array as its file."""
    out = io.BytesIO()
    np.save(out, np.asarray(values), allow_pickle=True)
    return out.getvalue()


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"no archive", "damaged"),
        (archive(x_mm=saved(X)), "damaged or lacks an array"),
        (archive(x_mm=harmful_header(), y_mm=b"", h_mm=b""), "x_mm is not an array"),
        (
            archive(x_mm=saved(np.array([{}, {}], object)), y_mm=b"", h_mm=b""),
            "x_mm is not an array",
        ),
        (archive(x_mm=b"junk", y_mm=b"", h_mm=b""), "not a usable result"),
        (archive(x_mm=saved(X), y_mm=saved(Y), h_mm=saved(HEIGHT.T)), "has not the shape"),
        (archive(x_mm=saved(X**3), y_mm=saved(Y), h_mm=saved(HEIGHT)), "even steps"),
        (archive(x_mm=saved(X), y_mm=saved(Y), h_mm=saved(HEIGHT * np.nan)), "0 measured cells"),
        (archive(x_mm=saved(X), y_mm=saved(Y), h_mm=saved(HEIGHT * 1e30)), "beyond 10000 mm"),
    ],
)
def test_a_harmful_result_is_one_line(
    result: Path, capsys: pytest.CaptureFixture[str], content: bytes, told: str
) -> None:
    (result / "height.npz").write_bytes(content)
    assert run(["export-figure", str(result), "--format", "h5"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert told in line
    assert not list(result.glob("figure*"))


def test_links_missing_files_and_wrong_words_are_refused(
    result: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cases: list[tuple[list[str], str]] = [
        (["--format", "stl"], "--format stl: give one of zygo-dat"),
        (["--format", "h5", "--remove", "coma"], "--remove coma: give piston"),
        (["--format", "h5", "--zernike", "born"], "--zernike born: give one of noll"),
    ]
    for options, told in cases:
        assert run(["export-figure", str(result), *options]) == 2
        assert told in capsys.readouterr().err
    (result / "result.json").write_text('{"zernike": {"coeffs_um": ["a"]}}')
    assert run(["export-figure", str(result), "--format", "h5", "--zernike", "noll"]) == 2
    assert f"needs {ZERNIKE_TERMS} coefficients" in capsys.readouterr().err
    (result / "height.npz").rename(result / "elsewhere.npz")
    (result / "height.npz").symlink_to(result / "elsewhere.npz")
    assert run(["export-figure", str(result), "--format", "h5"]) == 2
    assert "links are not followed" in capsys.readouterr().err
    assert run(["export-figure", str(result / "absent"), "--format", "h5"]) == 2
    assert "is it a result?" in capsys.readouterr().err
