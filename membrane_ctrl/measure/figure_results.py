"""The metrologist's figure of a measurement: numbers with error bars, their block in `result.json`,
maps, report.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from membrane_ctrl.measure.measurement import Measurement
from membrane_ctrl.measure.result_files import number_or_null, write_arrays
from membrane_ctrl.measure.results import ErrorBars
from membrane_ctrl.metrology.figure import best_sphere
from membrane_ctrl.metrology.figure.error_bars import LEAST_CELLS, FigureBars, FigureTrials
from membrane_ctrl.metrology.figure.power_spectrum import PowerSpectrum, power_spectrum
from membrane_ctrl.metrology.figure.quantities import Figure, FigureOf
from membrane_ctrl.metrology.figure.surface_map import SurfaceMap
from membrane_ctrl.metrology.numerics import zernike
from membrane_ctrl.metrology.rays import surface
from membrane_ctrl.model.errors import InputError
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS

ENERGY_SHARES = np.linspace(0.01, 1.0, 100)
# Numbers of the light at the focus, which a convex mirror does not have
_AT_FOCUS = ("best_focus", "spot", "star", "strehl")


@dataclass(frozen=True)
class MeasuredFigure:
    """The metrologist's figure of a measurement, with the error bars of its numbers."""

    figure: Figure
    noise: FigureBars
    geometry: FigureBars
    spectrum: PowerSpectrum
    seen: SurfaceMap
    aperture_mm: float
    wavelength_um: float
    nominal_radius_mm: float | None

    @property
    def power_um(self) -> tuple[float, float, float] | None:
        """Depth of the best sphere less that of the nominal one, with its two bars; None without a
        nominal radius.
        """
        if self.nominal_radius_mm is None:
            return None
        nominal = best_sphere.Sphere(0.0, 0.0, 0.0, 1 / self.nominal_radius_mm).sag_mm(
            self.aperture_mm
        )
        found, *bars = (
            one.numbers.sphere_sag_mm for one in (self.figure, self.noise, self.geometry)
        )
        return 1e3 * (found - nominal), 1e3 * bars[0], 1e3 * bars[1]


def measured_figure(
    measurement: Measurement, bars: ErrorBars | None, nominal_radius_mm: float | None = None
) -> MeasuredFigure | None:
    """Evaluate the figure of a measurement.

    Parameters
    ----------
    measurement : Measurement
        The set and its height.
    bars : ErrorBars or None
        Its error bars.
    nominal_radius_mm : float or None
        Radius of the sphere to compare with; negative for a convex one.

    Returns
    -------
    MeasuredFigure or None
        None if there is no usable figure, or hardly a cell of it.

    Raises
    ------
    InputError
        No sphere of this radius spans the aperture.
    """
    full = measurement.full
    mirror = measurement.head.optics.mirror
    if nominal_radius_mm is not None and not abs(nominal_radius_mm) > mirror.analysis_radius_mm:
        least = f"larger than the aperture's radius, {mirror.analysis_radius_mm:g} mm"
        raise InputError(f"--nominal-radius-mm {nominal_radius_mm:g}: must be {least}")
    if full is None or bars is None or measurement.verdict == "rejected":
        return None
    aperture = mirror.analysis_radius_mm
    seen = full.map()
    if np.count_nonzero(np.isfinite(seen.height_mm)) < LEAST_CELLS:
        return None
    # The figure, and its bars: each error is added to it and evaluated as the figure is.
    evaluate = FigureOf(seen, aperture, mirror.wavelength_um)
    found = evaluate(seen)
    trials = FigureTrials(evaluate, seen, found, mirror.radius_mm)
    of_noise = trials.figure_bars(bars.noise, bars.cell_slope)
    of_geometry = trials.figure_bars(bars.geometry)
    spectrum = power_spectrum(found, seen.axis_mm, aperture)
    return MeasuredFigure(
        found,
        of_noise,
        of_geometry,
        spectrum,
        seen,
        aperture,
        mirror.wavelength_um,
        nominal_radius_mm,
    )


def figure_table(
    measurement: Measurement, found: MeasuredFigure, bars: ErrorBars
) -> dict[str, Any]:
    """Make the block `figure` of `result.json` (docs/reference/figure.md).

    Parameters
    ----------
    measurement : Measurement
        For the radius of the terms and the cells of the map.
    found : MeasuredFigure
        The figure of this measurement.
    bars : ErrorBars
        Covariances of the terms, and the source of the geometry's spread.

    Returns
    -------
    dict
        Each number with 1 sigma from noise and from the geometry. A number that the surface does
        not have is in `not_given`, with the reason.
    """
    numbers = {
        name: make_quantity(
            value, getattr(found.noise.numbers, name), getattr(found.geometry.numbers, name)
        )
        for name, value in vars(found.figure.numbers).items()
    }

    # Numbers that the surface does not have, with the reason.
    missing = {
        name: "a surface that is nearly flat has none"
        for name, item in numbers.items()
        if item is None
    }
    if found.figure.numbers.best_focus_mm <= 0:  # behind the mirror
        for name in [name for name in numbers if name.startswith(_AT_FOCUS)]:
            numbers[name] = None
            missing[name] = "the mirror has no real focus"
    if found.power_um is None:
        missing["power_um"] = "no nominal radius: give --nominal-radius-mm"
    else:
        numbers["power_um"] = make_quantity(*found.power_um)
    return {
        "aperture_radius_mm": found.aperture_mm,
        "centre_mm": [0.0, 0.0],
        "wavelength_um": found.wavelength_um,
        "cell_mm": measurement.full.grid.step_mm if measurement.full else None,
        "geometry_spread": bars.statement.source,
        "numbers": {name: item for name, item in numbers.items() if item is not None},
        "not_given": missing,
        "zernike": _zernike_tables(measurement, found, bars),
    }


def make_quantity(
    value: float, of_noise: float, of_geometry: float
) -> dict[str, float | None] | None:
    """Make one number of `result.json` with its error bars.

    Parameters
    ----------
    value : float
        NaN if it does not exist.
    of_noise, of_geometry : float
        1 sigma of each cause; NaN if unknown, which becomes null.

    Returns
    -------
    dict of float or None or None
        None if the number does not exist.
    """
    if not math.isfinite(value):
        return None
    return {
        "value": value,
        "sigma_noise": number_or_null(of_noise),
        "sigma_geometry": number_or_null(of_geometry),
    }


def _zernike_tables(
    measurement: Measurement, found: MeasuredFigure, bars: ErrorBars
) -> list[dict[str, Any]]:
    """The height in three sets of terms; Noll's and OSA's are the same terms, Fringe's are fitted
    to the map.
    """
    radius_mm = measurement.head.optics.mirror.radius_mm
    to_coeffs = surface.parameter_to_coeffs()
    coeffs = (
        1e3 * measurement.full.surface.coeffs_mm
        if measurement.full
        else np.full(ZERNIKE_TERMS, np.nan)
    )

    # Standard deviations by noise and by the geometry.
    of_noise, of_geometry = (
        1e3 * np.sqrt(np.maximum(np.diag(to_coeffs @ c @ to_coeffs.T), 0.0))
        for c in (bars.noise, bars.geometry)
    )

    # The same terms in OSA's order; those of the Fringe set are their own fit.
    osa = [zernike.osa_from_noll(row) for row in (coeffs, of_noise, of_geometry)]
    fringe = found.figure.fringe_um, found.noise.fringe_um, found.geometry.fringe_um
    return [
        {
            "index": index,
            "first": first,
            "normalisation": normalisation,
            "radius_mm": radius,
            "centre_mm": [0.0, 0.0],
            "coeffs_um": [number_or_null(value) for value in rows[0]],
            "sigma_noise_um": [number_or_null(value) for value in rows[1]],
            "sigma_geometry_um": [number_or_null(value) for value in rows[2]],
        }
        for index, first, normalisation, radius, rows in (
            ("noll", 1, "rms", radius_mm, (coeffs, of_noise, of_geometry)),
            ("osa", 0, "rms", radius_mm, osa),
            ("fringe", 1, "peak", found.aperture_mm, fringe),
        )
    ]


def write_figure_maps(path: Path, found: MeasuredFigure) -> None:
    """Write the deviation from the best sphere, its spectrum, and the encircled energy.

    Parameters
    ----------
    path : Path
        The `.npz`, replaced. Maps are (rows, columns) in µm over `y_mm` and `x_mm`, NaN outside;
        the spectrum has the density in µm² mm² for each spatial frequency in 1/mm.
    found : MeasuredFigure
        The figure.

    Raises
    ------
    OSError
        The file cannot be written.
    """
    write_arrays(
        path,
        x_mm=found.seen.axis_mm,
        y_mm=found.seen.axis_mm,
        deviation_um=found.figure.deviation_um,
        rotational_um=found.figure.rotational_um,
        frequency_per_mm=found.spectrum.frequency_per_mm,
        density_um2_mm2=found.spectrum.density_um2_mm2,
        density_sigma_um2_mm2=found.spectrum.sigma_um2_mm2,
        encircled_share=ENERGY_SHARES,
        encircled_radius_mm=np.quantile(found.figure.spot_mm, ENERGY_SHARES),
    )


def figure_lines(found: MeasuredFigure) -> list[str]:
    """The numbers as lines of text; +- is 1 sigma of noise and geometry together."""
    # Noise and geometry are independent: their sigmas add in squares.
    numbers = found.figure.numbers

    def quantity(name: str, unit: str) -> str:
        """The number of this name with its sigma and unit."""
        sigma = math.hypot(
            getattr(found.noise.numbers, name), getattr(found.geometry.numbers, name)
        )
        return f"{with_bar(getattr(numbers, name), sigma)} {unit}"

    lines = [
        f"sphere    radius {quantity('radius_of_curvature_mm', 'mm')}, focal length "
        f"{quantity('focal_length_mm', 'mm')}",
        f"irregular PV {quantity('irregularity_pv_um', 'µm')}, RMS "
        f"{quantity('irregularity_rms_um', 'µm')}, "
        f"PVr {quantity('pvr_um', 'µm')}; slope {quantity('slope_rms_urad', 'µrad')} RMS",
        f"          rotationally invariant PV {quantity('rotational_pv_um', 'µm')}, "
        f"the rest {quantity('asymmetry_rms_um', 'µm')} RMS",
    ]

    # A convex mirror has no light at a focus.
    if numbers.best_focus_mm > 0:
        lines.append(
            f"spot      {quantity('best_focus_mm', 'mm')} from the vertex: 80 % of the rays within "
            f"{quantity('spot_80_mm', 'mm')}, 50 % {quantity('spot_50_mm', 'mm')}, 95 % "
            f"{quantity('spot_95_mm', 'mm')} (radius)"
        )
        strehl = quantity("strehl", "").rstrip()
        lines.append(
            f"star      Strehl ratio at {found.wavelength_um:g} µm {strehl}; the paths to the "
            f"focus differ by {quantity('star_path_rms_um', 'µm')} RMS"
        )
    return lines


def with_bar(value: float, sigma: float) -> str:
    """Format a number with its 1 sigma, both to the second digit of the sigma.

    Parameters
    ----------
    value : float
        The number, in any unit.
    sigma : float
        In the same unit. 0 or less: the number is exact, and no error bar is added; NaN or
        infinite: unknown, which the text states.
    """
    if not math.isfinite(sigma):
        return f"{value:.4g} (no error bar)"
    if sigma <= 0:
        return f"{value:.6g}"
    digits = max(0, 1 - math.floor(math.log10(sigma)))
    return f"{value:.{digits}f} +- {sigma:.{digits}f}"
