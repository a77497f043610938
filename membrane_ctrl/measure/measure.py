"""The `measure` command: one capture set to height, Zernike coefficients and quality."""

import json
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from membrane_ctrl.config import sight
from membrane_ctrl.geometry.file import read_geometry
from membrane_ctrl.measure import figure_results, results
from membrane_ctrl.measure.measurement import Measurement, measure_set
from membrane_ctrl.measure.sofast_command import check_sofast_file
from membrane_ctrl.metrology.figure.radial_profile import RadialProfile, radial_profile
from membrane_ctrl.metrology.frame_checks.checked_set import Checked
from membrane_ctrl.metrology.rays.rim_outline import Outline, find_outline
from membrane_ctrl.model import errors
from membrane_ctrl.model.arrays import FloatArray

_NOT_LINEAR = 0.1  # difference of the response's exponent from 1 that is printed
_UNEVEN = 0.1  # loss of light over the mirror that is printed
_NAMED = 4  # inputs of the budget that are printed, those that contribute most


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


@dataclass(frozen=True)
class _Outcome:
    """All that the command writes and prints of one set.

    Attributes
    ----------
    measurement : Measurement
        The measurement, with its final verdict.
    bars : ErrorBars or None
        None without a figure, as for the next four.
    light : (rows, columns) array
        Light of the picture in bins.
    outline : Outline or None
        The rim in the picture; also None if it is not found.
    profile : RadialProfile or None
        Height over radius.
    figure : MeasuredFigure or None
        Radius, irregularity, spot and terms with error bars.
    """

    measurement: Measurement
    bars: results.ErrorBars | None
    light: FloatArray
    outline: Outline | None
    profile: RadialProfile | None
    figure: figure_results.MeasuredFigure | None


def measure_command(options: MeasureOptions) -> int:
    """Measure one set, write the result and report it.

    Parameters
    ----------
    options : MeasureOptions
        Options of the command.

    Returns
    -------
    int
        Exit code: rejected if the set gives no figure.

    Raises
    ------
    InputError
        The set, its reference or the geometry is invalid.
    """
    folder = options.folder
    if folder.suffix == ".h5":
        return check_sofast_file(folder, options.as_json)
    geometry = None
    if options.geometry is not None:
        geometry = read_geometry(options.geometry)
    measurement = measure_set(folder, geometry)
    for key in measurement.head.ignored:
        print(f"{folder / 'capture.toml'}: {key}: unknown key, ignored", file=sys.stderr)
    outcome = _evaluate(measurement, options)

    # A link that the user names is followed.
    target = options.out.resolve() if options.out else folder / "result"
    result = _make_result_table(outcome)
    lines = _format_measurement(outcome)
    if outcome.figure is not None:
        lines += figure_results.figure_lines(outcome.figure)
    begin = time.perf_counter()
    with errors.convert_write_errors(target):
        _write_files(target, outcome, result, lines, options)
    print(f"written to {target} in {time.perf_counter() - begin:.1f} s", file=sys.stderr)
    print(json.dumps(result) if options.as_json else "\n".join(lines))
    if outcome.measurement.verdict == "rejected":
        return int(errors.Exit.REJECTED)
    return int(errors.Exit.DONE)


def _evaluate(measurement: Measurement, options: MeasureOptions) -> _Outcome:
    """Error bars, the final verdict, and the figure of a measurement. Raises InputError."""
    light, outline = light_and_rim(measurement)
    profile = _fit_radial_profile(measurement)
    try:
        bars = results.error_bars(measurement, options.geometry, outline)
    except errors.InputError as error:
        reason = name_lens_fold(measurement, str(error), explains=True)
        raise errors.InputError(reason) from None
    measurement = results.apply_doubts(measurement, bars)
    contradicted = bars is not None and bool(bars.statement.doubts)
    reason = name_lens_fold(measurement, measurement.reason, explains=contradicted)
    measurement = replace(measurement, reason=reason)
    figure = figure_results.measured_figure(measurement, bars, options.nominal_radius_mm)
    return _Outcome(measurement, bars, light, outline, profile, figure)


def _make_result_table(outcome: _Outcome) -> dict[str, Any]:
    """The content of `result.json`."""
    figure_block = None
    if outcome.figure and outcome.bars:
        figure_block = figure_results.figure_table(
            outcome.measurement, outcome.figure, outcome.bars
        )
    return results.result_table(outcome.measurement, outcome.bars, figure_block)


def _write_files(
    target: Path,
    outcome: _Outcome,
    result: dict[str, Any],
    lines: list[str],
    options: MeasureOptions,
) -> None:
    """Write result, maps, pictures and recording. Raises OSError."""
    measurement = outcome.measurement
    bars = outcome.bars

    # Numbers and maps.
    details = results.details_table(measurement, outcome.profile, outcome.outline, bars)
    results.write_result(target, measurement, result, details, bars)
    if outcome.figure is not None:
        figure_results.write_figure_maps(target / "figure.npz", outcome.figure)

    # Pictures, report and recording, as far as they were asked for.
    drawn: list[Path] = []
    if options.pictures or options.report:
        from membrane_ctrl.measure.pictures import draw_measurement

        drawn = draw_measurement(
            target,
            measurement,
            outcome.light,
            outcome.profile,
            outcome.outline,
            bars,
            outcome.figure,
        )
    if options.report:
        from membrane_ctrl.measure import figure_report

        figure_report.write_report(target, str(options.folder), lines, result, drawn)
    if options.rerun:
        from membrane_ctrl.measure.rerun_recording import log_measurement

        log_measurement(target / "measurement.rrd", measurement, drawn)


def name_lens_fold(measurement: Measurement, reason: str, explains: bool) -> str:
    """Return the reason of a verdict, with a lens model that folds within the picture.

    Parameters
    ----------
    measurement : Measurement
        For the stated lens.
    reason : str
        Reason of the verdict; empty if there is none, which stays empty.
    explains : bool
        Whether the frames contradict the geometry. Such a lens model is then named as the cause,
        in front of the reason; otherwise it is mentioned behind it.
    """
    doubt = sight.find_lens_doubt(measurement.head.optics)
    if doubt is None or not reason:
        return reason
    fold = f"camera.distortion: {doubt.why}; {doubt.remedy}"
    if explains:
        return f"{fold}; it shows as: {reason}"
    return f"{reason}; {fold}"


def _describe_light(checked: Checked | None) -> list[str]:
    """What the frames show of panel and camera, where it differs from an ideal one."""
    if checked is None:
        return []
    lines = []
    lag = checked.lag
    response = checked.response
    if lag.corrected:
        lines.append(
            f"panel     each frame showed {lag.share:.2%} +- {lag.sigma:.2%} of the previous "
            "picture, which was taken out: wait longer before each frame"
        )
    if abs(response.exponent - 1) > _NOT_LINEAR:
        lines.append(
            f"response  panel and camera together: counts rise as level^{response.exponent:.2f}"
        )
    if max(abs(response.edge_loss), response.side_loss) > _UNEVEN:
        lines.append(
            f"light     {response.edge_loss:.0%} less at the mirror's edge than in its middle, "
            f"{response.side_loss:.0%} less from side to side: the panel's viewing angle, or the "
            "lens; it changes no phase"
        )
    return lines


def light_and_rim(measurement: Measurement) -> tuple[FloatArray, Outline | None]:
    """Light of the picture in bins, and the rim found in it."""
    checked = measurement.checked
    if checked is None or measurement.full is None:
        return np.zeros((2, 2)), None
    sinusoids = [k for used in checked.view.used for k in used]
    light = checked.binned.means[sinusoids].mean(axis=0).astype(float)
    bin_px = checked.binned.bin_px
    picture = np.repeat(np.repeat(light, bin_px, axis=0), bin_px, axis=1)
    rim_z_mm = checked.tracer.vertex_z_mm + measurement.full.surface.sag_mm
    radius_mm = measurement.head.optics.mirror.radius_mm
    return light, find_outline(picture, checked.tracer.geometry, radius_mm, rim_z_mm)


def _fit_radial_profile(measurement: Measurement) -> RadialProfile | None:
    full = measurement.full
    if full is None:
        return None
    return radial_profile(
        full.grid.axis_mm, full.height_mm(), measurement.head.optics.mirror.radius_mm
    )


def _format_measurement(outcome: _Outcome) -> list[str]:
    """The result as lines of text."""
    measurement = outcome.measurement
    reason = ""
    if measurement.reason:
        reason = f": {measurement.reason}"
    lines = [f"verdict   {measurement.verdict}{reason}"]
    lines += [f"flagged   {item['file']}: {item['reason']}" for item in measurement.flagged_files()]
    full = measurement.full
    profile = outcome.profile
    bars = outcome.bars
    if full is None or profile is None or bars is None:
        return lines

    # Sag, geometry and error budget.
    noise_um, geometry_um = bars.sag_sigma_um
    total = bars.budget.total()
    largest_rows = bars.budget.rows()[:_NAMED]
    largest = ", ".join(f"{row['name']} {row['height_rms_um']:.3g}" for row in largest_rows)
    lines += [
        f"sag       {full.surface.sag_mm:.4f} mm, 1 sigma {noise_um:.2g} µm from noise and the "
        f"film, {geometry_um:.3g} µm from the geometry",
        f"geometry  {bars.statement.describe()}",
        f"budget    1 sigma of height {total['height_rms_um']:.3g} µm RMS, without its plane "
        f"{total['figure_rms_um']:.3g} µm; largest: {largest}",
    ]

    # The figure and the fit.
    coeffs_um = 1e3 * full.surface.coeffs_mm
    astigmatism_um = np.hypot(*coeffs_um[4:6])
    coma_um = np.hypot(*coeffs_um[6:8])
    trefoil_um = np.hypot(*coeffs_um[8:10])
    residual_um = 1e3 * full.residual_mm[np.isfinite(full.residual_mm)]
    lines += [
        f"Hencky    {profile.sag_mm:.4f} mm, {profile.pressure_pa:.0f} Pa under the paper's film",
        f"figure    astigmatism {astigmatism_um:.2f} µm, coma {coma_um:.2f} µm, trefoil "
        f"{trefoil_um:.2f} µm (RMS)",
        f"residual  {full.quality.residual_urad:.2f} µrad of slope, {residual_um.std():.3f} µm RMS "
        "of height",
        f"fit       {len(full.fit.changes_mm)} iterations, last change "
        f"{full.fit.changes_mm[-1]:.1e} mm, {np.count_nonzero(full.weights)} pixels",
    ]

    # The light, and the rim in the picture.
    lines += _describe_light(measurement.checked)
    outline = outcome.outline
    if outline is not None:
        rim = bars.statement.rim
        sigmas = ""
        if rim is not None:
            sigmas = f", {rim.sigmas:.1f} sigma of the stated geometry"
        lines.append(
            f"rim       {outline.offset_mm:.1f} mm off the prediction, "
            f"{outline.size_ratio:.4f} of the predicted size{sigmas}"
        )
    return lines
