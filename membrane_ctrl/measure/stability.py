"""The `stability` command: the paper's stability analysis over a run of many sets, one set in memory at a time."""

import json
import math
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from membrane_ctrl.geometry.file import read_geometry
from membrane_ctrl.measure import capture_set, measurement, results, stability_run
from membrane_ctrl.metrology.uncertainty.stability import default_points_mm
from membrane_ctrl.model import errors, files, terminal


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
    figures = measurement.Figures(None if options.geometry is None else read_geometry(options.geometry))
    folders = set_folders(options.folder, out)
    size_px, analysis_radius_mm = common_size(folders)
    points = points_mm(options.points, analysis_radius_mm)
    with errors.writing(out):
        files.make_folder(out)
        with stability_run.StabilityRun(out, points, options.trials, options.seed, options.geometry) as run:
            _analyse(folders, figures, run)
        if run.used == 0:
            raise errors.RejectedError(
                f"{options.folder}: none of the {len(folders)} sets gave a figure ({run.first_reason})"
            )
        table = {"schema": "membrane-stability/1", "run": str(options.folder), "size_px": size_px} | run.table()
        results.write_json(out / "stability.json", table)
        pictures = run.draw()
        if options.rerun:
            run.record(pictures)
    print(f"written to {out}", file=sys.stderr)
    print(json.dumps(table) if options.as_json else "\n".join(run.lines()))
    return 0


def set_folders(run: Path, out: Path) -> list[Path]:
    """The sets of a run, sorted by name, without results of earlier analyses. Raises InputError if there are none."""
    if not run.is_dir():
        raise errors.InputError(f"{run}: no such run of sets")
    if (run / "capture.toml").is_file():
        raise errors.InputError(f"{run}: is itself a capture set; name the folder above it")
    found = sorted(path for path in run.iterdir() if path.is_dir() and path.resolve() != out.resolve())
    folders = [path for path in found if not (path / stability_run.SERIES).is_file()]
    if not folders:
        raise errors.InputError(f"{run}: holds no capture sets")
    return folders


def common_size(folders: Iterable[Path]) -> tuple[tuple[int, int], float]:
    """Width and height in pixels and analysis radius in mm, common to all sets of a run.

    Skips sets with unreadable descriptions; the analysis counts them.

    Raises InputError for two sizes in one run, naming a set of each; RejectedError if no description is readable.
    """
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
                f"{folder / 'capture.toml'}: camera: {size[0]} x {size[1]} pixels, but {first[0].name} has "
                f"{first[1][0]} x {first[1][1]}; a run must have one size"
            )
    if first is None:
        raise errors.RejectedError(f"no set can be read: {reason}")
    return first[1], first[2]


def points_mm(given: tuple[str, ...], analysis_radius_mm: float) -> dict[str, tuple[float, float]]:
    """Named points from NAME=X,Y in mm; A, B and C if none are given. Raises InputError."""
    points: dict[str, tuple[float, float]] = {}
    for text in given:
        name, _, place = text.partition("=")
        try:
            x, y = (float(part) for part in place.split(","))
        except ValueError:
            raise errors.InputError(f"--point {text}: give NAME=X,Y in mm, e.g. A=100,-200") from None
        if not name or not math.hypot(x, y) <= analysis_radius_mm:
            within = f"within {analysis_radius_mm:g} mm of the vertex"
            raise errors.InputError(f"--point {text}: needs a name and a place {within}")
        points[name] = (x, y)
    return points or default_points_mm(analysis_radius_mm)


def _analyse(folders: list[Path], figures: measurement.Figures, run: stability_run.StabilityRun) -> None:
    """Analyse the sets one after the other, with a bar on a terminal; name and skip bad ones."""
    for number, folder in enumerate(terminal.counted(folders, "sets")):
        try:
            run.add(folder.name, number, figures.of(folder))
        except errors.CommandError as error:
            run.skip(folder.name, str(error))
            print(terminal.one_line(f"skipped {folder.name}: {error}"), file=sys.stderr)
