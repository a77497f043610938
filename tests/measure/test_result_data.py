"""Results of `measure` and `stability` as pandas frames and xarray datasets."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from membrane_ctrl.cli import run
from membrane_ctrl.measure.result_data import open_result, open_stability
from membrane_ctrl.model.errors import InputError
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set with its result, and the stability of three sets."""
    folder = tmp_path_factory.mktemp("made") / "sets"
    assert run(["simulate", str(folder), "--shrink", "12", "--sets", "3"]) == 0
    assert run(["measure", str(folder / "0000"), "--no-pictures"]) == 0
    assert run(["stability", str(folder)]) == 0
    return folder


def test_the_terms_of_a_result_have_their_orders_and_sigmas(made: Path) -> None:
    frame = open_result(made / "0000" / "result").to_pandas()
    table = json.loads((made / "0000" / "result" / "result.json").read_text())
    assert frame.index.name == "noll"
    assert frame.loc[4, ["n", "m"]].tolist() == [2, 0]
    assert frame["coeffs_um"].tolist() == table["zernike"]["coeffs_um"]
    assert (frame["sigma_um"] > 0).any()


def test_the_maps_of_a_result_have_their_axes(made: Path) -> None:
    folder = made / "0000" / "result"
    data = open_result(folder).to_xarray()
    with np.load(folder / "height.npz") as height, np.load(folder / "sigma.npz") as sigma:
        np.testing.assert_array_equal(data["height_mm"], height["h_mm"])
        np.testing.assert_array_equal(data["x_mm"], height["x_mm"])
        np.testing.assert_array_equal(data["sigma_noise_um"], sigma["sigma_noise_um"])
    middle = data["height_mm"].sel(x_mm=0.0, y_mm=0.0, method="nearest")
    rim = data["height_mm"].sel(x_mm=400.0, y_mm=0.0, method="nearest")
    assert float(rim) > float(middle) + 10
    assert data["height_mm"].attrs["units"] == "mm"
    assert data.attrs["verdict"] == "ok"
    assert data.attrs["program"].startswith("membrane-ctrl ")


def test_a_result_without_sigmas_has_its_height(made: Path, tmp_path: Path) -> None:
    for name in ("height.npz", "result.json"):
        (tmp_path / name).write_bytes((made / "0000" / "result" / name).read_bytes())
    data = open_result(tmp_path).to_xarray()
    assert "sigma_um" not in data
    assert "height_mm" in data


@pytest.mark.parametrize(
    "content", [{}, {"zernike": 3}, {"zernike": {"coeffs_um": ["x"]}, "quality": []}]
)
def test_a_result_of_another_program_may_state_less(
    made: Path, tmp_path: Path, content: dict[str, object]
) -> None:
    (tmp_path / "height.npz").write_bytes((made / "0000" / "result" / "height.npz").read_bytes())
    (tmp_path / "result.json").write_text(json.dumps(content))
    result = open_result(tmp_path)
    assert result.to_pandas()["coeffs_um"].isna().all()
    assert result.to_xarray().attrs["verdict"] == ""


def test_sigmas_of_another_shape_are_refused(made: Path, tmp_path: Path) -> None:
    for name in ("height.npz", "result.json"):
        (tmp_path / name).write_bytes((made / "0000" / "result" / name).read_bytes())
    maps = dict.fromkeys(("sigma_um", "sigma_noise_um", "sigma_geometry_um"), np.zeros((3, 4)))
    np.savez(tmp_path / "sigma.npz", x_mm=np.zeros(5), y_mm=np.zeros(5), **maps)
    with pytest.raises(InputError, match=r"sigma\.npz"):
        open_result(tmp_path)


def test_the_series_of_a_stability_analysis(made: Path) -> None:
    found = open_stability(made / "stability")
    frame, data = found.to_pandas(), found.to_xarray()
    assert frame.index.tolist() == ["0000", "0001", "0002"]
    assert frame["verdict"].tolist() == ["ok"] * 3
    assert data["coeffs_um"].shape == (3, ZERNIKE_TERMS)
    np.testing.assert_array_equal(data["coeffs_um"].sel(noll=4), frame["z4_um"])
    assert float(data["sd_um"].max()) == pytest.approx(found.table["sd_um"]["max"])
    assert found.to_pandas("pairs").empty


@pytest.mark.parametrize("text", ["", "[]", "{"])
def test_what_is_no_stability_result_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(InputError, match=r"stability\.json"):
        open_stability(tmp_path)
    (tmp_path / "stability.json").write_text(text)
    with pytest.raises(InputError, match=r"stability\.json"):
        open_stability(tmp_path)
    (tmp_path / "stability.json").write_text("{}")
    with pytest.raises(InputError, match=r"series\.csv"):
        open_stability(tmp_path).to_pandas()
