"""Shape of the film: a bowl, Zernike terms, and what 36 Zernike terms cannot carry.

Frame: the mirror's own, x horizontal, y up, height h above the vertex, h(0, 0) = 0. The displacement's zero is where
the bowl has `sag_mm`; the rim stays where it is, so the bowl is `sag_mm + displacement` deep and everything else
moves with the rim.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import cos, isfinite, pi, radians, sin, sqrt
from typing import Literal

import numpy as np

from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.sim.optics import film_terms

MAX_ZERNIKE = 36  # all terms of radial order 7 or less


@dataclass(frozen=True, slots=True)
class Ripple:
    """A plane wave all over the film, crests perpendicular to `direction_deg` (from +x towards +y)."""

    amplitude_um: float
    wavelength_mm: float
    direction_deg: float = 0.0
    phase_rad: float = 0.0

    def __post_init__(self) -> None:
        if not self.wavelength_mm > 0:
            raise ValueError(f"ripple wavelength_mm = {self.wavelength_mm} must be above 0")


@dataclass(frozen=True, slots=True)
class Wrinkle:
    """Radial folds at the rim: amplitude Re(((x + iy)/radius)^lobes e^(i phase)); they fade as r^lobes inwards."""

    amplitude_um: float
    lobes: int
    phase_rad: float = 0.0

    def __post_init__(self) -> None:
        if self.lobes < 1:
            raise ValueError(f"wrinkle lobes = {self.lobes} must be 1 or more")


@dataclass(frozen=True, slots=True)
class Bump:
    """A Gaussian hill (a grain behind the film, a dent when negative)."""

    amplitude_um: float
    x_mm: float
    y_mm: float
    sigma_mm: float

    def __post_init__(self) -> None:
        if not self.sigma_mm > 0:
            raise ValueError(f"bump sigma_mm = {self.sigma_mm} must be above 0")


@dataclass(frozen=True, slots=True)
class FilmShape:
    """The film as the twin knows it. Raises ValueError that names the field and what would be right."""

    sag_mm: float  # depth of the bowl (rim above vertex, without the other terms) at displacement 0
    radius_mm: float = 500.0
    bowl: Literal["hencky", "paraboloid"] = "hencky"
    # Noll j = 1.., orthonormal over `radius_mm`, added to the bowl (piston is without effect)
    zernike_um: tuple[float, ...] = ()
    ripples: tuple[Ripple, ...] = ()
    wrinkles: tuple[Wrinkle, ...] = ()
    bumps: tuple[Bump, ...] = ()
    terms: film_terms.FilmTerms = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not isfinite(self.sag_mm):
            raise ValueError(f"sag_mm = {self.sag_mm} must be a number")
        if not self.radius_mm > 0:
            raise ValueError(f"radius_mm = {self.radius_mm} must be above 0")
        if self.bowl not in ("hencky", "paraboloid"):
            raise ValueError(f"bowl = {self.bowl!r} must be hencky or paraboloid")
        if not all(isfinite(c) for c in self.zernike_um):
            raise ValueError("zernike_um: every value must be a number")
        if len(self.zernike_um) > MAX_ZERNIKE:
            raise ValueError(f"zernike_um holds {len(self.zernike_um)} terms; at most {MAX_ZERNIKE} are known")
        object.__setattr__(self, "terms", _terms(self))

    def sag_at_mm(self, displacement_um: float) -> float:
        """Depth of the bowl at a displacement (positive: deeper)."""
        return self.sag_mm + displacement_um / 1000.0

    def height_mm(self, x_mm: FloatArray, y_mm: FloatArray, displacement_um: float = 0.0) -> FloatArray:
        """Height above the vertex at points of any (equal) shape."""
        flat = film_terms.heights(self.terms, self.sag_at_mm(displacement_um), np.ravel(x_mm), np.ravel(y_mm))
        return np.reshape(flat, np.shape(x_mm))

    def coeffs_um(self, displacement_um: float = 0.0) -> FloatArray | None:
        """Noll j = 1..36 of the whole surface, 0 at the vertex; None if the 36 terms cannot carry it.

        A paraboloid s rho^2 is s/(2 sqrt 3) of Z4 = sqrt(3) (2 rho^2 - 1) above a piston of s/2.
        """
        if self.bowl == "hencky" or self.ripples or self.wrinkles or self.bumps:
            return None
        coeffs = np.zeros(MAX_ZERNIKE)
        coeffs[: len(self.zernike_um)] = self.zernike_um
        coeffs[3] += 1000.0 * self.sag_at_mm(displacement_um) / (2.0 * sqrt(3.0))
        coeffs[0] = 0.0
        coeffs[0] = -film_terms.polynomial(coeffs)[0, 0]
        return coeffs


def _rows(rows: Sequence[tuple[float, ...]], width: int) -> FloatArray:
    return np.array(rows, dtype=np.float64).reshape(len(rows), width)


def _terms(film: FilmShape) -> film_terms.FilmTerms:
    """The film as numbers for the kernel, its offset chosen so that h(0, 0) = 0."""
    ripples = [
        (
            r.amplitude_um / 1000.0,
            2.0 * pi / r.wavelength_mm * cos(radians(r.direction_deg)),
            2.0 * pi / r.wavelength_mm * sin(radians(r.direction_deg)),
            r.phase_rad,
        )
        for r in film.ripples
    ]
    bumps = [(b.amplitude_um / 1000.0, b.x_mm, b.y_mm, b.sigma_mm) for b in film.bumps]
    raised = film_terms.FilmTerms(
        radius_mm=film.radius_mm,
        offset_mm=0.0,
        bowl=film_terms.hencky_series() if film.bowl == "hencky" else film_terms.paraboloid_series(),
        poly_mm=film_terms.polynomial(np.array(film.zernike_um, dtype=np.float64) / 1000.0),
        ripples=_rows(ripples, 4),
        wrinkles=_rows([(w.amplitude_um / 1000.0, float(w.lobes), w.phase_rad) for w in film.wrinkles], 3),
        bumps=_rows(bumps, 4),
    )
    vertex_mm = film_terms.height_and_slopes(raised, film.sag_mm, 0.0, 0.0)[0]
    return raised._replace(offset_mm=vertex_mm)


def typical_film(sag_mm: float, radius_mm: float, seed: int) -> FilmShape:
    """A mounted film: a Hencky bowl with the figure that clamping by hand leaves.

    0.3 mm of astigmatism, 0.1 mm of coma and 0.05 mm of trefoil, each in a direction drawn from the seed,
    and 10 um RMS spread over the terms above.
    """
    rng = np.random.default_rng(seed)
    coeffs_um = np.zeros(MAX_ZERNIKE)
    for amplitude_um, sine, cosine in ((300.0, 5, 6), (100.0, 7, 8), (50.0, 9, 10)):
        angle = rng.uniform(0.0, 2.0 * pi)
        coeffs_um[sine - 1], coeffs_um[cosine - 1] = amplitude_um * sin(angle), amplitude_um * cos(angle)
    higher = rng.normal(size=MAX_ZERNIKE - 10)
    coeffs_um[10:] = 10.0 * higher / sqrt(float(np.dot(higher, higher)))
    return FilmShape(sag_mm, radius_mm, zernike_um=tuple(float(c) for c in coeffs_um))
