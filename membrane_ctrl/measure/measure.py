"""The `measure` command: one capture set to height, Zernike coefficients and quality."""

import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from membrane_ctrl.geometry.file import read_geometry
from membrane_ctrl.measure import figure_results, results
from membrane_ctrl.measure.measurement import Measurement, measure_set
from membrane_ctrl.metrology.figure.radial_profile import RadialProfile, radial_profile
from membrane_ctrl.metrology.frame_checks.frequency_series import (
    AxisSeries,
    SeriesFlag,
    check_series,
)
from membrane_ctrl.metrology.phase.phase_steps import equal_shifts, phasors
from membrane_ctrl.metrology.rays.rim_outline import Outline, find_outline
from membrane_ctrl.model import errors
from membrane_ctrl.model.arrays import BoolArray, FloatArray
from membrane_ctrl.model.files import open_plain

_NAMED = 4  # inputs that contribute most


@dataclass(frozen=True)
class MeasureOptions:
    """Options of the command."""

    folder: Path
    geometry: Path | None = None
    out: Path | None = None
    as_json: bool = False
    pictures: bool = True
    rerun: bool = False
    nominal_radius_mm: float | None = None
    report: bool = False


def measure_command(options: MeasureOptions) -> int:
    """Measure one set, write the result and report it. Returns the exit code; raises InputError."""
    folder, geometry = options.folder, options.geometry
    if folder.suffix == ".h5":
        return facet_command(folder, options.as_json)
    measurement = measure_set(folder, None if geometry is None else read_geometry(geometry))
    for key in measurement.head.ignored:
        print(f"{folder / 'capture.toml'}: {key}: unknown key, ignored", file=sys.stderr)
    target = (
        options.out.resolve() if options.out else folder / "result"
    )  # follow a link that the user names
    light, outline = light_and_rim(measurement)
    profile = _profile(measurement)
    bars = results.error_bars(measurement, geometry, outline)
    measurement = results.with_doubts(measurement, bars)
    figure = figure_results.measured_figure(measurement, bars, options.nominal_radius_mm)
    block = figure_results.figure_table(measurement, figure, bars) if figure and bars else None
    result = results.result_table(measurement, bars, block)
    details = results.details_table(measurement, profile, outline, bars)
    lines = _lines(measurement, profile, outline, bars) + (
        [] if figure is None else figure_results.figure_lines(figure)
    )
    begin = time.perf_counter()
    with errors.writing(target):
        results.write_result(target, measurement, result, details, bars)
        if figure is not None:
            figure_results.write_figure_maps(target / "figure.npz", figure)
        drawn: list[Path] = []
        if options.pictures or options.report:
            from membrane_ctrl.measure.pictures import draw_all

            drawn = draw_all(target, measurement, light, profile, outline, bars, figure)
            if options.report:
                figure_results.write_report(target, str(folder), lines, result, drawn)
        if options.rerun:
            from membrane_ctrl.measure.pictures import log_measurement

            log_measurement(target / "measurement.rrd", measurement, drawn)
    print(f"written to {target} in {time.perf_counter() - begin:.1f} s", file=sys.stderr)
    print(json.dumps(result) if options.as_json else "\n".join(lines))
    return int(errors.Exit.REJECTED if measurement.verdict == "rejected" else errors.Exit.DONE)


def light_and_rim(measurement: Measurement) -> tuple[FloatArray, Outline | None]:
    """Light of the picture in bins, and the rim found in it."""
    checked, optics = measurement.checked, measurement.head.optics
    if checked is None or measurement.full is None:
        return np.zeros((2, 2)), None
    light = (
        checked.binned.means[[k for used in checked.view.used for k in used]]
        .mean(axis=0)
        .astype(float)
    )
    bin_px = checked.binned.bin_px
    fine = np.repeat(np.repeat(light, bin_px, axis=0), bin_px, axis=1)
    rim_z = checked.tracer.vertex_z_mm + measurement.full.surface.sag_mm
    return light, find_outline(fine, checked.tracer.geometry, optics.mirror.radius_mm, rim_z)


def _profile(measurement: Measurement) -> RadialProfile | None:
    full = measurement.full
    if full is None:
        return None
    return radial_profile(
        full.grid.axis_mm, full.height_mm(), measurement.head.optics.mirror.radius_mm
    )


def _lines(
    measurement: Measurement,
    profile: RadialProfile | None,
    outline: Outline | None,
    bars: results.ErrorBars | None,
) -> list[str]:
    """The result as lines of text."""
    full = measurement.full
    lines = [
        f"verdict   {measurement.verdict}{': ' + measurement.reason if measurement.reason else ''}"
    ]
    lines += [f"flagged   {item['file']}: {item['reason']}" for item in measurement.flagged_files()]
    if full is None or profile is None or bars is None:
        return lines
    of_noise, of_geometry = bars.sag_um
    total, rows = bars.budget.total(), bars.budget.rows()
    largest = ", ".join(f"{row['name']} {row['height_rms_um']:.3g}" for row in rows[:_NAMED])
    residual_um = 1e3 * full.residual_mm[np.isfinite(full.residual_mm)]
    coeffs = 1e3 * full.surface.coeffs_mm
    lines += [
        f"sag       {full.surface.sag_mm:.4f} mm, 1 sigma {of_noise:.2g} µm from noise and "
        "the film, "
        f"{of_geometry:.3g} µm from the geometry",
        f"geometry  {bars.source}",
        f"budget    1 sigma of height {total['height_rms_um']:.3g} µm RMS, without its plane "
        f"{total['figure_rms_um']:.3g} µm; largest: {largest}",
        f"Hencky    {profile.sag_mm:.4f} mm, {profile.pressure_pa:.0f} Pa under the paper's film",
        f"figure    astigmatism {np.hypot(*coeffs[4:6]):.2f} µm, coma "
        f"{np.hypot(*coeffs[6:8]):.2f} µm, "
        f"trefoil {np.hypot(*coeffs[8:10]):.2f} µm (RMS)",
        f"residual  {full.quality.residual_urad:.2f} µrad of slope, {residual_um.std():.3f} "
        "µm RMS of height",
        f"fit       {len(full.fit.changes_mm)} iterations, last change "
        f"{full.fit.changes_mm[-1]:.1e} mm, "
        f"{np.count_nonzero(full.weights)} pixels",
    ]
    if outline is not None:
        lines.append(
            f"rim       {outline.offset_mm:.1f} mm off the prediction, "
            f"{outline.size_ratio:.4f} of the predicted size"
        )
    return lines


# Frames of a measurement by SOFAST (OpenCSP, Sandia), from its HDF5 file, with lengths converted to
# mm.
#
# `measure` of a SOFAST file checks its frames only: slopes need the poses that SOFAST itself finds.

SOFAST_STEPS = 4  # SOFAST always takes four
MM_PER_M = 1e3
_ELEMENTS_MAX = 100_000_000  # 24 frames of 4 megapixels; each pixel takes eight bytes in memory


@dataclass(frozen=True)
class SofastMeasurement:
    """Frames of a measurement."""

    # (F, 4, H, W): fringes that vary along the screen's x and y: frequency, step, row, column
    frames_x: FloatArray
    frames_y: FloatArray  # (F, 4, H, W)
    periods_x: FloatArray  # (F,): periods per screen
    periods_y: FloatArray  # (F,)
    black: FloatArray  # (H, W)
    white: FloatArray  # (H, W)
    distance_mm: float  # facet's measure point to the screen's origin


def read_measurement(path: Path) -> SofastMeasurement:
    """Read frames and their data. Raises ValueError, FileNotFoundError or ImportError with one
    line.
    """
    with open_file(path) as file:
        group = "MeasurementSofastFringe"
        frames = np.moveaxis(floats(file, f"{group}/fringe_images"), 2, 0)
        black, white = np.moveaxis(floats(file, f"{group}/mask_images"), 2, 0)
        periods_x, periods_y = (floats(file, f"{group}/fringe_periods_{axis}") for axis in "xy")
        distance_m = float(floats(file, f"{group}/dist_optic_screen").item())
    count_y = SOFAST_STEPS * len(periods_y)
    if len(frames) != count_y + SOFAST_STEPS * len(periods_x):
        raise ValueError(
            f"{path}: {group}/fringe_images has {len(frames)} frames, not {SOFAST_STEPS} for "
            "each of "
            f"{len(periods_y)} + {len(periods_x)} frequencies"
        )
    size = black.shape
    return SofastMeasurement(
        frames_x=frames[count_y:].reshape(-1, SOFAST_STEPS, *size),
        frames_y=frames[:count_y].reshape(-1, SOFAST_STEPS, *size),  # y comes first in the file
        periods_x=periods_x,
        periods_y=periods_y,
        black=black,
        white=white,
        distance_mm=distance_m * MM_PER_M,
    )


def open_file(path: Path) -> Any:
    """Open the file with h5py (untyped), an optional extra that only this reader needs."""
    try:
        import h5py
    except ImportError:
        raise ImportError("SOFAST files need h5py: pip install 'membrane-ctrl[sofast]'") from None
    try:
        open_plain(path, follow=True).close()  # h5py would wait forever for a pipe without a writer
        return h5py.File(path, "r")
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: no such file") from None
    except OSError as error:
        raise ValueError(f"{path}: not an HDF5 file ({error})") from None


def item(file: Any, name: str) -> Any:
    """A data set of the file itself; refuses links to other files and implausible sizes."""
    import h5py

    try:
        parts = name.split("/")
        for end in range(1, len(parts) + 1):
            link = file.get("/".join(parts[:end]), getlink=True)
            if link is None:
                raise ValueError(f"{file.filename}: {name} is missing")
            if not isinstance(link, h5py.HardLink):
                raise ValueError(
                    f"{file.filename}: {name} is a link, and links are not followed here"
                )
        found = file[name]
        if not isinstance(found, h5py.Dataset) or found.is_virtual or found.external:
            raise ValueError(f"{file.filename}: {name} is not a data set of this file")
        if found.size is None or found.size > _ELEMENTS_MAX:
            raise ValueError(
                f"{file.filename}: {name} has {found.shape} elements, too many to read"
            )
        return found[()]
    except (
        OSError,
        RuntimeError,
        KeyError,
        TypeError,
    ) as error:  # HDF5's errors for a damaged file
        raise ValueError(f"{file.filename}: {name} cannot be read ({error})") from None


def floats(file: Any, name: str) -> FloatArray:
    try:
        return np.asarray(item(file, name), float)
    except TypeError:
        raise ValueError(f"{file.filename}: {name} holds no numbers") from None


# SOFAST shows cos(2 pi p s - k pi / 2), s from 1 at column 0 to 0 at the last column, and from 1 at
# row 0 to 0 at the last row; its screen coordinates have y the other way round, so the y fraction
# is 1 - s.
SHIFTS_RAD = -equal_shifts(SOFAST_STEPS)
_LIT_SHARE = 0.3  # of the bright pixels' swing


def lit_pixels(measurement: SofastMeasurement) -> BoolArray:
    """Pixels (H, W) that see fringes: thresholds the median swing over the series, robust to single
    bad frames.
    """
    series = (*measurement.frames_y, *measurement.frames_x)
    swing = np.median([np.abs(phasors(steps, SHIFTS_RAD)) for steps in series], axis=0)
    return np.asarray(swing > _LIT_SHARE * np.percentile(swing, 95))


def series_of(measurement: SofastMeasurement, mask: BoolArray) -> tuple[AxisSeries, AxisSeries]:
    """The axes of a measurement at the pixels in `mask`, in the order of capture."""
    return (
        AxisSeries("y", measurement.frames_y[..., mask], measurement.periods_y, SHIFTS_RAD),
        AxisSeries("x", measurement.frames_x[..., mask], measurement.periods_x, SHIFTS_RAD),
    )


_LEAST_PIXELS = 200  # fewer cannot judge a frame


def facet_command(path: Path, as_json: bool) -> int:
    """Check the frames and report. Returns the exit code; raises InputError if it is not a SOFAST
    file.
    """
    try:
        measurement = read_measurement(path)
    except (ValueError, OSError, ImportError) as error:
        raise errors.InputError(str(error)) from None
    mask = lit_pixels(measurement)
    if np.count_nonzero(mask) < _LEAST_PIXELS:
        raise errors.InputError(f"{path}: only {np.count_nonzero(mask)} pixels see fringes")
    found = check_series(
        series_of(measurement, mask), measurement.black[mask], measurement.white[mask]
    )
    flagged = [{"file": _name(measurement, flag), "reason": flag.reason} for flag in found.flags]
    table = {
        "schema": "membrane-frames/1",
        "quality": {"verdict": found.verdict, "reason": found.reason, "flagged_frames": flagged},
        "pixels": int(np.count_nonzero(mask)),
    }
    lines = [f"verdict   {found.verdict}{': ' + found.reason if found.reason else ''}"]
    lines += [f"flagged   {item['file']}: {item['reason']}" for item in flagged]
    print(json.dumps(table) if as_json else "\n".join(lines))
    return int(errors.Exit.REJECTED if found.verdict == "rejected" else errors.Exit.DONE)


def _name(measurement: SofastMeasurement, flag: SeriesFlag) -> str:
    """Name for people: axis, periods per screen, step from 0."""
    if flag.axis in ("white", "black"):
        return flag.axis
    periods = measurement.periods_x if flag.axis == "x" else measurement.periods_y
    return f"{flag.axis}, {periods[flag.index]:g} periods, step {flag.step}"
