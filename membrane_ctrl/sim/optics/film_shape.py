"""Shape of the film: a bowl, Zernike terms, and what these terms cannot represent.

Frame: the mirror's own, x horizontal, y up, height h above the vertex, h(0, 0) = 0. The
displacement's zero is where the bowl has `sag_mm`; the rim stays where it is, so the bowl is
`sag_mm + displacement` deep and everything else moves with the rim.
"""

from dataclasses import dataclass, field
from functools import cache
from math import comb, cos, exp, factorial, isfinite, pi, radians, sin, sqrt
from typing import Literal, NamedTuple, get_args

import numpy as np
from numba import njit

from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from membrane_ctrl.sim import film as gas_film

MAX_FILM_TERMS = 66  # Noll's, up to radial order 10: finer errors are ripples, wrinkles and bumps
# of a mounted film, up to radial order 7; the film does not depend on how many are fitted
_TYPICAL_TERMS = 36
_SPHERE_TERMS = 40  # those left out are below 1e-12 for radii up to half of the curvature's
_Form = Literal["hencky", "paraboloid", "sphere"]


class FilmTerms(NamedTuple):
    """A film as plain numbers; heights in mm above the vertex, which `offset_mm` puts at 0.

    `bowl[k]` multiplies (r/radius)^(2k) and the sag; `poly_mm[i, k]` multiplies (x/radius)^i
    (y/radius)^k. Rows of `ripples`: amplitude_mm, k_x and k_y in rad/mm, phase_rad; of `wrinkles`:
    amplitude_mm, lobes, phase_rad; of `bumps`: amplitude_mm, x_mm, y_mm, sigma_mm.
    """

    radius_mm: float
    offset_mm: float
    bowl: FloatArray
    poly_mm: FloatArray
    ripples: FloatArray
    wrinkles: FloatArray
    bumps: FloatArray


@njit(cache=True)
def height_and_slopes(
    terms: FilmTerms, sag_mm: float, x_mm: float, y_mm: float
) -> tuple[float, float, float]:
    """Height above the vertex (mm) and its derivatives along x and y."""
    X, Y = x_mm / terms.radius_mm, y_mm / terms.radius_mm
    u = X * X + Y * Y
    bowl, bowl_u = 0.0, 0.0  # value and derivative to u, Horner
    for k in range(len(terms.bowl) - 1, -1, -1):
        bowl_u = bowl_u * u + bowl
        bowl = bowl * u + terms.bowl[k]
    h = sag_mm * bowl - terms.offset_mm
    hx, hy = 2.0 * X * sag_mm * bowl_u, 2.0 * Y * sag_mm * bowl_u

    degree = terms.poly_mm.shape[0] - 1
    value, value_x, value_y = 0.0, 0.0, 0.0
    for i in range(degree, -1, -1):
        row, row_y = 0.0, 0.0
        for k in range(degree - i, -1, -1):
            row_y = row_y * Y + row
            row = row * Y + terms.poly_mm[i, k]
        value_x = value_x * X + value
        value_y = value_y * X + row_y
        value = value * X + row
    h, hx, hy = h + value, hx + value_x, hy + value_y

    for n in range(terms.wrinkles.shape[0]):
        # amplitude Re((X + iY)^m e^(i phase)): m lobes at the rim
        amplitude, phase = terms.wrinkles[n, 0], terms.wrinkles[n, 2]
        below, order = complex(cos(phase), sin(phase)), int(terms.wrinkles[n, 1])
        for _ in range(order - 1):
            below *= complex(X, Y)
        h += amplitude * (below * complex(X, Y)).real
        hx += amplitude * order * below.real
        hy -= amplitude * order * below.imag
    hx, hy = hx / terms.radius_mm, hy / terms.radius_mm

    for n in range(terms.ripples.shape[0]):
        amplitude, kx, ky, phase = terms.ripples[n]
        angle = kx * x_mm + ky * y_mm + phase
        h += amplitude * cos(angle)
        hx -= amplitude * kx * sin(angle)
        hy -= amplitude * ky * sin(angle)
    for n in range(terms.bumps.shape[0]):
        amplitude, x0, y0, sigma = terms.bumps[n]
        dx, dy = x_mm - x0, y_mm - y0
        bump = amplitude * exp(-(dx * dx + dy * dy) / (2.0 * sigma * sigma))
        h += bump
        hx -= bump * dx / (sigma * sigma)
        hy -= bump * dy / (sigma * sigma)
    return h, hx, hy


@njit(cache=True)
def heights(terms: FilmTerms, sag_mm: float, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    """Heights in mm above the vertex at the points (x, y), all (n,)."""
    h_mm = np.empty(x_mm.size)
    for n in range(x_mm.size):
        h_mm[n] = height_and_slopes(terms, sag_mm, x_mm[n], y_mm[n])[0]
    return h_mm


def bowl_series(bowl: _Form, sag_mm: float, radius_mm: float) -> FloatArray:
    """Height of a bowl of unit sag above its vertex: element k multiplies rho^(2k).

    Hencky's has nu = 0.3; a concave sphere's depends on its sag: 1 - sqrt(1 - x rho^2), x = (radius
    / curvature's)^2.
    """
    if bowl == "hencky":
        return gas_film.solve().profile
    if bowl == "paraboloid":
        return np.array([0.0, 1.0])
    x = (2 * sag_mm * radius_mm / (radius_mm**2 + sag_mm**2)) ** 2
    terms = np.array(
        [0.0] + [comb(2 * k, k) / (4**k * (2 * k - 1)) * x**k for k in range(1, _SPHERE_TERMS)]
    )
    return np.asarray(terms / terms.sum())


# Zernike terms in Noll's order as polynomials in x and y, orthonormal (unit RMS) over the unit
# disc. The twin's own implementation: it shares nothing with the reconstruction it is used to
# check. Source: R. J. Noll, "Zernike polynomials and atmospheric turbulence", JOSA 66, 207 (1976).


def noll_orders(j: int) -> tuple[int, int]:
    """Radial order n and azimuthal order m of Noll's index j (from 1); m < 0 stands for the sine
    term.

    Raises ValueError if j < 1.
    """
    if j < 1:
        raise ValueError(f"Noll's index starts at 1, not {j}")
    n, place = 0, j - 1  # place of the term within its radial order
    while place > n:
        n += 1
        place -= n
    m = n % 2 + 2 * ((place + (n + 1) % 2) // 2)
    return n, m if j % 2 == 0 else -m


@cache
def _monomials(j: int) -> dict[tuple[int, int], float]:
    """Z_j as {(i, k): coefficient of x^i y^k}.

    R_n^m(rho) = sum_s (-1)^s (n-s)! / (s! ((n+m)/2-s)! ((n-m)/2-s)!) rho^(n-2s); with
    rho^m cos(m theta) + i rho^m sin(m theta) = (x + i y)^m and rho^2 = x^2 + y^2 every term is a
    polynomial.
    """
    n, signed_m = noll_orders(j)
    m = abs(signed_m)
    norm = sqrt(n + 1) if m == 0 else sqrt(2 * (n + 1))
    # (x + i y)^m: y^k carries i^k, real (cosine) for even k, imaginary (sine) for odd k
    first = 1 if signed_m < 0 else 0
    angular = (
        {(m - k, k): comb(m, k) * (-1) ** (k // 2) for k in range(first, m + 1, 2)}
        if m
        else {(0, 0): 1}
    )
    terms: dict[tuple[int, int], float] = {}
    for s in range((n - m) // 2 + 1):
        radial = (-1) ** s * factorial(n - s)
        radial //= factorial(s) * factorial((n + m) // 2 - s) * factorial((n - m) // 2 - s)
        power = (n - m) // 2 - s  # of x^2 + y^2
        for (i, k), factor in angular.items():
            for p in range(power + 1):
                key = (i + 2 * (power - p), k + 2 * p)
                terms[key] = terms.get(key, 0.0) + norm * radial * factor * comb(power, p)
    return terms


def polynomial(coeffs: FloatArray) -> FloatArray:
    """Sum of Zernike terms, coefficients (J,) of Noll's j = 1..J, as a polynomial of the unit
    disc's x and y.

    Element (i, k) of the (D + 1, D + 1) array multiplies x^i y^k, in the same unit; D is the
    highest degree used.
    """
    used = [j for j, value in enumerate(coeffs, start=1) if value != 0.0]
    degree = max((noll_orders(j)[0] for j in used), default=0)
    matrix = np.zeros((degree + 1, degree + 1))
    for j in used:
        for (i, k), factor in _monomials(j).items():
            matrix[i, k] += coeffs[j - 1] * factor
    return matrix


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
    poisson: float = gas_film.POISSON_PET
    terms: FilmTerms = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
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
        if not all(isfinite(c) for c in self.zernike_um):
            raise ValueError("zernike_um: every value must be a number")
        if len(self.zernike_um) > MAX_FILM_TERMS:
            raise ValueError(
                f"zernike_um holds {len(self.zernike_um)} terms; at most {MAX_FILM_TERMS} are known"
            )
        if not 0 <= self.poisson <= 0.5:
            raise ValueError(f"poisson = {self.poisson:g} is outside 0 .. 0.5")
        object.__setattr__(self, "terms", _terms(self))

    def sag_at_mm(self, displacement_um: float) -> float:
        """Depth of the bowl at a displacement (positive: deeper)."""
        return self.sag_mm + displacement_um / 1000.0

    def terms_at(self, displacement_um: float) -> FilmTerms:
        """The film as numbers at a displacement, where a stretched
        film has a profile of its own.
        """
        if self.bowl != "hencky" or (self.prestrain, self.poisson) == (0.0, gas_film.POISSON_PET):
            return self.terms
        return self.terms._replace(bowl=self.load_and_bowl(displacement_um)[1])

    def load_and_bowl(self, displacement_um: float) -> tuple[float, FloatArray]:
        """Load p a / (E t) of a Hencky film at a displacement,
        and its profile as `FilmTerms.bowl`.
        """
        return gas_film.stretched(
            self.sag_at_mm(displacement_um) / self.radius_mm, self.prestrain, self.poisson
        )

    def height_mm(
        self, x_mm: FloatArray, y_mm: FloatArray, displacement_um: float = 0.0
    ) -> FloatArray:
        """Height above the vertex at points of any (equal) shape."""
        flat = heights(
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
        coeffs = np.zeros(ZERNIKE_TERMS)
        own_um = self.zernike_um[:ZERNIKE_TERMS]
        coeffs[: len(own_um)] = own_um
        coeffs[3] += 1000.0 * self.sag_at_mm(displacement_um) / (2.0 * sqrt(3.0))
        coeffs[0] = 0.0
        coeffs[0] = -polynomial(coeffs)[0, 0]
        return coeffs


def _terms(film: FilmShape) -> FilmTerms:
    """The film as numbers for the kernel, its offset chosen so that h(0, 0) = 0."""
    waves = [(r, 2.0 * pi / r.wavelength_mm, radians(r.direction_deg)) for r in film.ripples]
    ripples = [
        (r.amplitude_um / 1000.0, k * cos(turn), k * sin(turn), r.phase_rad) for r, k, turn in waves
    ]
    wrinkles = [(w.amplitude_um / 1000.0, float(w.lobes), w.phase_rad) for w in film.wrinkles]
    bumps = [(b.amplitude_um / 1000.0, b.x_mm, b.y_mm, b.sigma_mm) for b in film.bumps]
    raised = FilmTerms(
        radius_mm=film.radius_mm,
        offset_mm=0.0,
        bowl=bowl_series(film.bowl, film.sag_mm, film.radius_mm),
        poly_mm=polynomial(np.array(film.zernike_um, dtype=np.float64) / 1000.0),
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
    poisson: float = gas_film.POISSON_PET,
) -> FilmShape:
    """A mounted film: a Hencky bowl with the figure errors of clamping by hand.

    0.3 mm of astigmatism, 0.1 mm of coma and 0.05 mm of trefoil, each in a direction drawn from the
    seed, and 10 µm RMS spread over the terms above.
    """
    rng = np.random.default_rng(seed)
    coeffs_um = np.zeros(_TYPICAL_TERMS)
    for amplitude_um, sine, cosine in ((300.0, 5, 6), (100.0, 7, 8), (50.0, 9, 10)):
        angle = rng.uniform(0.0, 2.0 * pi)
        coeffs_um[sine - 1], coeffs_um[cosine - 1] = (
            amplitude_um * sin(angle),
            amplitude_um * cos(angle),
        )
    higher = rng.normal(size=_TYPICAL_TERMS - 10)
    coeffs_um[10:] = 10.0 * higher / sqrt(float(np.dot(higher, higher)))
    figure = tuple(float(c) for c in coeffs_um)
    return FilmShape(sag_mm, radius_mm, prestrain=prestrain, poisson=poisson, zernike_um=figure)
