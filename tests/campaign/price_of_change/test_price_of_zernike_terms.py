"""Another number of Zernike terms costs one changed line: the product works with the fewest and
with the most.

The line is changed in copies of the source. These and the source itself see the same frames of a
film that the fewest terms represent, so that sag and low terms must agree within their own error
bars.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from changed_source import ROOT, ChangedSource
from numpy.typing import NDArray
from zernike_bench import FILM, MOVED_UM, OPTICS

from membrane_ctrl.config.schema import CameraConfig, GeometryConfig, OpticsConfig
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS, zernike_columns
from membrane_ctrl.sim.optics.film_shape import FilmShape
from membrane_ctrl.sim.optics.simulate import simulate_set, simulate_track
from membrane_ctrl.sim.optics.simulation_spec import Motion, SimulationSpec

pytestmark = [pytest.mark.campaign, pytest.mark.real_time, pytest.mark.timeout(7200)]

FEWEST, MOST = 21, 66
BENCH = Path(__file__).with_name("zernike_bench.py")
ALIKE_SIGMAS = 3.0  # between two numbers of terms: both fit the same noise
TRUE_SIGMAS = 5.0  # from the truth: the largest of 200 normal errors is at 3
FRAMES = 8
MORE_CYCLES_S = 20.0  # of a hold whose figure is tracked
COMPARED = slice(3, FEWEST)  # Noll 4 and all above that every number of terms has
ROUND = np.isin(np.arange(1, FEWEST + 1), (4, 11))  # terms of the bowl, whose truth is in no list
# 16-bit frames of large pixels, each with the noise of the 256 of the paper's camera that it stands
# for
COARSE = 16
COARSE_CAMERA = CameraConfig(
    width_px=2448 // COARSE,
    height_px=2048 // COARSE,
    pixel_um=3.45 * COARSE,
    bits=16,
    noise_adu=256 * math.hypot(0.4, math.sqrt(1 / 12)) / COARSE,
)
PRESSURES_UM = (-4000.0, 0.0, 4000.0)  # displacement at each
STATED_GEOMETRY = GeometryConfig(
    a_mm=2672.0, b_mm=2871.0, alpha_deg=80.9, reference_displacement_um=0.0
)
TRUE_GEOMETRY = GeometryConfig(
    a_mm=2674.0, b_mm=2869.0, alpha_deg=81.2, reference_displacement_um=0.0
)
PRESTRAIN, POISSON_RATIO, STIFFNESS_N_PER_M = 8e-4, 0.38, 1.7e5
# a film of the law in a ring that is not flat
STRETCHED_FILM = FilmShape(
    37.1,
    prestrain=PRESTRAIN,
    poisson=POISSON_RATIO,
    zernike_um=(0, 0, 0, 0, 120, -80, 30, -40, 30, 20),
)
FOUND_SIGMAS = 4.0  # of calibration and film: systematic errors, which are the same in every set
SMALL_CAMERA = """
width_px = 306
height_px = 256
pixel_um = 27.6
bits = 16
noise_adu = 15.8
"""
# A mirror that loses and gains gas twenty times as fast as a real one settles within a minute
HOLD = f"""
[twin]
port = 0
scenario = "quiet"
start_error_um = -3.0
leak_time_constant_s = 500.0
[pump]
flow_full_um_per_s = 60.0
[loop]
flow_max_um_per_s = 60.0
setpoint_ramp_um_per_s = 40.0
[shape]
mode = "MODE"
frame_interval_s = 0.02
[optics.camera]
{SMALL_CAMERA}
"""


@dataclass
class Product:
    """The product with a number of terms, and what it makes of the benches.

    Attributes
    ----------
    terms : int
        The number.
    source : ChangedSource
        The product's source.
    sets : Path
        Folder of the capture sets that it measures.
    folder : Path
        Where it writes.
    """

    terms: int
    source: ChangedSource
    sets: Path
    folder: Path

    @cached_property
    def bench(self) -> dict[str, Any]:
        """Figures of live cycles and of tracked frames."""
        found: dict[str, Any] = json.loads(self.source.run_python(BENCH))
        return found

    @cached_property
    def measured(self) -> dict[str, Any]:
        """Result of `measure`."""
        found: dict[str, Any] = json.loads(
            self.source.run_program(
                "measure",
                self.sets / "full",
                "--out",
                self.folder / "measured",
                "--json",
                "--rerun",
            )
        )
        return found

    @cached_property
    def calibration(self) -> dict[str, Any]:
        """Result of `calibrate`; writes `geometry.toml`."""
        found: dict[str, Any] = json.loads(
            self.source.run_program(
                "calibrate",
                *self._pressure_sets,
                "--out",
                self.folder / "geometry.toml",
                "--json",
            )
        )
        return found

    @cached_property
    def material(self) -> dict[str, Any]:
        """Result of `film` with the calibrated geometry."""
        _ = self.calibration
        found: dict[str, Any] = json.loads(
            self.source.run_program(
                "film",
                *self._pressure_sets,
                "--geometry",
                self.folder / "geometry.toml",
                "--out",
                self.folder / "film",
                "--json",
            )
        )
        return found

    @property
    def _pressure_sets(self) -> list[Path]:
        return [self.sets / f"pressure{number}" for number in range(len(PRESSURES_UM))]

    def hold(self, mode: str) -> Path:
        """Return the folder of a run that holds the twin until its figure is tracked by the shape
        loop; the first call makes the run.
        """
        logs = self.folder / "logs"
        for run in logs.glob(f"*-{mode}"):
            return run
        _ = self.bench  # compiles, so that the hold need not
        config = self.folder / f"{mode}.toml"
        config.write_text(HOLD.replace("MODE", mode))
        return self.source.hold_until(
            shape_is_tracked, logs, mode, "--config", config, more_s=MORE_CYCLES_S
        )


def shape_is_tracked(events: list[dict[str, Any]]) -> bool:
    """Whether the shape loop follows figures."""
    return any(event["kind"] == "shape" and event["state"] == "tracking" for event in events)


@pytest.fixture(scope="module")
def sets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A full set, a tracking set, and sets of a stretched film at three pressures."""
    folder = tmp_path_factory.mktemp("sets")
    for number, start_um in enumerate(PRESSURES_UM):
        spec = SimulationSpec(
            OpticsConfig(geometry=TRUE_GEOMETRY, camera=COARSE_CAMERA),
            STRETCHED_FILM,
            motion=Motion(start_um),
            laser_noise_um=1.0,
            stiffness_n_per_m=STIFFNESS_N_PER_M,
            stated_geometry=STATED_GEOMETRY,
            seed=number + 1,
        )
        simulate_set(folder / f"pressure{number}", spec)
    simulate_set(folder / "full", SimulationSpec(OPTICS, FILM, seed=1))
    simulate_track(folder / "tracking", SimulationSpec(OPTICS, FILM, seed=2), FRAMES)
    return folder


@pytest.fixture(scope="module")
def usual(sets: Path, tmp_path_factory: pytest.TempPathFactory) -> Product:
    """The product as it is, not copied."""
    return Product(ZERNIKE_TERMS, ChangedSource(ROOT), sets, tmp_path_factory.mktemp("usual"))


@pytest.fixture(scope="module", params=[FEWEST, MOST])
def changed(
    request: pytest.FixtureRequest, sets: Path, tmp_path_factory: pytest.TempPathFactory
) -> Product:
    """The product with another number of terms: one line differs."""
    terms: int = request.param
    source = ChangedSource.copy_to(tmp_path_factory.mktemp(f"terms{terms}"))
    source.set_constant("ZERNIKE_TERMS", terms)
    assert source.count_places() == 1
    return Product(terms, source, sets, source.folder)


def low_terms(figure: dict[str, Any], name: str = "coeffs_um") -> NDArray[np.float64]:
    """The terms that all numbers have in common, less piston and tilts."""
    return np.array(figure[name])[COMPARED]


def require_alike(found: dict[str, Any], usual: dict[str, Any], moved_um: float) -> None:
    """Compare a figure with the usual number's, and with the truth."""
    assert (found["verdict"], found["reason"]) == ("ok", "")
    sag_bar_um = np.hypot(found["sag_change_sigma_um"], usual["sag_change_sigma_um"])
    assert found["sag_um"] == pytest.approx(usual["sag_um"], abs=ALIKE_SIGMAS * sag_bar_um)
    assert found["sag_um"] == pytest.approx(
        1e3 * FILM.sag_mm + moved_um, abs=TRUE_SIGMAS * found["sag_change_sigma_um"]
    )
    bars_um = np.hypot(low_terms(found, "sigma_um"), low_terms(usual, "sigma_um"))
    assert (np.abs(low_terms(found) - low_terms(usual)) < ALIKE_SIGMAS * bars_um).all()
    off_um = np.array(found["coeffs_um"][:FEWEST]) - np.array(FILM.zernike_um)
    known = ~ROUND[COMPARED]
    assert (np.abs(off_um[COMPARED]) < TRUE_SIGMAS * low_terms(found, "sigma_um"))[known].all()


def test_live_cycles(changed: Product, usual: Product) -> None:
    found = changed.bench["live"]
    assert {len(figure["coeffs_um"]) for figure in found} == {changed.terms}
    for figure, other, moved_um in zip(found, usual.bench["live"], MOVED_UM, strict=True):
        require_alike(figure, other, moved_um)


def test_tracked_frames(changed: Product, usual: Product) -> None:
    found = changed.bench["tracked"]
    assert {len(figure["coeffs_um"]) for figure in found} == {changed.terms}
    for figure, other in zip(found, usual.bench["tracked"], strict=True):
        require_alike(figure, other, figure["moved_um"])


def test_measure(changed: Product, usual: Product) -> None:
    found, other = changed.measured, usual.measured
    assert found["quality"]["verdict"] == "ok"
    assert (
        len(found["zernike"]["coeffs_um"])
        == len(found["uncertainty"]["coeffs_um"])
        == changed.terms
    )
    noll, osa, fringe = found["figure"]["zernike"]
    assert len(noll["coeffs_um"]) == len(osa["coeffs_um"]) == changed.terms
    usual_noll, _, usual_fringe = other["figure"]["zernike"]
    for one, same, common in ((noll, usual_noll, COMPARED), (fringe, usual_fringe, slice(3, None))):
        bars_um = np.hypot(one["sigma_noise_um"][common], same["sigma_noise_um"][common])
        off_um = np.array(one["coeffs_um"][common]) - np.array(same["coeffs_um"][common])
        assert (np.abs(off_um) < ALIKE_SIGMAS * bars_um).all()
    for name in ("sag.png", "residual.png", "measurement.rrd"):
        assert (changed.folder / "measured" / name).stat().st_size > 10_000
    changed.source.run_program(
        "export-figure", changed.folder / "measured", "--format", "zygo-xyz", "--zernike", "osa"
    )
    table = json.loads((changed.folder / "measured" / "figure.xyz.zernike.json").read_text())
    assert len(table["n_m"]) == changed.terms


def test_track_a_set(changed: Product) -> None:
    changed.source.run_program("track", changed.sets / "tracking" / "track")
    result = changed.sets / "tracking" / "track" / "result"
    with np.load(result / "track.npz", allow_pickle=False) as found:
        assert found["coeffs_um"].shape == found["sigma_um"].shape == (FRAMES, changed.terms)
        assert (found["verdict"] == "ok").all()
        off_um = found["sag_um"] - 1e3 * FILM.sag_mm
        assert (np.abs(off_um) < TRUE_SIGMAS * found["sag_sigma_um"]).all()


@pytest.mark.parametrize("mode", ["cycle", "track"])
def test_a_hold_is_recorded_replayed_and_reported(changed: Product, mode: str) -> None:
    run = changed.hold(mode)
    report = json.loads(changed.source.run_program("report", run, "--json"))
    assert report["shape"]["cycles"] > 0
    assert report["shape"]["rejected"] == 0
    assert len(report["shape"]["drift_um_per_hour"]) == changed.terms - 1
    assert "identical" in changed.source.run_program("replay", run)
    changed.source.run_program("export", run)
    shapes = pq.read_table(run / "export" / "shapes.parquet")
    columns = [name for name in shapes.column_names if name[0] == "z" and name[1].isdigit()]
    assert columns == [f"z{j}_um" for j in range(1, changed.terms + 1)]
    assert columns[:FEWEST] == zernike_columns()[:FEWEST]


def test_calibrate(changed: Product) -> None:
    found = changed.calibration
    assert (found["verdict"], found["findings"]) == ("ok", [])
    parameters = {row["name"]: row for row in found["parameters"]}
    for name in ("a_mm", "b_mm", "alpha_deg"):
        true = getattr(TRUE_GEOMETRY, name) - getattr(STATED_GEOMETRY, name)
        row = parameters[name]
        assert abs(row["value"] - true) < FOUND_SIGMAS * row["sigma"], name
        assert row["sigma"] < row["sigma_before"], name
    assert (changed.folder / "geometry-residuals.png").stat().st_size > 10_000


def test_film(changed: Product) -> None:
    found = changed.material
    for name, true in (
        ("prestrain", PRESTRAIN),
        ("poisson", POISSON_RATIO),
        ("stiffness_n_per_m", STIFFNESS_N_PER_M),
    ):
        assert abs(found[name]["value"] - true) < FOUND_SIGMAS * found[name]["sigma"], name
        assert found[name]["sigma"] < 0.05 * true, name
    for one in found["sets"]:
        # 95 % of the squared departure from Hencky's film
        assert one["left_rms_um"] < math.sqrt(0.05) * 1e3 * abs(one["edge_from_hencky_mm"])
    assert (changed.folder / "film" / "film.png").stat().st_size > 10_000


def test_the_usual_program_names_the_number_of_a_run_and_reads_the_rest(
    changed: Product, usual: Product, tmp_path: Path
) -> None:
    run = changed.hold("track")
    report = json.loads(usual.source.run_program("report", run, "--json", "--out", tmp_path))
    found = (
        f"written with zernike terms = {changed.terms}, this program has {usual.terms}: left out"
    )
    for name in ("shapes", "tracked", "covariances"):
        assert f"{name}/{name}-0000.parquet: {found}" in report["notes"]
    assert report["shape"] is None
    assert report["ticks"] > 1000
