"""A film that was stretched before it was clamped, or is of another material.

Its shape is the one of least energy.

No slope is called small: Green's strains in Hooke's law, and the work of a pressure that stays
normal to the film, the load q = p a / (E t) times the volume. With u outward and w down at the
radius r of the flat film, all in radii:

    e_r = prestrain + u' + (u'^2 + w'^2) / 2,
    e_t = prestrain + u / r + (u / r)^2 / 2,
    energy = integral of (e_r^2 + e_t^2 + 2 nu e_r e_t) / (2 (1 - nu^2)) r dr
             - q integral of w (r + u) (1 + u') dr.
"""

import warnings
from functools import cache

import numpy as np
from numpy.polynomial import Chebyshev, Polynomial, chebyshev, legendre
from scipy.optimize import fsolve

from membrane_ctrl.model.arrays import FloatArray

_SHAPES = 13  # Legendre terms of u and of w: the slopes are exact to 1e-12
_PROFILE_DEGREE = 18  # exact to the last bit; powers of rho^2 lose digits beyond


@cache
def solve_stretched_film(
    depth: float, prestrain: float, poisson: float
) -> tuple[float, FloatArray]:
    """Load q and profile of a film: element k of the profile multiplies rho^(2k), height for a
    depth of 1.

    rho is where the film is under its load. Raises ValueError if the film would be slack at its
    ring.
    """
    depth = depth or 1e-9  # a flat film bends as the shallowest does
    x, weight = legendre.leggauss(6 * _SHAPES)
    v = (x + 1) / 2
    r, area = np.sqrt(v), weight / 4
    (wide, wide_r), (deep, deep_r) = _shape_functions(v)
    vertex = _shape_functions(np.zeros(1))[1][0][:, 0]

    def forces(u: FloatArray, u_r: FloatArray, w_r: FloatArray) -> tuple[FloatArray, FloatArray]:
        along, around = (
            prestrain + u_r + (u_r**2 + w_r**2) / 2,
            prestrain + u / r + (u / r) ** 2 / 2,
        )
        return (along + poisson * around) / (1 - poisson**2), (around + poisson * along) / (
            1 - poisson**2
        )

    # a film's strain is its pre-strain and the square of its depth: with these units any film is of
    # order 1
    strain = depth**2 + max(prestrain, 0.0)
    units = np.concatenate([np.full(_SHAPES, depth**2), np.full(_SHAPES, depth), [strain * depth]])

    def gradient(scaled: FloatArray) -> FloatArray:
        u, w, push = np.split(scaled * units, [_SHAPES, 2 * _SHAPES])
        push = push * area / r
        out, out_r, down, down_r = u @ wide, u @ wide_r, w @ deep, w @ deep_r
        pull, hoop = (area * force for force in forces(out, out_r, down_r))
        of_u = wide_r @ (pull * (1 + out_r) - push * down * (r + out)) + wide / r @ (
            hoop * (1 + out / r)
        )
        of_u -= wide @ (push * down * (1 + out_r))
        of_w = deep_r @ (pull * down_r) - deep @ (push * (r + out) * (1 + out_r))
        return np.concatenate([of_u / strain, of_w / (strain * depth), [w @ vertex / depth - 1]])

    start = np.zeros(2 * _SHAPES + 1)
    start[_SHAPES], start[-1] = 1.0, 4.0
    with warnings.catch_warnings(
        action="ignore", category=RuntimeWarning
    ):  # of slow progress at the last bits
        found = np.asarray(fsolve(gradient, start, xtol=1e-15, maxfev=20_000))
    u, w, load = np.split(found * units, [_SHAPES, 2 * _SHAPES])
    pull, _ = forces(u @ wide, u @ wide_r, w @ deep_r)
    if np.abs(gradient(found)).max() > 1e-11 or pull.min() < 0.2 * pull[0]:
        raise ValueError(f"prestrain = {prestrain:g}: the film would be slack at its ring")
    at = (chebyshev.chebpts2(8 * _PROFILE_DEGREE) + 1) / 2
    (out, _), (down, _) = (tables for tables in _shape_functions(at))
    rho2 = (np.sqrt(at) + u @ out) ** 2
    profile = Chebyshev.fit(rho2, 1 - w @ down / depth, _PROFILE_DEGREE, domain=[0, 1])
    powers = profile.convert(domain=[-1, 1], kind=Polynomial, window=[-1, 1]).coef
    return float(load[0]), np.concatenate([[0.0], powers[1:]])


def _shape_functions(
    v: FloatArray,
) -> tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
    """Displacements outward, r (1 - v) P(v), and down, (1 - v) P(v), with v = r^2, and their
    derivatives along r.
    """
    r, eye = np.sqrt(v), np.eye(_SHAPES)
    value, slope = (
        legendre.legval(2 * v - 1, eye),
        2 * legendre.legval(2 * v - 1, legendre.legder(eye)),
    )
    down, down_r = (1 - v) * value, 2 * r * ((1 - v) * slope - value)
    return (r * down, down + r * down_r), (down, down_r)
