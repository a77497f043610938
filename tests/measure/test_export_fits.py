"""`export-figure --format fits`: read back by astropy, and by POPPY, which computes the point
spread function.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import astropy.units as u
import numpy as np
import poppy
import pytest
from astropy.io import fits

from membrane_ctrl import __version__
from membrane_ctrl.cli import run
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS

RADIUS_MM = 475.0
FOCAL_MM = 3400.0
WAVELENGTH_M = 1e-6
AXIS_MM = np.linspace(-500.0, 500.0, 101)
X_MM, Y_MM = np.meshgrid(AXIS_MM, AXIS_MM)
INSIDE = np.hypot(X_MM, Y_MM) <= RADIUS_MM
PARABOLOID_MM = (X_MM**2 + Y_MM**2) / (4 * FOCAL_MM)
ARCSEC_PER_RAD = np.degrees(1) * 3600


def write_result(folder: Path, height_mm: FloatArray, y_mm: FloatArray = AXIS_MM) -> None:
    np.savez(folder / "height.npz", x_mm=AXIS_MM, y_mm=y_mm, h_mm=height_mm)
    coeffs_um = [0.0] * ZERNIKE_TERMS
    (folder / "result.json").write_text(
        json.dumps({"zernike": {"radius_mm": 500.0, "coeffs_um": coeffs_um}})
    )


def exported(folder: Path, error_mm: FloatArray) -> Path:
    """The file of a paraboloid with an error, from which the paraboloid is removed."""
    write_result(folder, np.where(INSIDE, PARABOLOID_MM + error_mm, np.nan))
    remove = ("--remove", "piston,tilt,power")
    assert run(["export-figure", str(folder), "--format", "fits", *remove]) == 0
    return folder / "figure.fits"


def spread_function(path: Path) -> tuple[FloatArray, float]:
    """POPPY's point spread function of a file, and its pixel in seconds of arc."""
    with fits.open(path) as file:
        mask = fits.HDUList([fits.PrimaryHDU(file["MASK"].data, file["MASK"].header)])
        mirror = poppy.FITSOpticalElement(
            opd=file, transmission=mask, planetype=poppy.poppy_core.PlaneType.pupil
        )
    system = poppy.OpticalSystem(npix=AXIS_MM.size)
    system.add_pupil(mirror)
    pixel_arcsec = 0.02
    system.add_detector(pixelscale=pixel_arcsec, fov_pixels=101, oversample=1)
    computed = system.calc_psf(wavelength=WAVELENGTH_M * u.m)
    return computed[0].data, pixel_arcsec


def centroid_arcsec(spread: FloatArray, pixel_arcsec: float) -> tuple[float, float]:
    """Centre of the light in x and y."""
    places = (np.arange(len(spread)) - (len(spread) - 1) / 2) * pixel_arcsec
    total = spread.sum()
    return float(spread.sum(axis=0) @ places / total), float(spread.sum(axis=1) @ places / total)


def test_a_perfect_paraboloid_gives_the_diffraction_limit(tmp_path: Path) -> None:
    spread, pixel_arcsec = spread_function(exported(tmp_path, 0 * X_MM))
    profile = spread[len(spread) // 2] / spread.max()
    places = (np.arange(profile.size) - profile.size // 2) * pixel_arcsec
    first_dark_arcsec = 1.22 * WAVELENGTH_M / (2e-3 * RADIUS_MM) * ARCSEC_PER_RAD  # 0.26
    assert np.interp(first_dark_arcsec, places, profile) < 0.01
    assert np.interp(first_dark_arcsec / 2, places, profile) > 0.2


def test_the_strehl_ratio_follows_from_twice_the_height(tmp_path: Path) -> None:
    """Marechal: exp(-(2 pi sigma)^2) for small errors; sigma of the path is twice that of the
    height.
    """
    error_mm = 2e-5 * np.cos(2 * np.pi * X_MM / 200) * np.cos(2 * np.pi * Y_MM / 200)
    (tmp_path / "flat").mkdir()
    (tmp_path / "rough").mkdir()
    flat, _ = spread_function(exported(tmp_path / "flat", 0 * X_MM))
    path = exported(tmp_path / "rough", error_mm)
    rough, _ = spread_function(path)
    sigma_m = 2e-3 * float(error_mm[INSIDE].std())
    assert rough.max() / flat.max() == pytest.approx(
        np.exp(-((2 * np.pi * sigma_m / WAVELENGTH_M) ** 2)), abs=2e-3
    )
    assert 0.8 < rough.max() / flat.max() < 0.99


def test_a_mirror_that_rises_to_the_right_sends_the_light_to_the_left(tmp_path: Path) -> None:
    """A tilt of the surface turns the reflected light by twice its angle, away from the raised
    side.
    """
    slope = 0.25 / ARCSEC_PER_RAD
    write_result(tmp_path, np.where(INSIDE, slope * X_MM, np.nan))
    assert run(["export-figure", str(tmp_path), "--format", "fits"]) == 0
    x_arcsec, y_arcsec = centroid_arcsec(*spread_function(tmp_path / "figure.fits"))
    assert x_arcsec == pytest.approx(-0.5, abs=0.03)
    assert y_arcsec == pytest.approx(0.0, abs=0.03)


def test_the_images_and_their_header(tmp_path: Path) -> None:
    error_mm = 1e-4 * np.exp(-((X_MM - 200) ** 2 + (Y_MM - 100) ** 2) / 5000)
    with fits.open(exported(tmp_path, error_mm)) as file:
        opd, mask, height = (file[name] for name in ("OPD", "MASK", "HEIGHT"))
        assert opd.header["BUNIT"] == height.header["BUNIT"] == "m"
        assert opd.header["PUPLSCAL"] == mask.header["PUPLSCAL"] == pytest.approx(0.010)
        assert opd.header["REMOVED"] == "piston, tilt, power"
        assert opd.header["SCHEMA"] == "membrane-figure/1"
        assert opd.header["CREATOR"] == f"membrane-ctrl {__version__}"
        np.testing.assert_array_equal(mask.data == 1, INSIDE)
        np.testing.assert_allclose(opd.data[INSIDE], 2 * height.data[INSIDE], rtol=1e-12)
        assert not opd.data[~INSIDE].any()
        row, column = np.unravel_index(np.nanargmax(height.data), height.data.shape)
        assert opd.header["CRVAL1"] + column * opd.header["CDELT1"] == pytest.approx(
            0.200, abs=0.011
        )
        assert opd.header["CRVAL2"] + row * opd.header["CDELT2"] == pytest.approx(0.100, abs=0.011)


def test_a_map_that_is_not_square_is_filled_up(tmp_path: Path) -> None:
    rows = slice(10, 81)
    write_result(tmp_path, np.where(INSIDE, 0 * X_MM, np.nan)[rows], AXIS_MM[rows])
    assert run(["export-figure", str(tmp_path), "--format", "fits"]) == 0
    with fits.open(tmp_path / "figure.fits") as file:
        mask = file["MASK"]
        assert mask.data.shape == (101, 101)
        np.testing.assert_array_equal(mask.data[:71] == 1, INSIDE[rows])
        assert not mask.data[71:].any()
        assert mask.header["CRVAL2"] == pytest.approx(-0.400)


def test_two_exports_are_the_same_bytes(tmp_path: Path) -> None:
    first = exported(tmp_path, 0 * X_MM).read_bytes()
    assert exported(tmp_path, 0 * X_MM).read_bytes() == first


def test_without_astropy_the_package_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_result(tmp_path, np.where(INSIDE, 0 * X_MM, np.nan))
    monkeypatch.setitem(sys.modules, "astropy.io.fits", None)
    assert run(["export-figure", str(tmp_path), "--format", "fits"]) == 2
    assert "pip install 'membrane-ctrl[fits]'" in capsys.readouterr().err
