"""The files written by `measure`: `result.json` and `height.npz` (docs/reference/interfaces.md),
and `details.json`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from membrane_ctrl.config import sight
from membrane_ctrl.geometry.spread_file import find_known_by, geometry_spread
from membrane_ctrl.measure.measurement import Measurement, noise_seen_adu
from membrane_ctrl.measure.result_files import number_or_null, write_arrays, write_json
from membrane_ctrl.metrology.figure import radial_profile
from membrane_ctrl.metrology.figure.pixel_figure import FullResult
from membrane_ctrl.metrology.figure.reflection_fit import ReflectionFit
from membrane_ctrl.metrology.frame_checks.checked_set import Checked
from membrane_ctrl.metrology.rays import surface
from membrane_ctrl.metrology.rays.rim_outline import Outline
from membrane_ctrl.metrology.reconstruction import slope_noise
from membrane_ctrl.metrology.uncertainty import height_map, set_budget
from membrane_ctrl.metrology.uncertainty.budget import Budget
from membrane_ctrl.metrology.uncertainty.geometry_statement import GeometryStatement
from membrane_ctrl.metrology.uncertainty.reflection_error import ZeroError
from membrane_ctrl.model import errors, program, shape_estimate, zernike_terms
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.files import make_folder

_NO_ZERO_ERROR = ZeroError(0.0)  # of a map without error bars


@dataclass(frozen=True)
class ErrorBars:
    """The budget of a measurement; covariances (parameters, parameters) of the fit's parameters,
    mm^2.

    Attributes
    ----------
    budget : Budget
    statement : GeometryStatement
        How well the geometry is known, and by what.
    doubts : tuple of str
        Checks of the set that failed, and what to do.
    grid : height_map.HeightMap
        Grid of `maps_um`.
    cell_slope : float
        1 sigma of the mean slope of a cell of the height map, from pixel noise.
    zonal_um : float
        Standard uncertainty of the map's height over the fit.
    zero : ZeroError
        Of the map's zero.
    """

    budget: Budget
    statement: GeometryStatement
    doubts: tuple[str, ...]
    grid: height_map.HeightMap
    cell_slope: float = 0.0
    zonal_um: float = 0.0
    zero: ZeroError = _NO_ZERO_ERROR

    @property
    def noise(self) -> FloatArray:
        """From this set: noise, light, motion, slopes that the fit leaves."""
        return self.budget.covariance(common=False)

    @property
    def geometry(self) -> FloatArray:
        """From what all sets of the bench share: poses, lens, screen."""
        return self.budget.covariance(common=True)

    @property
    def sag_sigma_um(self) -> tuple[float, float]:
        """1 sigma of the sag from noise, and from the geometry."""
        gradient = surface.sag_gradient()
        of_noise_um = 1e3 * float(np.sqrt(gradient @ self.noise @ gradient))
        of_geometry_um = 1e3 * float(np.sqrt(gradient @ self.geometry @ gradient))
        return of_noise_um, of_geometry_um

    def maps_um(self) -> tuple[FloatArray, FloatArray]:
        """1 sigma (n, n) of the height on `grid.axis_mm`, from noise and from the geometry; NaN
        outside the analysis radius. An error of the zero moves the height everywhere.
        """
        of_noise_um = self.grid.picture(1e3 * self.grid.sigma(self.noise))
        of_geometry_um = self.grid.picture(1e3 * self.grid.sigma(self.geometry))
        of_zonal_um = math.hypot(self.zonal_um, self.zero.sigma_um)
        return np.hypot(of_noise_um, of_zonal_um), of_geometry_um


def error_bars(
    measurement: Measurement, geometry: Path | None, outline: Outline | None = None
) -> ErrorBars | None:
    """Compute the error bars of a measurement.

    Parameters
    ----------
    measurement : Measurement
        The measured set.
    geometry : Path or None
        File with the covariance of the geometry.
    outline : Outline, optional
        The rim in the picture, which checks the geometry.

    Returns
    -------
    ErrorBars or None
        None if the set has no figure.

    Raises
    ------
    InputError
        If the covariance is invalid or for the other form of geometry, or too wide to propagate.
    """
    full = measurement.full
    checked = measurement.checked
    optics = measurement.head.optics
    if full is None or checked is None:
        return None
    spread, source = geometry_spread(optics, geometry)

    # Noise of a pixel: as stated, or as the frames show it, if that is larger.
    stated_adu = slope_noise.pixel_sigma_adu(optics.camera.noise_adu)
    noise_adu = float(np.nanmax([stated_adu, noise_seen_adu(measurement)]))
    try:
        seen = set_budget.assemble_budget(optics, checked, full, spread, noise_adu, outline)
    except ArithmeticError:
        raise errors.InputError(
            f"{source}: too wide: the figure does not follow from such a geometry"
        ) from None
    grid = height_map.HeightMap.over_disc(optics.mirror.analysis_radius_mm, optics.mirror.radius_mm)

    # Noise of the zonal map: that of a pixel's slope, averaged over the pixels of a cell.
    shifts_rad = [checked.stack.shifts_rad(used) for used in checked.view.used]
    variance = full.slope_variance(optics, shifts_rad, noise_adu)
    pixels_in_cell = float(np.median(full.grid.count[full.grid.count > 0]))
    cell_slope = math.sqrt(float(variance.mean()) / pixels_in_cell)
    zonal_um = 1e3 * full.grid.noise_mm(cell_slope)
    statement = GeometryStatement.from_evidence(
        find_known_by(optics, geometry), source, seen.rim, seen.slopes
    )
    zero = ZeroError(zonal_um, seen.zero_reflections_um)
    return ErrorBars(seen.budget, statement, seen.doubts, grid, cell_slope, zonal_um, zero)


def apply_doubts(measurement: Measurement, bars: ErrorBars | None) -> Measurement:
    """Return the measurement with the verdict that its error bars allow.

    A doubt degrades an `ok`, and so does a geometry that rim or slopes contradict. The figure is
    unusable if slopes belong to no surface and no stated uncertainty explains them, or if a
    contradicted geometry has a lens model that folds within the picture: such a model is wrong far
    from its fold, too.

    Parameters
    ----------
    measurement : Measurement
        The set and its height.
    bars : ErrorBars or None
        Its error bars; without any the verdict stays.
    """
    if bars is None or measurement.verdict == "rejected":
        return measurement
    statement = bars.statement
    doubts = [*bars.doubts, *statement.doubts]
    if not doubts:
        return measurement
    known = []
    if measurement.reason:
        known = [measurement.reason]
    is_unusable = statement.slopes.unusable
    if statement.doubts and sight.find_lens_doubt(measurement.head.optics) is not None:
        is_unusable = True
    verdict: shape_estimate.Verdict = "rejected" if is_unusable else "degraded"
    return replace(measurement, verdict=verdict, reason="; ".join([*known, *doubts]))


def result_table(
    measurement: Measurement, bars: ErrorBars | None, figure: dict[str, Any] | None
) -> dict[str, Any]:
    """Make the content of `result.json` (schema membrane-result/1).

    Parameters
    ----------
    measurement : Measurement
        A rejected one gives the same keys with null.
    bars : ErrorBars or None
        None: no figure; uncertainty and knowledge of the geometry are null, the budget is empty.
    figure : dict or None
        The block `figure` (`figure_results.figure_table`); None: null.

    Returns
    -------
    dict
        Plain data; numbers that do not exist are None.
    """
    full = measurement.full
    optics = measurement.head.optics
    # A rejected set has no figure, but the same keys.
    if full is None:
        coeffs_um: list[Any] = [None] * zernike_terms.ZERNIKE_TERMS
        valid_fraction = 0.0
        modulation_adu = None
        saturated_fraction = measurement.rejected_saturated_fraction
    else:
        coeffs_um = (1e3 * full.surface.coeffs_mm).tolist()
        valid_fraction = full.quality.valid_fraction
        modulation_adu = full.quality.modulation_share * (2**optics.camera.bits - 1)
        saturated_fraction = full.quality.saturated_fraction
    quality: dict[str, Any] = {
        "verdict": measurement.verdict,
        "reason": measurement.reason,
        "valid_fraction": valid_fraction,
        "modulation_median_adu": modulation_adu,
        "saturated_fraction": number_or_null(saturated_fraction),
        "flagged_frames": measurement.flagged_files(),
    }
    uncertainty = None
    budget: list[dict[str, Any]] = []
    geometry_known = None
    if bars is not None:
        uncertainty = bars.budget.total() | {"coverage_factor": 1}
        budget = bars.budget.rows()
        geometry_known = bars.statement.table()
    return {
        **program.file_origin("membrane-result/1"),
        "zernike": {
            "index": "noll",
            "first": 1,
            "normalisation": "rms",
            "radius_mm": optics.mirror.radius_mm,
            "coeffs_um": coeffs_um,
        },
        "fit": _fit_table(full),
        "quality": quality,
        "uncertainty": uncertainty,
        "budget": budget,
        "geometry": measurement.head.geometry.make_table(),
        "geometry_known": geometry_known,
        "timing_s": measurement.timing_s,
        "figure": figure,
    }


def _fit_table(full: FullResult | None) -> dict[str, Any]:
    """The block `fit` of `result.json`."""
    if full is None:
        return {
            "iterations": 0,
            "converged": False,
            "last_change_mm": None,
            "slope_residual_urad": None,
            "points": 0,
        }
    return {
        "iterations": len(full.fit.changes_mm),
        "converged": full.fit.converged,
        "last_change_mm": full.fit.changes_mm[-1],
        "slope_residual_urad": full.quality.residual_urad,
        "points": int(np.count_nonzero(full.weights)),
    }


def details_table(
    measurement: Measurement,
    profile: radial_profile.RadialProfile | None,
    outline: Outline | None,
    bars: ErrorBars | None,
) -> dict[str, Any]:
    """Further results: sag, pressure, zonal residual, noise, the rim in the picture.

    Parameters
    ----------
    measurement : Measurement
        The set as measured.
    profile : RadialProfile, optional
        Its round part, as a film under pressure.
    outline : Outline, optional
        The rim as the picture shows it.
    bars : ErrorBars, optional
        Error bars of the sag.
    """
    full = measurement.full
    table: dict[str, Any] = {
        "set": str(measurement.head.folder),
        "displacement_um": number_or_null(measurement.displacement_um),
        "ignored_keys": list(measurement.head.ignored),
        "noise_seen_adu": number_or_null(noise_seen_adu(measurement)),
    }
    if measurement.checked is not None:
        table |= _light_table(measurement.checked)

    # What the fit left, and how it converged.
    if full is not None:
        residual_um = 1e3 * full.residual_mm[np.isfinite(full.residual_mm)]
        table |= {
            "sag_mm": full.surface.sag_mm,
            "hencky_excess_sag_mm": full.surface.hencky_mm,
            "changes_mm": list(full.fit.changes_mm),
            "zonal_residual_rms_um": float(residual_um.std()),
            "zonal_residual_max_um": float(np.max(np.abs(residual_um - residual_um.mean()))),
            "motion_taken_out": full.moved,
        }
        if full.reflections is not None:
            table["front_film"] = _front_film_table(full.reflections)
    if profile is not None:
        table |= {"hencky_sag_mm": profile.sag_mm, "pressure_equivalent_pa": profile.pressure_pa}

    # The sag's error bar, and the rim in the picture.
    if bars is not None:
        of_noise_um, of_geometry_um = bars.sag_sigma_um
        table["sag_sigma_um"] = {
            "noise": number_or_null(of_noise_um),
            "geometry": number_or_null(of_geometry_um),
            "geometry_spread": bars.statement.source,
        }
        table["zero_sigma_um"] = {
            "noise": number_or_null(bars.zero.noise_um),
            "reflections": number_or_null(bars.zero.reflections_um),
        }
    if outline is not None:
        table["rim"] = {
            "centre_px": list(outline.centre_px),
            "expected_centre_px": list(outline.expected_px),
            "offset_mm": outline.offset_mm,
            "size_ratio": outline.size_ratio,
        }
    return table


def _front_film_table(fit: ReflectionFit) -> dict[str, Any]:
    """The reflections of the screen by the front film, and its errors of form that they show."""
    raised_mm, tilt_x_mrad, tilt_y_mrad, saddle_mm, diagonal_mm, lifted_mm = fit.errors.tolist()
    return {
        "reflections": fit.state.value,
        "shares": fit.shares.tolist(),
        "share_sigmas": None if fit.left is None else fit.left.share_sigmas.tolist(),
        "bulge_less_stated_mm": raised_mm,
        "tilt_mrad": [tilt_x_mrad, tilt_y_mrad],
        "saddles_mm": [saddle_mm, diagonal_mm],
        "lifted_mm": lifted_mm,
        "ripple_rad": {
            "before": number_or_null(fit.before_rad),
            "after": number_or_null(fit.after_rad),
        },
    }


def _light_table(checked: Checked) -> dict[str, Any]:
    """What the frames of a set show of its light."""
    clip = checked.binned.clip
    lag = checked.lag
    response = checked.response
    second = checked.second
    return {
        "image_lag_share": {
            "rise": number_or_null(lag.rise),
            "fall": number_or_null(lag.fall),
            "sigma": number_or_null(lag.sigma),
            "taken_out": lag.corrected,
        },
        "response_exponent": number_or_null(response.exponent),
        "light_loss": {
            "edge": number_or_null(response.edge_loss),
            "side": number_or_null(response.side_loss),
        },
        "second_image": {
            "share": number_or_null(second.share),
            "sigma": number_or_null(second.sigma),
            "shift_mm": [number_or_null(second.mm_per_rad * s) for s in second.shift_rad],
        },
        "film_image": {
            "tested": checked.image.evidence.value,
            "share": checked.image.share,
            "place_mm": [number_or_null(checked.image.x_mm), number_or_null(checked.image.y_mm)],
        },
        "clip_levels_adu": {
            "white": clip.white_adu,
            "black": None if clip.black_adu < 0 else clip.black_adu,
        },
    }


def write_result(
    out: Path,
    measurement: Measurement,
    result: dict[str, Any],
    details: dict[str, Any],
    bars: ErrorBars | None,
) -> None:
    """Write `result.json`, `details.json` and, with a usable figure, two maps.

    Parameters
    ----------
    out : Path
        Folder of the results; made if it does not exist.
    measurement : Measurement
        Its height becomes `height.npz`, in mm, unless it is rejected.
    result, details : dict
        Content of the two JSON files (`result_table`, `details_table`).
    bars : ErrorBars or None
        Their maps of 1 sigma become `sigma.npz`, in µm; None: no such file.

    Raises
    ------
    OSError
        A file cannot be written.
    """
    make_folder(out)
    write_json(out / "result.json", result)
    write_json(out / "details.json", details)
    full = measurement.full
    if full is None or measurement.verdict == "rejected":
        return
    axis_mm = full.grid.axis_mm
    write_arrays(out / "height.npz", x_mm=axis_mm, y_mm=axis_mm, h_mm=full.height_mm())
    if bars is not None:
        axis_mm = bars.grid.axis_mm
        of_noise_um, of_geometry_um = bars.maps_um()
        write_arrays(
            out / "sigma.npz",
            x_mm=axis_mm,
            y_mm=axis_mm,
            sigma_um=np.hypot(of_noise_um, of_geometry_um),
            sigma_noise_um=of_noise_um,
            sigma_geometry_um=of_geometry_um,
        )
