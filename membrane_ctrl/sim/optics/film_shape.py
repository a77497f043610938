"""Shape of the film: a bowl, Zernike terms, and what these terms cannot represent.

Frame: the mirror's own, x horizontal, y up, height h above the vertex, h(0, 0) = 0. The
displacement's zero is where the bowl has `sag_mm`; the rim stays where it is, so the bowl is
`sag_mm + displacement` deep and everything else moves with the rim.
"""

from dataclasses import dataclass, field
from math import comb, cos, isfinite, pi, radians, sin, sqrt
from typing import Literal, get_args

import numpy as np

from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from membrane_ctrl.sim import hencky, stretched_film
from membrane_ctrl.sim.optics.film_terms import FilmTerms, film_heights, height_and_slopes
from membrane_ctrl.sim.optics.zernike_polynomials import zernike_polynomial

# Noll's terms that a film may have, up to radial order 13: finer errors are ripples, wrinkles and
# bumps.
MAX_FILM_TERMS = 105
# Noll's terms of a mounted film, up to radial order 7, however many the metrology fits.
_TYPICAL_TERMS = 36
_SPHERE_TERMS = 40  # those left out are below 1e-12 for radii up to half of the curvature's
_Form = Literal["hencky", "paraboloid", "sphere"]


def bowl_series(bowl: _Form, sag_mm: float, radius_mm: float) -> FloatArray:
    """Height of a bowl of unit sag above its vertex.

    Hencky's has nu = 0.3; a concave sphere's depends on its sag: 1 - sqrt(1 - x rho^2), x = (radius
    / curvature's)^2.

    Parameters
    ----------
    bowl : "hencky", "paraboloid" or "sphere"
        Form of the bowl.
    sag_mm, radius_mm : float
        Depth and radius of the rim, for a sphere.

    Returns
    -------
    (k,) array
        Element k multiplies rho^(2k).
    """
    if bowl == "hencky":
        return hencky.solve_hencky().profile
    if bowl == "paraboloid":
        return np.array([0.0, 1.0])

    # 1 - sqrt(1 - z) = sum of C(2k, k) / (4^k (2k - 1)) z^k, with z = x rho^2.
    x = (2 * sag_mm * radius_mm / (radius_mm**2 + sag_mm**2)) ** 2
    terms = np.zeros(_SPHERE_TERMS)
    for k in range(1, _SPHERE_TERMS):
        terms[k] = comb(2 * k, k) / (4**k * (2 * k - 1)) * x**k
    return np.asarray(terms / terms.sum())


@dataclass(frozen=True, slots=True)
class Ripple:
    """A plane wave all over the film, crests perpendicular to
    `direction_deg` (from +x towards +y).
    """

    amplitude_um: float
    wavelength_mm: float
    direction_deg: float = 0.0
    phase_rad: float = 0.0

    def __post_init__(self) -> None:
        if not self.wavelength_mm > 0:
            raise ValueError(f"ripple wavelength_mm = {self.wavelength_mm} must be above 0")


@dataclass(frozen=True, slots=True)
class Wrinkle:
    """Radial folds at the rim: amplitude Re(((x + iy)/radius)^lobes e^(i phase)); they fade as
    r^lobes inwards.
    """

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
    """The twin's film. Raises ValueError naming the field and a valid value."""

    sag_mm: float  # depth of the bowl (rim above vertex, without the other terms) at displacement 0
    radius_mm: float = 500.0
    bowl: _Form = "hencky"
    # Noll j = 1.., orthonormal over `radius_mm`, added to the bowl (piston is without effect)
    zernike_um: tuple[float, ...] = ()
    ripples: tuple[Ripple, ...] = ()
    wrinkles: tuple[Wrinkle, ...] = ()
    bumps: tuple[Bump, ...] = ()
    # of a Hencky bowl: strain of the flat film before it was clamped, and the material's Poisson
    # ratio
    prestrain: float = 0.0
    poisson: float = hencky.POISSON_PET
    terms: FilmTerms = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        # The bowl.
        if not isfinite(self.sag_mm):
            raise ValueError(f"sag_mm = {self.sag_mm} must be a number")
        if not self.radius_mm > 0:
            raise ValueError(f"radius_mm = {self.radius_mm} must be above 0")
        if self.bowl not in get_args(_Form):
            raise ValueError(f"bowl = {self.bowl!r} must be one of {', '.join(get_args(_Form))}")
        if self.bowl == "sphere" and not 0 < self.sag_mm < self.radius_mm:
            raise ValueError(
                f"sag_mm = {self.sag_mm:g}: a concave sphere's is above 0 and below its radius"
            )

        # The terms added to it, and the material.
        if not all(isfinite(c) for c in self.zernike_um):
            raise ValueError("zernike_um: every value must be a number")
        if len(self.zernike_um) > MAX_FILM_TERMS:
            raise ValueError(
                f"zernike_um holds {len(self.zernike_um)} terms; at most {MAX_FILM_TERMS} are known"
            )
        if not 0 <= self.poisson <= 0.5:
            raise ValueError(f"poisson = {self.poisson:g} is outside 0 .. 0.5")

        # Computed once: the numbers from which compiled loops make heights.
        object.__setattr__(self, "terms", _film_terms(self))

    def sag_at_mm(self, displacement_um: float) -> float:
        """Depth of the bowl at a displacement (positive: deeper)."""
        return self.sag_mm + displacement_um / 1000.0

    def terms_at(self, displacement_um: float) -> FilmTerms:
        """The film as numbers at a displacement, where a stretched
        film has a profile of its own.
        """
        if self.bowl != "hencky" or (self.prestrain, self.poisson) == (0.0, hencky.POISSON_PET):
            return self.terms
        return self.terms._replace(bowl=self.load_and_bowl(displacement_um)[1])

    def load_and_bowl(self, displacement_um: float) -> tuple[float, FloatArray]:
        """Load p a / (E t) of a Hencky film at a displacement,
        and its profile as `FilmTerms.bowl`.
        """
        return stretched_film.solve_stretched_film(
            self.sag_at_mm(displacement_um) / self.radius_mm, self.prestrain, self.poisson
        )

    def height_mm(
        self, x_mm: FloatArray, y_mm: FloatArray, displacement_um: float = 0.0
    ) -> FloatArray:
        """Return the height above the vertex at points of the mirror.

        Parameters
        ----------
        x_mm, y_mm : array
            The points, of equal shape.
        displacement_um : float
            Of the centre; positive is a deeper bowl.

        Returns
        -------
        array
            In mm, of the points' shape.
        """
        flat = film_heights(
            self.terms_at(displacement_um),
            self.sag_at_mm(displacement_um),
            np.ravel(x_mm),
            np.ravel(y_mm),
        )
        return np.reshape(flat, np.shape(x_mm))

    def coeffs_um(self, displacement_um: float = 0.0) -> FloatArray | None:
        """Noll terms (ZERNIKE_TERMS,) of the whole surface, 0 at the vertex; None if they cannot
        represent it.

        A paraboloid s rho^2 is s/(2 sqrt 3) of Z4 = sqrt(3) (2 rho^2 - 1) above a piston of s/2.
        """
        if self.bowl != "paraboloid" or self.ripples or self.wrinkles or self.bumps:
            return None
        if any(self.zernike_um[ZERNIKE_TERMS:]):
            return None

        # The film's own terms, and the paraboloid's.
        coeffs = np.zeros(ZERNIKE_TERMS)
        own_um = self.zernike_um[:ZERNIKE_TERMS]
        coeffs[: len(own_um)] = own_um
        coeffs[3] += 1000.0 * self.sag_at_mm(displacement_um) / (2.0 * sqrt(3.0))

        # Piston so that the height at the vertex is 0.
        coeffs[0] = 0.0
        coeffs[0] = -zernike_polynomial(coeffs)[0, 0]
        return coeffs


def _film_terms(film: FilmShape) -> FilmTerms:
    """The film as numbers for the kernel, its offset chosen so that h(0, 0) = 0."""
    # Ripples as waves (amplitude, k_x, k_y, phase); wrinkles and bumps as rows of numbers.
    ripples = []
    for ripple in film.ripples:
        rad_per_mm = 2.0 * pi / ripple.wavelength_mm
        direction = radians(ripple.direction_deg)
        k_x = rad_per_mm * cos(direction)
        k_y = rad_per_mm * sin(direction)
        ripples.append((ripple.amplitude_um / 1000.0, k_x, k_y, ripple.phase_rad))
    wrinkles = [(w.amplitude_um / 1000.0, float(w.lobes), w.phase_rad) for w in film.wrinkles]
    bumps = [(b.amplitude_um / 1000.0, b.x_mm, b.y_mm, b.sigma_mm) for b in film.bumps]

    # The film with an offset of 0, and then with that which puts its vertex at 0.
    raised = FilmTerms(
        radius_mm=film.radius_mm,
        offset_mm=0.0,
        bowl=bowl_series(film.bowl, film.sag_mm, film.radius_mm),
        poly_mm=zernike_polynomial(np.array(film.zernike_um, dtype=np.float64) / 1000.0),
        ripples=np.array(ripples, dtype=np.float64).reshape(-1, 4),
        wrinkles=np.array(wrinkles, dtype=np.float64).reshape(-1, 3),
        bumps=np.array(bumps, dtype=np.float64).reshape(-1, 4),
    )
    vertex_mm = height_and_slopes(raised, film.sag_mm, 0.0, 0.0)[0]
    return raised._replace(offset_mm=vertex_mm)


def typical_film(
    sag_mm: float,
    radius_mm: float,
    seed: int,
    prestrain: float = 0.0,
    poisson: float = hencky.POISSON_PET,
) -> FilmShape:
    """A mounted film: a Hencky bowl with the figure errors of clamping by hand.

    0.3 mm of astigmatism, 0.1 mm of coma and 0.05 mm of trefoil, each in a direction drawn from the
    seed, and 10 µm RMS spread over the terms above.

    Parameters
    ----------
    sag_mm, radius_mm : float
        Depth of the bowl, and radius of its rim.
    seed : int
        Of the figure errors.
    prestrain, poisson : float
        The film's pre-strain and Poisson ratio.
    """
    # Pairs of a cosine and a sine term, each pair in a direction of its own.
    rng = np.random.default_rng(seed)
    coeffs_um = np.zeros(_TYPICAL_TERMS)
    for amplitude_um, sine, cosine in ((300.0, 5, 6), (100.0, 7, 8), (50.0, 9, 10)):
        angle = rng.uniform(0.0, 2.0 * pi)
        coeffs_um[sine - 1] = amplitude_um * sin(angle)
        coeffs_um[cosine - 1] = amplitude_um * cos(angle)
    higher = rng.normal(size=_TYPICAL_TERMS - 10)
    coeffs_um[10:] = 10.0 * higher / sqrt(float(np.dot(higher, higher)))
    figure = tuple(float(c) for c in coeffs_um)
    return FilmShape(sag_mm, radius_mm, prestrain=prestrain, poisson=poisson, zernike_um=figure)
