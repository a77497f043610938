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
    """Solve for a film of given depth.

    Parameters
    ----------
    depth : float
        Depth over the radius.
    prestrain : float
        Strain of the flat film.
    poisson : float
        Poisson ratio.

    Returns
    -------
    load : float
        q.
    profile : (k,) array
        Element k multiplies rho^(2k), with rho the radius at which the film is under its load;
        height for a depth of 1.

    Raises
    ------
    ValueError
        If the film would be slack at its ring.
    """
    depth = depth or 1e-9  # a flat film bends as the shallowest does

    # Nodes of the integral over the area, and the shapes there.
    x, weight = legendre.leggauss(6 * _SHAPES)
    v = (x + 1) / 2
    r = np.sqrt(v)
    area = weight / 4
    (wide, wide_r), (deep, deep_r) = _shape_functions(v)
    vertex = _shape_functions(np.zeros(1))[1][0][:, 0]

    def forces(u: FloatArray, u_r: FloatArray, w_r: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Radial and hoop force per length over E t, by Hooke's law of Green's strains."""
        along = prestrain + u_r + (u_r**2 + w_r**2) / 2
        around = prestrain + u / r + (u / r) ** 2 / 2
        radial = (along + poisson * around) / (1 - poisson**2)
        hoop = (around + poisson * along) / (1 - poisson**2)
        return radial, hoop

    # A film's strain is its pre-strain and the square of its depth: in these units any film is of
    # order 1.
    strain = depth**2 + max(prestrain, 0.0)
    units = np.concatenate([np.full(_SHAPES, depth**2), np.full(_SHAPES, depth), [strain * depth]])

    def gradient(scaled: FloatArray) -> FloatArray:
        """Derivatives of the energy by the shapes of u and w, and the depth less the wanted one."""
        u, w, load = np.split(scaled * units, [_SHAPES, 2 * _SHAPES])
        # Displacements and their slopes at the nodes
        out = u @ wide
        out_r = u @ wide_r
        down = w @ deep
        down_r = w @ deep_r
        # Forces at the nodes, with the weights of the integral
        radial, hoop = (area * force for force in forces(out, out_r, down_r))
        push = load * area / r
        # Elastic energy less the work of the pressure on the volume, by u
        of_u = wide_r @ (radial * (1 + out_r) - push * down * (r + out))
        of_u = of_u + wide / r @ (hoop * (1 + out / r))
        of_u -= wide @ (push * down * (1 + out_r))
        # and by w
        of_w = deep_r @ (radial * down_r) - deep @ (push * (r + out) * (1 + out_r))
        too_deep = w @ vertex / depth - 1
        return np.concatenate([of_u / strain, of_w / (strain * depth), [too_deep]])

    # The film in equilibrium is the zero; slow progress at the last bits is no fault.
    start = np.zeros(2 * _SHAPES + 1)
    start[_SHAPES] = 1.0
    start[-1] = 4.0
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):
        found = np.asarray(fsolve(gradient, start, xtol=1e-15, maxfev=20_000))
    u, w, load = np.split(found * units, [_SHAPES, 2 * _SHAPES])
    pull, _ = forces(u @ wide, u @ wide_r, w @ deep_r)
    if np.abs(gradient(found)).max() > 1e-11 or pull.min() < 0.2 * pull[0]:
        raise ValueError(f"prestrain = {prestrain:g}: the film would be slack at its ring")

    # The height over the place under load, as a power series.
    nodes = (chebyshev.chebpts2(8 * _PROFILE_DEGREE) + 1) / 2
    (out, _), (down, _) = _shape_functions(nodes)
    rho2 = (np.sqrt(nodes) + u @ out) ** 2
    profile = Chebyshev.fit(rho2, 1 - w @ down / depth, _PROFILE_DEGREE, domain=[0, 1])
    powers = profile.convert(domain=[-1, 1], kind=Polynomial, window=[-1, 1]).coef
    return float(load[0]), np.concatenate([[0.0], powers[1:]])


def _shape_functions(
    v: FloatArray,
) -> tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
    """Displacements outward, r (1 - v) P(v), and down, (1 - v) P(v), with v = r^2, and their
    derivatives along r: (_SHAPES, n) each.
    """
    r = np.sqrt(v)
    eye = np.eye(_SHAPES)
    value = legendre.legval(2 * v - 1, eye)
    slope = 2 * legendre.legval(2 * v - 1, legendre.legder(eye))
    down = (1 - v) * value
    down_r = 2 * r * ((1 - v) * slope - value)
    return (r * down, down + r * down_r), (down, down_r)
