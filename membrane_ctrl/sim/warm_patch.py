"""A film that is warmer in a patch than elsewhere, by a lamp, a hand or the screen.

A Ritz film of least energy, clamped in its ring:

    w = (1 - r^2) sum c_ij x^i y^j,  u and v likewise, on the unit disc
    e_x = u_x + w_x^2 / 2 - s,  e_y = v_y + w_y^2 / 2 - s,  g = u_y + v_x + w_x w_y
    energy = integral of (N_x e_x + N_y e_y + N_xy g) / 2 - p w

with the strain s of the patch. Newton's steps solve it; the change of the figure at equal sag is
linear in s for the strains of some kelvins.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.sim.climate import POISSON_RATIO
from membrane_ctrl.sim.film import NOMINAL_SAG_MM, RADIUS_MM

_HEIGHT_DEGREE = 8  # of the polynomials beside (1 - r^2): 30 nm of the change are left
_PLANE_DEGREE = 9
_RADII, _AZIMUTHS = 16, 40  # of the quadrature
_STEPS = 30  # Newton's, from a paraboloid: ten are enough
_CONVERGED = 1e-12
_STRAIN = 2e-5  # for the derivative
# Places and weights of the load's search: the load goes with the cube of the depth
_LOAD_ROUNDS = 4


@dataclass(frozen=True)
class Patch:
    """A round patch with a Gaussian profile.

    Attributes
    ----------
    x_mm, y_mm : float
        Its middle.
    sigma_mm : float
    """

    x_mm: float
    y_mm: float
    sigma_mm: float

    def profile(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the warming at places of the film, relative to the middle of the patch.

        Parameters
        ----------
        x, y : (n,) array
            Places on the unit disc: in units of the film's radius, from its centre.

        Returns
        -------
        (n,) array
            0 to 1.
        """
        square_mm2 = (RADIUS_MM * x - self.x_mm) ** 2 + (RADIUS_MM * y - self.y_mm) ** 2
        return np.asarray(np.exp(-square_mm2 / (2 * self.sigma_mm**2)))


class _RitzFilm:
    """Basis functions at the places of the quadrature, and Newton's solution."""

    def __init__(self) -> None:
        # Places and weights of the quadrature: Gauss in r^2, even in the azimuth.
        nodes, weights = np.polynomial.legendre.leggauss(_RADII)
        radius = np.sqrt((nodes + 1) / 2)  # even in area
        angle = 2 * np.pi * (np.arange(_AZIMUTHS) + 0.5) / _AZIMUTHS
        self.x = np.outer(radius, np.cos(angle)).ravel()
        self.y = np.outer(radius, np.sin(angle)).ravel()
        self.weights = np.repeat(weights / 2, _AZIMUTHS) * np.pi / _AZIMUTHS

        # The basis functions there: of w with the derivatives that make strains, of u and v.
        self.height_powers = _list_powers(_HEIGHT_DEGREE)
        w, w_x, w_y = _evaluate(self.height_powers, self.x, self.y)
        _, u_x, u_y = _evaluate(_list_powers(_PLANE_DEGREE), self.x, self.y)
        self._slopes = np.stack([w_x, w_y])
        none = np.zeros_like(u_x)

        # Strains e_x, e_y and g (3, n, unknowns) of u and of v.
        self._in_plane = np.stack(
            [np.hstack([u_x, none]), np.hstack([none, u_y]), np.hstack([u_y, u_x])]
        )

        # Work of the load per unit of each unknown, height of the centre, and Hooke's law of plane
        # stress for E t = 1.
        self._load = self.weights @ w
        self._centre = _evaluate(self.height_powers, np.zeros(1), np.zeros(1))[0][0]
        nu = POISSON_RATIO
        stiff = np.array([[1.0, nu, 0.0], [nu, 1.0, 0.0], [0.0, 0.0, (1 - nu) / 2]])
        self._stiffness = stiff / (1 - nu**2)

    def solve(self, strain: FloatArray, depth: float) -> FloatArray:
        """Coefficients of w for a strain (n,) at the places, at a depth of the centre."""
        # Begin with a paraboloid (1 - r^2) depth; the load of a film goes with the cube of its
        # depth, which corrects it in each round.
        heights = len(self.height_powers)
        unknowns = np.zeros(heights + self._in_plane.shape[2])
        unknowns[0] = depth
        load = 4 * depth**3
        for _ in range(_LOAD_ROUNDS):
            unknowns = self._solve_loaded(unknowns, strain, load)
            load *= (depth / float(self._centre @ unknowns[:heights])) ** 3

        # What is left of the difference, by scale.
        found = unknowns[:heights]
        return np.asarray(found * depth / float(self._centre @ found))

    def _solve_loaded(self, unknowns: FloatArray, strain: FloatArray, load: float) -> FloatArray:
        """Newton's steps at a pressure."""
        heights = len(self.height_powers)
        thermal = np.stack([strain, strain, np.zeros_like(strain)])
        for _ in range(_STEPS):
            # 1. Strains and forces at the places
            slope_x, slope_y = self._slopes @ unknowns[:heights]
            strains = np.array([slope_x**2 / 2, slope_y**2 / 2, slope_x * slope_y]) - thermal
            strains += self._in_plane @ unknowns[heights:]
            forces = self._stiffness @ strains
            # 2. Derivatives (3, n, unknowns) of the strains
            by_x, by_y = self._slopes
            by_heights = np.stack(
                [
                    slope_x[:, None] * by_x,
                    slope_y[:, None] * by_y,
                    slope_x[:, None] * by_y + slope_y[:, None] * by_x,
                ]
            )
            rows = np.concatenate([by_heights, self._in_plane], axis=2)
            # 3. Gradient and Hessian of the energy
            gradient = np.einsum("in,inj->j", self.weights * forces, rows)
            gradient[:heights] -= load * self._load
            stiff_rows = np.einsum("ik,knj->inj", self._stiffness, rows) * self.weights[:, None]
            hessian = np.tensordot(rows, stiff_rows, axes=([0, 1], [0, 1]))

            # The forces act on the second derivatives of the strains, w_x^2 / 2 and w_x w_y.
            n_x, n_y, n_xy = (self.weights * forces)[:, :, None]
            crossed = by_x.T @ (n_xy * by_y)
            hessian[:heights, :heights] += (
                by_x.T @ (n_x * by_x) + by_y.T @ (n_y * by_y) + crossed + crossed.T
            )
            step = np.linalg.solve(hessian, gradient)
            unknowns = unknowns - step
            if np.abs(step).max() < _CONVERGED:
                break
        return unknowns


def _list_powers(degree: int) -> list[tuple[int, int]]:
    """Exponents of x and y up to a degree."""
    return [(i, n - i) for n in range(degree + 1) for i in range(n + 1)]


def _evaluate(
    powers: list[tuple[int, int]], x: FloatArray, y: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(1 - r^2) x^i y^j and its derivatives by x and y, (n, powers) each."""
    # (c t)_x = c t_x - 2 x t with the clamp c = 1 - r^2 and the term t = x^i y^j.
    clamp = 1 - x * x - y * y
    values = []
    by_x = []
    by_y = []
    for i, j in powers:
        term = x**i * y**j
        term_x = i * x ** max(i - 1, 0) * y**j
        term_y = j * x**i * y ** max(j - 1, 0)
        values.append(clamp * term)
        by_x.append(clamp * term_x - 2 * x * term)
        by_y.append(clamp * term_y - 2 * y * term)
    return np.stack(values, 1), np.stack(by_x, 1), np.stack(by_y, 1)


@cache
def _make_film() -> _RitzFilm:
    return _RitzFilm()


@cache
def compute_patch_polynomial(patch: Patch) -> FloatArray:
    """Change of the figure at equal sag by a patch that is strained by 1e-6 in its middle.

    Parameters
    ----------
    patch : Patch

    Returns
    -------
    (k, k) array
        Coefficients of x^i y^j on the unit disc, µm of height, 0 at vertex and rim.
    """
    # Half the difference of a warm and a cold patch: terms of even order in the strain cancel.
    film = _make_film()
    depth = NOMINAL_SAG_MM / RADIUS_MM
    profile = patch.profile(film.x, film.y)
    solved = [film.solve(sign * _STRAIN * profile, depth) for sign in (1, -1)]

    # Heights are upward: a deeper place is lower. In µm, for a strain of 1e-6.
    change = -1e3 * RADIUS_MM * 1e-6 * (solved[0] - solved[1]) / (2 * _STRAIN)

    # (1 - x^2 - y^2) x^i y^j, multiplied out.
    polynomial = np.zeros((_HEIGHT_DEGREE + 3, _HEIGHT_DEGREE + 3))
    for (i, j), value in zip(film.height_powers, change, strict=True):
        polynomial[i, j] += value
        polynomial[i + 2, j] -= value
        polynomial[i, j + 2] -= value
    return polynomial
