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

_FINITE_TERMS = 14  # of U, which give the slopes to 1e-12
_NEWTON_STEPS = 20
_FORCE_STEPS = 40  # of Newton's method for the radial force
_PLACE_STEPS = 8  # from the deformed film back to the flat one


def finite_rise_mm(law: FilmLaw, load: float, rho: FloatArray) -> FloatArray:
    """dh / drho at radii of the deformed film, of one film under one load.

    Parameters
    ----------
    law : FilmLaw
        The film.
    load : float
        q = p a / (E t).
    rho : (n,) array
        Radii over that of the ring.

    Returns
    -------
    (n,) array
        In mm.

    Raises
    ------
    ValueError
        The film would be slack at its ring.
    """
    v, outward, outward_v, slope = _finite_tables()
    bowl = law.under_load(np.asarray(load))
    prestrain = float(law.prestrain)
    poisson = float(law.poisson)
    film = prestrain, poisson, load

    # Start: U from the hoop's strain of the film with small slopes.
    radial, hoop = bowl.stresses(np.sqrt(v))
    unknowns = np.linalg.lstsq(outward, hoop - poisson * radial - prestrain, rcond=None)[0]

    # Newton's method on the balance of forces outward. Derivatives are those of complex steps, one
    # in each column but the first.
    steps = COMPLEX_STEP * 1j * np.eye(unknowns.size + 1)[:, 1:].T
    for _ in range(_NEWTON_STEPS):
        tried = unknowns[:, None] + steps
        force, around, along, wide = _finite_forces(
            film, v, outward @ tried, outward_v @ tried, radial
        )
        pull = force * along
        change_of_pull = pull + 2 * v[:, None] * (slope @ pull)
        pressure = load**2 * v[:, None] * wide**3 / (2 * force)
        imbalance = change_of_pull - around * wide + pressure
        jacobian = imbalance[:, 1:].imag / COMPLEX_STEP
        step = np.linalg.solve(jacobian, -imbalance[:, 0].real)
        unknowns = unknowns + step
        if np.max(np.abs(step)) < 1e-14:
            break

    # From places of the deformed film to those of the flat one, which moved by some 1e-3.
    flat_v = rho**2
    for _ in range(_PLACE_STEPS):
        flat_v = rho**2 / (1 + _finite_basis(flat_v)[0] @ unknowns) ** 2
    there, change = (table @ unknowns[:, None] for table in _finite_basis(flat_v))

    # dh/dr of the flat film over 1 + u', the stretch of the radius.
    force, _, along, wide = _finite_forces(film, flat_v, there, change, bowl.stresses(rho)[0])
    rise = load * np.sqrt(flat_v) * (wide**2 / (2 * force * along))[:, 0]
    return np.asarray(law.radius_mm * rise)


def _finite_forces(
    film: tuple[float, float, float],
    v: FloatArray,
    outward: AnyArray,
    outward_v: AnyArray,
    start: FloatArray,
) -> tuple[AnyArray, AnyArray, AnyArray, AnyArray]:
    """S, H, 1 + u' and 1 + U, each (n, m).

    With the slope by the balance along z, Hooke's law is a cubic equation for S; its positive root
    is found by Newton's method.

    Parameters
    ----------
    film : three floats
        Pre-strain, Poisson ratio and load.
    v : (n,) array
        Places.
    outward, outward_v : (n, m) arrays
        U and dU/dv.
    start : (n,) array
        Where Newton's method begins.
    """
    prestrain, poisson, load = film

    # Strains of the hoop, and of the radius without the slope's part.
    u_r = outward + 2 * v[:, None] * outward_v
    hoop_strain = prestrain + outward + outward**2 / 2
    flat_strain = prestrain + u_r + u_r**2 / 2 + poisson * hoop_strain

    # Hooke's law S (1 - nu^2) = flat_strain + h'^2 / 2 with h'^2 / 2 = climb / S^2.
    climb = load**2 * v[:, None] * (1 + outward) ** 4 / 8
    stiffness = 1 - poisson**2
    force = start[:, None] + 0 * outward
    for _ in range(_FORCE_STEPS):
        excess = stiffness * force - flat_strain - climb / force**2
        slope = stiffness + 2 * climb / force**3
        force = force - excess / slope
    hoop_force = hoop_strain + poisson * force
    return force, hoop_force, 1 + u_r, 1 + outward


def _finite_basis(v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """U and dU/dv (n, terms) of U = (1 - v) T_k(2 v - 1): the ring holds the film."""
    units = np.eye(_FINITE_TERMS)
    value = chebyshev.chebval(2 * v - 1, units).T
    slope = 2 * chebyshev.chebval(2 * v - 1, chebyshev.chebder(units)).T
    return (1 - v)[:, None] * value, (1 - v)[:, None] * slope - value


@cache
def _finite_tables() -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Places v (n,), U and dU/dv there, and the derivatives (n, n) from values there."""
    v = (chebyshev.chebpts1(_FINITE_TERMS) + 1) / 2
    units = np.eye(_FINITE_TERMS)
    value = chebyshev.chebval(2 * v - 1, units).T
    slope = 2 * chebyshev.chebval(2 * v - 1, chebyshev.chebder(units)).T
    outward, outward_v = _finite_basis(v)
    return v, outward, outward_v, slope @ np.linalg.inv(value)
