"""Errors, error bars and verdict of sets of the second optical world, as `measure` gives them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.measure import results
from membrane_ctrl.measure.measure import light_and_rim, name_lens_fold
from membrane_ctrl.measure.measurement import measure_set
from membrane_ctrl.metrology.rays.surface import parameter_to_coeffs, sag_gradient
from membrane_ctrl.metrology.uncertainty.budget import Budget
from membrane_ctrl.metrology.uncertainty.height_map import height_matrix
from tests.worlds.second_optics import Mirror, Truth

FloatArray = NDArray[np.float64]

TERMS = range(3, 11)  # Noll 4..11
RADIUS_MM = 500.0
CHANCE_DRAWS = 20_000  # the chance of a bench is then known to 0.1 %


@dataclass(frozen=True)
class MeasuredErrors:
    """One set: measured less true values of sag, Z4..Z11 and heights at points, in µm.

    Attributes
    ----------
    verdict, reason : str
        As `measure` prints them.
    flagged : tuple of str
        Files of flagged frames with the reason.
    error_um, sigma_um : (9 + points,) array or None
        None if the set gave no figure.
    values_um : (9 + points,) array or None
        The measured values.
    rows : (9 + points, parameters) array
        From the fit's parameters in mm to these quantities.
    budget : Budget or None
    residual_urad : float
    """

    verdict: str
    reason: str
    flagged: tuple[str, ...]
    error_um: FloatArray | None
    sigma_um: FloatArray | None
    values_um: FloatArray | None
    rows: FloatArray
    budget: Budget | None
    residual_urad: float = float("nan")
    geometry: str = ""

    def chance_beyond(self, sigmas: float) -> float:
        """Chance that one of the errors or more exceeds so many sigmas, if they are normal and have
        exactly the budget's covariance; 0 without a figure.
        """
        if self.budget is None:
            return 0.0
        covariance = self.budget.covariance(True) + self.budget.covariance(False)
        of_quantities = self.rows @ covariance @ self.rows.T
        sigma = np.sqrt(np.maximum(np.diag(of_quantities), 1e-30))
        correlation = of_quantities / np.outer(sigma, sigma)
        values, vectors = np.linalg.eigh(correlation)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        normal = np.random.default_rng(0).standard_normal((CHANCE_DRAWS, len(root)))
        return float(np.mean(np.abs(normal @ root.T).max(axis=1) > sigmas))

    @property
    def worst_sigmas(self) -> float:
        """Largest error over its sigma; NaN without a figure."""
        if self.error_um is None or self.sigma_um is None:
            return float("nan")
        return float(np.max(np.abs(self.error_um) / self.sigma_um))

    def change_sigma_um(self, earlier: MeasuredErrors) -> FloatArray:
        """1 sigma of the change since an earlier set of the bench. Both must have a budget."""
        assert self.budget is not None
        assert earlier.budget is not None
        return sigma_um(self.rows, self.budget.change_covariance(earlier.budget))


def sigma_um(rows: FloatArray, covariance_mm2: FloatArray) -> FloatArray:
    """1 sigma of quantities with these rows."""
    variance = np.einsum("ij,jk,ik->i", rows, covariance_mm2, rows)
    return np.asarray(1e3 * np.sqrt(np.maximum(variance, 0.0)))


def quantity_rows(points_mm: FloatArray) -> FloatArray:
    """Rows of sag, Noll 4..11 and the heights at points (2, n)."""
    terms = parameter_to_coeffs()[list(TERMS)]
    return np.vstack([sag_gradient(), terms, height_matrix(*points_mm, RADIUS_MM)])


def drawn_points_mm(rng: np.random.Generator, count: int) -> FloatArray:
    """Points (2, count) spread evenly over the analysis radius."""
    radius, angle = 475 * np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)])


def true_values_um(mirror: Mirror, truth: Truth, points_mm: FloatArray) -> FloatArray:
    """The quantities of the true film; heights as a fit may have them, without wrinkles."""
    terms = truth.zernike_um[list(TERMS)]
    smooth = mirror.without_wrinkles()
    heights_um = 1e3 * smooth.height_mm(*points_mm, truth.displacement_um)
    return np.concatenate([[truth.sag_um], terms, heights_um])


@dataclass(frozen=True)
class MeasuredSurface:
    """A figure: the parameters of the fit in mm, its budget, and the budget's rows."""

    verdict: str
    parameters_mm: FloatArray
    budget: Budget
    rows: list[dict[str, Any]]


def measure_surface(folder: Path) -> MeasuredSurface:
    """Measure a set that must give a figure. Raises AssertionError with its reason otherwise."""
    measurement = measure_set(folder)
    assert measurement.full is not None, measurement.reason
    _, outline = light_and_rim(measurement)
    bars = results.error_bars(measurement, None, outline)
    assert bars is not None
    parameters_mm = measurement.full.surface.parameters
    return MeasuredSurface(measurement.verdict, parameters_mm, bars.budget, bars.budget.rows())


def measured_errors(
    folder: Path, mirror: Mirror, truth: Truth, points_mm: FloatArray
) -> MeasuredErrors:
    """Measure a set of the second world and compare it with its truth."""
    measurement = measure_set(folder)
    _, outline = light_and_rim(measurement)
    bars = results.error_bars(measurement, None, outline)
    measurement = results.apply_doubts(measurement, bars)
    contradicted = bars is not None and bool(bars.statement.doubts)
    reason = name_lens_fold(measurement, measurement.reason, contradicted)
    flagged = tuple(f"{item['file']}: {item['reason']}" for item in measurement.flagged_files())
    rows = quantity_rows(points_mm)
    verdict, full = measurement.verdict, measurement.full
    if full is None or bars is None:
        return MeasuredErrors(verdict, reason, flagged, None, None, None, rows, None)
    values_um = 1e3 * rows @ full.surface.parameters
    return MeasuredErrors(
        verdict,
        reason,
        flagged,
        values_um - true_values_um(mirror, truth, points_mm),
        sigma_um(rows, bars.noise + bars.geometry),
        values_um,
        rows,
        bars.budget,
        full.quality.residual_urad,
        bars.statement.state.value,
    )
