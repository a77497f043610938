"""The `stability` command: the paper's stability analysis over a run of many sets, one set in
memory at a time.
"""

import contextlib
import csv
import json
import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from membrane_ctrl.geometry import spread_file
from membrane_ctrl.geometry.file import read_geometry
from membrane_ctrl.measure import (
    capture_set,
    measurement,
    result_files,
    stability_pictures,
    stability_results,
    stability_text,
)
from membrane_ctrl.measure.set_statement import SetStatement, state_set
from membrane_ctrl.metrology.rays.surface import PARAMETERS, parameter_to_coeffs
from membrane_ctrl.metrology.uncertainty import (
    figure_pairs,
    geometry_spread,
    height_map,
    monte_carlo,
    running_statistics,
)
from membrane_ctrl.model import errors, files, program, terminal
from membrane_ctrl.model.arrays import FloatArray

SERIES = "series.csv"  # its presence also distinguishes a result folder from a set
_LISTED_BAD = 100  # bad sets listed in the table; all of them are in series.csv
_PAIR_HEAD = (
    "lag_s",
    "earlier",
    "later",
    "seconds",
    "change_rms_um",
    "rmse_mean_um",
    "rmse_max_um",
)


class StabilityRun:
    """Statistics over the sets of a run.

    Parameters
    ----------
    out : Path
        Existing folder for `series.csv`, `pairs.csv`, the SD map and the pictures.
    points_mm : mapping of str to (float, float)
        The points whose height is followed.
    trials, seed : int
        Monte Carlo trials of each set, and their seed.
    geometry : Path, optional
        File of the sets' geometry, with its covariance.
    """

    def __init__(
        self,
        out: Path,
        points_mm: Mapping[str, tuple[float, float]],
        trials: int,
        seed: int,
        geometry: Path | None = None,
    ) -> None:
        self._out = out
        self._points_mm = dict(points_mm)
        self._trials = trials
        self._seed = seed
        self._geometry = geometry
        self._open = contextlib.ExitStack()
        self._series = self._open_table(SERIES, stability_results.series_head(points_mm))
        self._pair_rows = self._open_table("pairs.csv", _PAIR_HEAD)

        # From the first set: the map's points, and the spread of the geometry with its source.
        self._grid: height_map.HeightMap | None = None
        self._point_matrix: FloatArray = np.zeros((len(points_mm), PARAMETERS))
        self._spread: geometry_spread.GeometrySpread | None = None
        self._source = ""
        self._origin: dict[str, str | None] = {}

        # Running statistics of all sets.
        self._parameters = running_statistics.RunningCovariance(PARAMETERS)
        self._heights = {name: running_statistics.Tally() for name in points_mm}
        self._rmse = running_statistics.Tally()
        self._time = running_statistics.Tally()

        # Pairs of sets: change and RMSE by lag, and the first pair of each.
        self._finder = figure_pairs.PairFinder()
        self._pairs = {
            lag: (running_statistics.Tally(), running_statistics.Tally())
            for lag in figure_pairs.LAGS_S
        }
        self._shown: dict[float, figure_pairs.FigurePair] = {}
        self._bad: list[dict[str, str]] = []
        self._bad_count = 0
        self.degraded = 0
        self._stated: SetStatement | None = None

    def __enter__(self) -> "StabilityRun":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self._open.close()

    def _open_table(self, name: str, head: Sequence[str]) -> Any:
        """A CSV writer of a new file, which stays open until the run is closed."""
        file = self._open.enter_context(files.fresh_text(self._out / name))
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(head)
        return rows

    @property
    def used_count(self) -> int:
        """Number of sets with a figure."""
        return self._parameters.count

    @property
    def first_reason(self) -> str:
        """Reason of the first bad set."""
        if self._bad:
            return self._bad[0]["reason"]
        return ""

    def state(self, stated: SetStatement) -> None:
        """Take what `measure` states of the first set with a figure: it anchors the others."""
        self._stated = stated

    def skip_set(self, name: str, reason: str) -> None:
        """Count a set without a figure, and give it a row of the series.

        Parameters
        ----------
        name : str
            The set's folder.
        reason : str
            Why it has no figure; the first few are listed in the result.
        """
        self._bad_count += 1
        if len(self._bad) < _LISTED_BAD:
            self._bad.append({"set": name, "reason": reason})
        self._series.writerow((name, "rejected", reason))

    def add(self, name: str, number: int, one: measurement.SetFigure) -> None:
        """Add the figure of a set: its uncertainty, its row, and the pairs that end with it.

        Parameters
        ----------
        name : str
            The set's folder.
        number : int
            Place of the set in the run, from 0; it seeds the noise of its trials.
        one : SetFigure
            The figure. Sets are added in the order of the run.

        Raises
        ------
        InputError
            The spread of the geometry is too wide for the trials' fits to converge.
        """
        grid = self._grid_for(one)
        spread = self._spread_for(one)
        surface = one.figure.fit.surface
        parameters = surface.parameters

        # Its uncertainty, by Monte Carlo.
        bench = one.make_trial_bench()
        numbers_of_trials = range(self._trials)
        try:
            all_trials = monte_carlo.run_trials(
                [bench], spread, self._seed, numbers_of_trials, number
            )
        except ArithmeticError as error:
            raise errors.InputError(f"{one.head.folder}: uncertainty: {error}") from None
        trials = all_trials[:, 0]
        rmse_um = float(1e3 * grid.sigma(monte_carlo.trial_covariance(trials)).mean())

        # The running statistics.
        self._parameters.add(parameters)
        self.degraded += one.verdict == "degraded"
        self._rmse.add(rmse_um)
        if math.isfinite(one.time_s):
            self._time.add(one.time_s)
        heights_um: list[float] = (1e3 * self._point_matrix @ parameters).tolist()
        for tally, height in zip(self._heights.values(), heights_um, strict=True):
            tally.add(height)

        # The row of the set, and the pairs that end with it.
        values = (
            one.time_s,
            one.displacement_um,
            1e3 * surface.sag_mm,
            one.figure.quality.residual_urad,
            rmse_um,
            *heights_um,
            *(1e3 * surface.coeffs_mm),
        )
        cells = [f"{value:.12g}" for value in values]
        self._series.writerow((name, one.verdict, one.reason, *cells))
        moment = figure_pairs.Moment(name, one.time_s, parameters, trials)
        for pair in self._finder.add(moment):
            self._add_pair(grid, pair)

    def make_table(self) -> dict[str, Any]:
        """The content of `stability.json`, less its head."""
        sd_um = self._sd_um()
        # Noll coefficients from the parameters of the fit, among which is the excess of the bowl.
        to_coeffs = parameter_to_coeffs()
        covariance = to_coeffs @ self._parameters.covariance @ to_coeffs.T
        duration_s = None
        if self._time.count:
            duration_s = self._time.high - self._time.low
        geometry: dict[str, Any] = {**self._origin, "names": [], "sigmas": []}
        if self._spread is not None:
            geometry["names"] = list(self._spread.names)
            geometry["sigmas"] = self._spread.sigmas.tolist()
        geometry["source"] = self._source
        return {
            "sets": {
                "found": self.used_count + self._bad_count,
                "used": self.used_count,
                "degraded": self.degraded,
                "bad": self._bad_count,
                "bad_sets": self._bad,
            },
            "first_set": None if self._stated is None else self._stated.table(),
            "duration_s": duration_s,
            "sd_um": {"mean": float(sd_um.mean()), "max": float(sd_um.max())},
            "points": self._point_table(),
            "pairs": [self._pair_table(lag) for lag in figure_pairs.LAGS_S],
            "rmse_um": {"mean": self._rmse.mean, "min": self._rmse.low, "max": self._rmse.high},
            "zernike": {
                "index": "noll",
                "first": 1,
                "mean_um": (1e3 * to_coeffs @ self._parameters.mean).tolist(),
                "sd_um": (1e3 * np.sqrt(np.diag(covariance))).tolist(),
            },
            "trials": self._trials,
            "seed": self._seed,
            "geometry": geometry,
        }

    def format_lines(self) -> list[str]:
        """The result as lines of text."""
        return stability_text.format_stability(self.make_table())

    def draw_pictures(self) -> list[Path]:
        """Write the SD map and the pictures, and return the latter.

        The series must be closed. Raises OSError.
        """
        grid = self._grid
        if grid is None:
            return []
        axis_mm = grid.axis_mm
        sd_um = grid.picture(self._sd_um())
        result_files.write_arrays(self._out / "sd.npz", x_mm=axis_mm, y_mm=axis_mm, sd_um=sd_um)

        # Standard deviation, heights and terms over time.
        times, heights, coeffs = self._read_followed()
        stability = self._out / "stability.png"
        stability_pictures.draw_stability(
            stability, axis_mm, sd_um, times, self._points_mm, heights
        )
        zernike = self._out / "zernike.png"
        stability_pictures.draw_zernike(zernike, times, coeffs)
        if not self._shown:
            return [stability, zernike]

        # Change and RMSE of the first pair of each lag.
        maps = {}
        for lag_s, pair in self._shown.items():
            change_um = grid.picture(1e3 * grid.matrix @ pair.change_mm)
            rmse_um = grid.picture(1e3 * grid.sigma(pair.covariance))
            maps[lag_s] = (change_um, rmse_um)
        pairs = self._out / "pairs.png"
        stability_pictures.draw_pairs(pairs, axis_mm, maps)
        return [stability, zernike, pairs]

    def write_recording(self, pictures: list[Path]) -> None:
        """Write `stability.rrd`; the series must be closed. Raises OSError."""
        if self._grid is None:
            return
        sd_um = self._grid.picture(self._sd_um())
        followed = (list(self._points_mm), *self._read_followed())
        stability_pictures.log_stability(
            self._out / "stability.rrd", *followed, sd_um, self.format_lines(), pictures
        )

    def _read_followed(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Times, point heights and terms of the sets with a figure."""
        times, heights, coeffs = stability_results.read_series(
            self._out / SERIES, len(self._points_mm)
        )
        if not np.isfinite(times).all():  # sets without times: use their numbers
            times = np.arange(len(times), dtype=float)
        return times, heights, coeffs

    def _grid_for(self, one: measurement.SetFigure) -> height_map.HeightMap:
        """The points of the map, those of the first set."""
        if self._grid is None:
            mirror = one.head.optics.mirror
            self._grid = height_map.HeightMap.over_disc(mirror.analysis_radius_mm, mirror.radius_mm)
            x, y = np.array(list(self._points_mm.values())).T
            self._point_matrix = height_map.height_matrix(x, y, mirror.radius_mm)
        return self._grid

    def _spread_for(self, one: measurement.SetFigure) -> geometry_spread.GeometrySpread:
        """The spread of the geometry, that of the first set."""
        if self._spread is None:
            spread, source = spread_file.geometry_spread(one.head.optics, self._geometry)
            self._spread = spread
            self._source = source
            self._origin = one.head.geometry.make_table()
        return self._spread

    def _sd_um(self) -> FloatArray:
        """Standard deviations (points,) over the sets, at the grid points."""
        if self._grid is None:
            return np.zeros(1)
        return 1e3 * self._grid.sigma(self._parameters.covariance)

    def _add_pair(self, grid: height_map.HeightMap, pair: figure_pairs.FigurePair) -> None:
        """Count a pair, and write its row."""
        rmse_um = 1e3 * grid.sigma(pair.covariance)
        change_um = float(1e3 * np.sqrt(np.mean(np.square(grid.matrix @ pair.change_mm))))
        changes, rmses = self._pairs[pair.lag_s]
        changes.add(change_um)
        rmses.add(float(rmse_um.mean()))
        self._shown.setdefault(pair.lag_s, pair)
        seconds = pair.later.time_s - pair.earlier.time_s
        numbers = (seconds, change_um, float(rmse_um.mean()), float(rmse_um.max()))
        cells = [f"{value:.6g}" for value in numbers]
        self._pair_rows.writerow((f"{pair.lag_s:g}", pair.earlier.name, pair.later.name, *cells))

    def _point_table(self) -> dict[str, dict[str, float]]:
        """Height and its standard deviation at each point, by name."""
        table = {}
        for row, (name, (x_mm, y_mm)) in zip(
            self._point_matrix, self._points_mm.items(), strict=True
        ):
            tally = self._heights[name]
            table[name] = {
                "x_mm": x_mm,
                "y_mm": y_mm,
                "mean_um": tally.mean,
                "sd_um": 1e3 * math.sqrt(row @ self._parameters.covariance @ row),
                "peak_to_peak_um": tally.high - tally.low,
            }
        return table

    def _pair_table(self, lag_s: float) -> dict[str, Any]:
        """Change and RMSE of the pairs of one lag; None without pairs."""
        change, rmse = self._pairs[lag_s]
        table: dict[str, Any] = {"lag_s": lag_s, "count": change.count}
        for name, tally in (("change_rms_um", change), ("rmse_um", rmse)):
            table[name] = None
            if tally.count:
                table[name] = {"mean": tally.mean, "min": tally.low, "max": tally.high}
        return table


@dataclass(frozen=True)
class StabilityOptions:
    """Options of the command."""

    folder: Path
    out: Path | None
    points: tuple[str, ...]
    geometry: Path | None
    trials: int
    seed: int
    as_json: bool
    rerun: bool


def stability_command(options: StabilityOptions) -> int:
    """Analyse a run, write tables and pictures, and report. Raises CommandError."""
    out = options.out.resolve() if options.out else options.folder / "stability"
    figures = measurement.Figures(
        None if options.geometry is None else read_geometry(options.geometry)
    )

    # The sets of the run, and the points whose height is followed.
    folders = set_folders(options.folder, out)
    size_px, analysis_radius_mm = common_size(folders)
    points = points_mm(options.points, analysis_radius_mm)

    # One set after the other; then the table and the pictures.
    with errors.convert_write_errors(out):
        files.make_folder(out)
        with StabilityRun(out, points, options.trials, options.seed, options.geometry) as run:
            _analyse_sets(folders, figures, run)
            _state_first_set(folders, run, options.geometry)
        if run.used_count == 0:
            raise errors.RejectedError(
                f"{options.folder}: none of the {len(folders)} sets gave a figure "
                f"({run.first_reason})"
            )
        table = {
            **program.file_origin("membrane-stability/1"),
            "run": str(options.folder),
            "size_px": size_px,
        } | run.make_table()
        result_files.write_json(out / "stability.json", table)
        pictures = run.draw_pictures()
        if options.rerun:
            run.write_recording(pictures)
    print(f"written to {out}", file=sys.stderr)
    print(json.dumps(table) if options.as_json else "\n".join(run.format_lines()))
    return 0


def set_folders(run: Path, out: Path) -> list[Path]:
    """List the capture sets of a run, sorted by name.

    Parameters
    ----------
    run : Path
        Folder of the sets.
    out : Path
        Folder of this analysis, which is no set; nor is a folder with the results of an earlier
        one.

    Raises
    ------
    InputError
        There is no such folder, it is itself a set, or it holds none.
    """
    if not run.is_dir():
        raise errors.InputError(f"{run}: no such run of sets")
    if (run / "capture.toml").is_file():
        raise errors.InputError(f"{run}: is itself a capture set; name the folder above it")
    found = sorted(
        path for path in run.iterdir() if path.is_dir() and path.resolve() != out.resolve()
    )
    folders = [path for path in found if not (path / SERIES).is_file()]
    if not folders:
        raise errors.InputError(f"{run}: holds no capture sets")
    return folders


def common_size(folders: Iterable[Path]) -> tuple[tuple[int, int], float]:
    """Width and height in pixels and analysis radius in mm, common to all sets of a run.

    Skips sets with unreadable descriptions; the analysis counts them.

    Raises InputError for two sizes in one run, naming a set of each; RejectedError if no
    description is readable.
    """
    # The first set decides; sets that differ are named with it.
    first: tuple[Path, tuple[int, int], float] | None = None
    reason = ""
    for folder in folders:
        try:
            optics = capture_set.read_head(folder).optics
        except errors.CommandError as error:
            reason = reason or str(error)
            continue
        size = (optics.camera.width_px, optics.camera.height_px)
        if first is None:
            first = (folder, size, optics.mirror.analysis_radius_mm)
        elif size != first[1]:
            raise errors.InputError(
                f"{folder / 'capture.toml'}: camera: {size[0]} x {size[1]} pixels, but "
                f"{first[0].name} has "
                f"{first[1][0]} x {first[1][1]}; a run must have one size"
            )
    if first is None:
        raise errors.RejectedError(f"no set can be read: {reason}")
    return first[1], first[2]


def points_mm(given: tuple[str, ...], analysis_radius_mm: float) -> dict[str, tuple[float, float]]:
    """Read the points of a stability run from the command line.

    Parameters
    ----------
    given : tuple of str
        NAME=X,Y each, in mm; A, B and C if there are none.
    analysis_radius_mm : float
        Points must lie within it.

    Returns
    -------
    dict of tuple[float, float]
        x and y by name.

    Raises
    ------
    InputError
        A text of another form, or a point outside.
    """
    points: dict[str, tuple[float, float]] = {}
    for text in given:
        name, _, place = text.partition("=")
        try:
            x, y = (float(part) for part in place.split(","))
        except ValueError:
            raise errors.InputError(
                f"--point {text}: give NAME=X,Y in mm, e.g. A=100,-200"
            ) from None
        if not name or not math.hypot(x, y) <= analysis_radius_mm:
            within = f"within {analysis_radius_mm:g} mm of the vertex"
            raise errors.InputError(f"--point {text}: needs a name and a place {within}")
        points[name] = (x, y)
    return points or running_statistics.default_points_mm(analysis_radius_mm)


def _state_first_set(folders: list[Path], run: StabilityRun, geometry: Path | None) -> None:
    """Judge the first set that gives a figure as `measure` does."""
    given = None
    if geometry is not None:
        given = read_geometry(geometry)
    for folder in folders:
        try:
            run.state(state_set(folder, given, geometry))
        except errors.CommandError:
            continue
        return


def _analyse_sets(folders: list[Path], figures: measurement.Figures, run: StabilityRun) -> None:
    """Analyse the sets one after the other, with a bar on a terminal; name and skip bad ones."""
    for number, folder in enumerate(terminal.track_progress(folders, "sets")):
        try:
            run.add(folder.name, number, figures.measure_folder(folder))
        except errors.CommandError as error:
            run.skip_set(folder.name, str(error))
            print(terminal.one_line(f"skipped {folder.name}: {error}"), file=sys.stderr)
