"""The three scalars of the figure over a run, and the image of a star by its last figure."""

import math
from dataclasses import dataclass, fields
from typing import cast

import numpy as np

from membrane_ctrl.config.schema import Config
from membrane_ctrl.metrology.figure.held_quantities import (
    MeasuredScalars,
    find_held_scalars,
    measure_scalars,
)
from membrane_ctrl.metrology.figure.star_image import StarImage, image_star
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.model.arrays import BoolArray, Column, FloatArray
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from membrane_ctrl.run_files.shapes import Shapes

_CYCLES_MOST = 300  # a millisecond each; more points than a picture shows
_LEAST_CYCLES = 3
_CELLS = 96  # of the star's image along an axis
_DRAWS = 24  # of the figure by its covariance: an error bar good to a seventh


@dataclass(frozen=True, slots=True)
class HeldSeries:
    """The scalars of the settled cycles, against the first one or a stored reference.

    Attributes
    ----------
    holds : str
        The scalar that the loop held: `loop.holds`.
    time_s : (n,) array
    scalars : tuple of MeasuredScalars
        Of each cycle; deviations are NaN where no covariance was recorded.
    stored_reference : bool
        Whether changes are against `loop.reference_figure_um`.
    wavelength_um : float
    image : StarImage or None
        By the last cycle; None for a mirror without a focus.
    strehl_sigma, radius_80_sigma_um : float
        Standard deviations by the noise of that figure; NaN without a covariance.
    """

    holds: str
    time_s: Column
    scalars: tuple[MeasuredScalars, ...]
    stored_reference: bool
    wavelength_um: float
    image: StarImage | None
    strehl_sigma: float
    radius_80_sigma_um: float

    def values_of(self, name: str) -> Column:
        """One field of `MeasuredScalars` of all cycles, (n,)."""
        return np.array([getattr(each, name) for each in self.scalars])

    @property
    def change_strehl(self) -> float:
        """Strehl ratio left by the last change of the figure alone (Marechal), for optics that
        correct the reference.
        """
        rms_um = self.scalars[-1].rms_um
        return math.exp(-((4 * math.pi * rms_um / self.wavelength_um) ** 2))


def review_scalars(shapes: Shapes, held: BoolArray, config: Config) -> HeldSeries | None:
    """Return the scalars of a run; None when fewer than three settled cycles are good.

    Parameters
    ----------
    shapes : Shapes
        All of the run.
    held : (n,) array of bool
        Which cycles fell into a settled hold.
    config : Config
        Of the run.
    """
    usable = held & (shapes.verdict != "rejected") & np.isfinite(shapes.coeffs_um).all(axis=1)
    places = np.flatnonzero(usable)
    if places.size < _LEAST_CYCLES:
        return None
    count = min(places.size, _CYCLES_MOST)
    places = places[np.unique(np.linspace(0, places.size - 1, count).astype(int))]
    scalars = find_held_scalars(config)
    stored = config.loop.reference_figure_um
    reference_um = shapes.coeffs_um[places[0]]
    if stored:
        reference_um = np.array(stored, dtype=float)
    measured = []
    for place in places.tolist():
        covariance_um2 = _find_covariance(shapes, place)
        found = measure_scalars(
            scalars,
            shapes.coeffs_um[place],
            float(shapes.hencky_um[place]),
            np.nan_to_num(covariance_um2),
            reference_um,
        )
        if np.isnan(covariance_um2).any():
            found = _without_deviations(found)
        measured.append(found)
    image, strehl_sigma, radius_sigma_um = _image_last(shapes, int(places[-1]), config)
    return HeldSeries(
        holds=config.loop.holds,
        time_s=shapes.time_s[places],
        scalars=tuple(measured),
        stored_reference=bool(stored),
        wavelength_um=config.optics.mirror.wavelength_um,
        image=image,
        strehl_sigma=strehl_sigma,
        radius_80_sigma_um=radius_sigma_um,
    )


def _find_covariance(shapes: Shapes, place: int) -> FloatArray:
    """Covariance of a cycle; NaN where none was recorded."""
    covariance_um2 = shapes.covariance_near(float(shapes.time_s[place]))
    if covariance_um2 is None:
        return np.full((ZERNIKE_TERMS, ZERNIKE_TERMS), np.nan)
    return covariance_um2


def _without_deviations(found: MeasuredScalars) -> MeasuredScalars:
    values = {
        each.name: math.nan if "sigma" in each.name else getattr(found, each.name)
        for each in fields(found)
    }
    return MeasuredScalars(**values)


def _image_last(
    shapes: Shapes, place: int, config: Config
) -> tuple[StarImage | None, float, float]:
    """The image by one cycle, and the deviations of Strehl ratio and radius by its noise."""
    mirror = config.optics.mirror
    aperture_mm = mirror.analysis_radius_mm
    # A grid over the aperture.
    axis_mm = (np.arange(_CELLS) + 0.5) * 2 * aperture_mm / _CELLS - aperture_mm
    x, y = np.meshgrid(axis_mm, axis_mm)
    outside = np.hypot(x, y) > aperture_mm

    def image(coeffs_um: FloatArray) -> StarImage:
        surface = Surface(1e-3 * coeffs_um, 1e-3 * float(shapes.hencky_um[place]), mirror.radius_mm)
        height_mm = surface.height(x, y)
        height_mm[outside] = np.nan
        return image_star(axis_mm, height_mm, mirror.wavelength_um)

    coeffs_um = shapes.coeffs_um[place]
    try:
        found = image(coeffs_um)
    except ValueError:  # convex
        return None, math.nan, math.nan
    covariance_um2 = _find_covariance(shapes, place)
    if np.isnan(covariance_um2).any():
        return found, math.nan, math.nan
    # The deviations, by images of figures drawn from the covariance.
    rng = np.random.default_rng(0)
    draws = rng.multivariate_normal(coeffs_um, covariance_um2, _DRAWS, check_valid="ignore")
    images = [image(cast(FloatArray, draw)) for draw in draws]
    return (
        found,
        float(np.std([each.strehl for each in images], ddof=1)),
        float(np.std([each.radius_80_um for each in images], ddof=1)),
    )
