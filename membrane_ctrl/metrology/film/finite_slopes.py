"""The film without the assumption of small slopes.

Green's strains, and pressure normal to the film where it is. With u = r U(v) outward and S, H the
second Piola-Kirchhoff forces over E t, the balance along z integrates to h' = q r (1 + U)^2 / (2
S). Outward it is (r S (1 + u'))' = H (1 + U) - q r (1 + U) h', and Hooke's law is S (1 - nu^2) = e
+ u' + (u'^2 + h'^2) / 2 + nu (e + U + U^2 / 2).
"""

from functools import cache

import numpy as np
from numpy.polynomial import chebyshev

from membrane_ctrl.metrology.film.film_law import COMPLEX_STEP, FilmLaw
from membrane_ctrl.model.arrays import AnyArray, FloatArray

_FINITE_TERMS = 14  # of U: 1e-12 of the slopes


def finite_rise_mm(law: FilmLaw, load: float, rho: FloatArray) -> FloatArray:
    """dh / drho (n,) at radii rho of the deformed film, of one film under one load. Raises
    ValueError as `under`.
    """
    v, outward, grows, slope = _finite_tables()
    bowl, poisson = law.loaded(np.asarray(load)), float(law.poisson)
    film = float(law.prestrain), poisson, load
    radial, hoop = bowl.stresses(np.sqrt(v))
    unknowns = np.linalg.lstsq(outward, hoop - poisson * radial - film[0], rcond=None)[0]
    steps = COMPLEX_STEP * 1j * np.eye(unknowns.size + 1)[:, 1:].T  # the first column stays
    for _ in range(20):
        near = unknowns[:, None] + steps
        force, around, along, wide = _finite_forces(film, v, outward @ near, grows @ near, radial)
        pull = force * along
        left = (
            pull
            + 2 * v[:, None] * (slope @ pull)
            - around * wide
            + load**2 * v[:, None] * wide**3 / (2 * force)
        )
        step = np.linalg.solve(left[:, 1:].imag / COMPLEX_STEP, -left[:, 0].real)
        unknowns = unknowns + step
        if np.max(np.abs(step)) < 1e-14:
            break
    at = rho**2
    for _ in range(8):  # from where the film is to where it was: it moved by some 1e-3
        at = rho**2 / (1 + _finite_basis(at)[0] @ unknowns) ** 2
    there, climbs = (table @ unknowns[:, None] for table in _finite_basis(at))
    force, _, along, wide = _finite_forces(film, at, there, climbs, bowl.stresses(rho)[0])
    return np.asarray(law.radius_mm * load * np.sqrt(at) * (wide**2 / (2 * force * along))[:, 0])


def _finite_forces(
    film: tuple[float, float, float],
    v: FloatArray,
    outward: AnyArray,
    grows: AnyArray,
    near: FloatArray,
) -> tuple[AnyArray, AnyArray, AnyArray, AnyArray]:
    """S, H, 1 + u' and 1 + U, (n, m), from U and dU/dv; S is the positive root of a cubic, by
    Newton from `near`.
    """
    prestrain, poisson, load = film
    u_r, hoop = outward + 2 * v[:, None] * grows, prestrain + outward + outward**2 / 2
    flat = prestrain + u_r + u_r**2 / 2 + poisson * hoop
    climb = load**2 * v[:, None] * (1 + outward) ** 4 / 8
    force = near[:, None] + 0 * outward
    for _ in range(40):
        miss = (1 - poisson**2) * force - flat - climb / force**2
        force = force - miss / (1 - poisson**2 + 2 * climb / force**3)
    return force, hoop + poisson * force, 1 + u_r, 1 + outward


def _finite_basis(v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """U and dU/dv (n, terms) of U = (1 - v) T_k(2 v - 1): the ring holds the film."""
    eye = np.eye(_FINITE_TERMS)
    value, slope = (
        chebyshev.chebval(2 * v - 1, eye).T,
        2 * chebyshev.chebval(2 * v - 1, chebyshev.chebder(eye)).T,
    )
    return (1 - v)[:, None] * value, (1 - v)[:, None] * slope - value


@cache
def _finite_tables() -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Places v (n,), U and dU/dv there, and the derivatives (n, n) from values there."""
    v, eye = (chebyshev.chebpts1(_FINITE_TERMS) + 1) / 2, np.eye(_FINITE_TERMS)
    slope = 2 * chebyshev.chebval(2 * v - 1, chebyshev.chebder(eye)).T
    return v, *_finite_basis(v), slope @ np.linalg.inv(chebyshev.chebval(2 * v - 1, eye).T)
