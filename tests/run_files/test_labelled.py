"""A run as a pandas frame and as an xarray dataset."""

from __future__ import annotations

import sys

import numpy as np
import pandas as pd
import pytest

from membrane_ctrl.model.errors import InputError
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from membrane_ctrl.review import open_run
from membrane_ctrl.run_files.run import Run
from tests.support.review_runs import written


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return open_run(written(tmp_path_factory.mktemp("labelled"), 0.05))


def test_a_frame_has_utc_as_index_and_names_for_codes(run: Run) -> None:
    ticks, frame = run.ticks(), run.to_pandas()
    assert frame.index.name == "time_utc"
    assert frame.index.tz is not None
    assert list(frame.columns) == [name for name in ticks.column_names if name != "time_utc"]
    assert isinstance(frame["state"].dtype, pd.CategoricalDtype)
    np.testing.assert_array_equal(frame["error_um"], ticks.column("error_um").to_numpy())


def test_a_frame_of_a_part_has_the_wanted_columns_of_that_part(run: Run) -> None:
    frame = run.to_pandas(names=["error_um"], start_s=60.0, end_s=70.0)
    assert list(frame.columns) == ["time_s", "error_um"]
    assert len(frame) == 100
    assert 60.0 <= frame["time_s"].min() < frame["time_s"].max() < 70.0
    level = run.to_pandas("overview", ["mean_error_um"], window_s=1.0)
    assert set(level.columns) == {"time_s", "rows", "mean_error_um"}


def test_a_dataset_states_units_and_descriptions(run: Run) -> None:
    data = run.to_xarray(start_s=10.0, end_s=20.0)
    assert data["error_um"].dims == ("time",)
    assert data["error_um"].attrs["units"] == "µm"
    assert data["gauge_pressure_pa"].attrs["units"] == "Pa"
    assert data["error_um"].attrs["long_name"]
    assert set(data["state"].values) == {"hold"}
    assert data.attrs["run"] == run.name
    frame = run.to_pandas(start_s=10.0, end_s=20.0)
    np.testing.assert_array_equal(data["error_um"], frame["error_um"])
    assert data.indexes["time"][0] == frame.index[0].tz_localize(None)


def test_times_of_a_dataset_select_its_rows(run: Run) -> None:
    data = run.to_xarray("overview", window_s=1.0)
    first = data.indexes["time"][0]
    part = data.sel(time=slice(first, first + pd.Timedelta("9s")))
    np.testing.assert_array_equal(part["mean_error_um"], run.level(1.0)["mean_error_um"][:10])


def test_cycles_are_arrays_along_time_and_term(run: Run) -> None:
    data, found = run.to_xarray("cycles"), run.shapes()
    assert dict(data.sizes) == {
        "time": len(found),
        "noll": ZERNIKE_TERMS,
        "covariance_time": found.covariance_time_s.size,
        "noll_other": ZERNIKE_TERMS,
    }
    np.testing.assert_array_equal(data["coeffs_um"].sel(noll=4), found.coeffs_um[:, 3])
    assert data["coeffs_um"].attrs["units"] == "µm"
    part = run.to_xarray("cycles", start_s=60.0, end_s=120.0)
    assert part["sag_um"].values.tolist() == run.cycles(60.0, 120.0).column("sag_um").to_pylist()
    assert len(run.to_pandas("cycles")) == len(found)


def test_an_empty_part_is_an_empty_table(run: Run) -> None:
    for table in ("ticks", "overview", "cycles"):
        assert run.to_pandas(table, start_s=1e6).empty  # type: ignore[arg-type]
        assert run.to_xarray(table, start_s=1e6).sizes["time"] == 0  # type: ignore[arg-type]


def test_an_unknown_table_or_column_is_named(run: Run) -> None:
    with pytest.raises(ValueError, match="known: ticks, overview, cycles"):
        run.to_pandas("tocks")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="no such column: eror_um"):
        run.to_xarray(names=["eror_um"])


@pytest.mark.parametrize(("library", "method"), [("pandas", "to_pandas"), ("xarray", "to_xarray")])
def test_a_missing_library_is_named(
    run: Run, library: str, method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(InputError, match=rf"needs {library}: pip install 'membrane-ctrl\[data\]'"):
        getattr(run, method)(end_s=1.0)
