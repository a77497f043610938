"""The `measure` command: one capture set to height, Zernike coefficients and quality."""

import json
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from membrane_ctrl.config import sight
from membrane_ctrl.geometry.file import read_geometry
from membrane_ctrl.measure import figure_report, figure_results, results
from membrane_ctrl.measure.measurement import Measurement, measure_set
from membrane_ctrl.measure.sofast_command import check_sofast_file
from membrane_ctrl.metrology.figure.radial_profile import RadialProfile, radial_profile
from membrane_ctrl.metrology.frame_checks.checked_set import Checked
from membrane_ctrl.metrology.rays.rim_outline import Outline, find_outline
from membrane_ctrl.model import errors
from membrane_ctrl.model.arrays import FloatArray

_NOT_LINEAR = 0.1  # of the response's exponent
_UNEVEN = 0.1  # of the light
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
        return check_sofast_file(folder, options.as_json)
    measurement = measure_set(folder, None if geometry is None else read_geometry(geometry))
    for key in measurement.head.ignored:
        print(f"{folder / 'capture.toml'}: {key}: unknown key, ignored", file=sys.stderr)
    target = (
        options.out.resolve() if options.out else folder / "result"
    )  # follow a link that the user names
    light, outline = light_and_rim(measurement)
    profile = _fit_radial_profile(measurement)
    try:
        bars = results.error_bars(measurement, geometry, outline)
    except errors.InputError as error:
        reason = _name_lens_fold(measurement, str(error), explains=True)
        raise errors.InputError(reason) from None
    measurement = results.degrade_doubtful(measurement, bars)
    contradicted = bars is not None and bool(bars.statement.doubts)
    reason = _name_lens_fold(measurement, measurement.reason, explains=contradicted)
    measurement = replace(measurement, reason=reason)
    figure = figure_results.measured_figure(measurement, bars, options.nominal_radius_mm)
    block = figure_results.figure_table(measurement, figure, bars) if figure and bars else None
    result = results.result_table(measurement, bars, block)
    details = results.details_table(measurement, profile, outline, bars)
    lines = _format_measurement(measurement, profile, outline, bars) + (
        [] if figure is None else figure_results.figure_lines(figure)
    )
    begin = time.perf_counter()
    with errors.convert_write_errors(target):
        results.write_result(target, measurement, result, details, bars)
        if figure is not None:
            figure_results.write_figure_maps(target / "figure.npz", figure)
        drawn: list[Path] = []
        if options.pictures or options.report:
            from membrane_ctrl.measure.pictures import draw_measurement

            drawn = draw_measurement(target, measurement, light, profile, outline, bars, figure)
            if options.report:
                figure_report.write_report(target, str(folder), lines, result, drawn)
        if options.rerun:
            from membrane_ctrl.measure.rerun_recording import log_measurement

            log_measurement(target / "measurement.rrd", measurement, drawn)
    print(f"written to {target} in {time.perf_counter() - begin:.1f} s", file=sys.stderr)
    print(json.dumps(result) if options.as_json else "\n".join(lines))
    return int(errors.Exit.REJECTED if measurement.verdict == "rejected" else errors.Exit.DONE)


def _name_lens_fold(measurement: Measurement, reason: str, explains: bool) -> str:
    """The reason, with a lens model that folds within the picture.

    `explains`: the frames contradict the geometry, which such a model explains; otherwise it is
    only mentioned.
    """
    doubt = sight.find_lens_doubt(measurement.head.optics)
    if doubt is None or not reason:
        return reason
    fold = f"camera.distortion: {doubt.why}; {doubt.remedy}"
    return f"{fold}; it shows as: {reason}" if explains else f"{reason}; {fold}"


def _describe_light(checked: Checked | None) -> list[str]:
    """What the frames show of panel and camera, where it differs from an ideal one."""
    if checked is None:
        return []
    lines = []
    held, response = checked.held, checked.response
    if held.corrected:
        lines.append(
            f"panel     each frame showed {held.share:.2%} +- {held.sigma:.2%} of the previous "
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


def _fit_radial_profile(measurement: Measurement) -> RadialProfile | None:
    full = measurement.full
    if full is None:
        return None
    return radial_profile(
        full.grid.axis_mm, full.height_mm(), measurement.head.optics.mirror.radius_mm
    )


def _format_measurement(
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
        f"geometry  {bars.statement.describe()}",
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
    lines += _describe_light(measurement.checked)
    if outline is not None:
        rim = bars.statement.rim
        sigmas = "" if rim is None else f", {rim.sigmas:.1f} sigma of the stated geometry"
        lines.append(
            f"rim       {outline.offset_mm:.1f} mm off the prediction, "
            f"{outline.size_ratio:.4f} of the predicted size{sigmas}"
        )
    return lines
