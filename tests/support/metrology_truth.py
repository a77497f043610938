"""A forward model of the tests' own, by other means than the code under test.

Zernike terms from prysm, the Hencky bowl from an integrated differential equation, slopes by
central differences, rays met with the film by bisection, reflection by Householder's matrix.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.typing import NDArray
from prysm.polynomials import noll_to_nm, zernike_nm
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from membrane_ctrl.config.schema import CameraConfig, OpticsConfig
from membrane_ctrl.metrology.rays.ray_tracing import HeightFunction

FloatArray = NDArray[np.float64]
RADIUS_MM = 500.0

# the paper's camera with 64 pixels in one: 34 000 of them see the mirror
SMALL = CameraConfig(width_px=306, height_px=256, pixel_um=3.45 * 8)
OPTICS = OpticsConfig(camera=SMALL)


@cache
def film_solution(ring_strain: float = 0.0, poisson: float = 0.3):  # type: ignore[no-untyped-def]
    """n, n' and the integral of rho / n, from rho = 0 (series) to 1, for the n(0) that meets the
    rim's condition.

    `ring_strain` is the pre-strain over q^(2/3).
    """

    def slope(rho: float, y: FloatArray) -> list[float]:
        n, dn, _ = y
        return [dn, -3 * dn / rho - 1 / (8 * n * n), rho / n]

    def shoot(centre: float, dense: bool = False):  # type: ignore[no-untyped-def]
        eps = 1e-3
        start = [centre - eps**2 / (64 * centre**2), -eps / (32 * centre**2), eps**2 / (2 * centre)]
        return solve_ivp(
            slope, (eps, 1), start, rtol=1e-12, atol=1e-14, dense_output=dense, method="DOP853"
        )

    def rim(centre: float) -> float:
        n, dn, _ = shoot(centre).y[:, -1]
        return float(dn + (1 - poisson) * n - ring_strain)

    return shoot(brentq(rim, 0.36, 30.0, xtol=1e-15), True)


def hencky_depth(rho: FloatArray, ring_strain: float = 0.0, poisson: float = 0.3) -> FloatArray:
    """Profile of unit sag at rho, from the differential equation."""
    solution = film_solution(ring_strain, poisson)
    out = solution.sol(np.clip(rho, 1e-3, 1))[2]
    centre = solution.sol(1e-3)[2]
    return np.where(rho < 1e-3, centre * (rho / 1e-3) ** 2, out) / solution.y[2, -1]


@dataclass(frozen=True)
class TrueFilm:
    """h = sag x Hencky + Zernike terms (mm, by Noll's index), counted from the vertex."""

    sag_mm: float = 0.0
    terms_mm: dict[int, float] = field(default_factory=dict)

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Height in mm."""
        rho, theta = np.hypot(x, y) / RADIUS_MM, np.arctan2(y, x)
        out = self.sag_mm * hencky_depth(rho) if self.sag_mm else np.zeros(np.shape(x))
        for j, amount in self.terms_mm.items():
            n, m = noll_to_nm(j)
            centre = zernike_nm(n, m, np.array([0.0]), np.array([0.0]), norm=True)[0]
            out = out + amount * (zernike_nm(n, m, rho, theta, norm=True) - centre)
        return out

    def normal(self, x: FloatArray, y: FloatArray, step: float = 0.02) -> FloatArray:
        """Unit normals (3, n) by central differences of fourth order."""

        def slope(dx: float, dy: float) -> FloatArray:
            near = self.height(x + dx, y + dy) - self.height(x - dx, y - dy)
            far = self.height(x + 2 * dx, y + 2 * dy) - self.height(x - 2 * dx, y - 2 * dy)
            return (8 * near - far) / (12 * step)

        n = np.stack([-slope(step, 0), -slope(0, step), np.ones_like(x)])
        return n / np.linalg.norm(n, axis=0)


@dataclass(frozen=True)
class Seen:
    """What the camera sees: rays (3, n), points on the film (3, n), screen coordinates (2, n)."""

    rays: FloatArray
    film_mm: FloatArray
    screen_mm: FloatArray


def pixel_grid(camera: CameraConfig, stride: int = 1) -> tuple[FloatArray, FloatArray]:
    """Columns and rows of every `stride`-th pixel."""
    columns, rows = np.meshgrid(
        np.arange(0, camera.width_px, stride), np.arange(0, camera.height_px, stride)
    )
    return columns.ravel().astype(float), rows.ravel().astype(float)


def look(  # type: ignore[no-untyped-def]
    geometry,
    film: TrueFilm,
    columns: FloatArray,
    rows: FloatArray,
    radius_mm: float = 475.0,
    vertex_z_mm: float = 0.0,
) -> Seen:
    """Follow the rays of some pixels; those that meet the film inside a radius."""
    rays = geometry.rays(columns, rows)
    pinhole = geometry.pinhole_mm
    plane = (vertex_z_mm - pinhole[2]) / rays[2]
    hit = pinhole[:2, None] + plane * rays[:2]
    rays, plane = rays[:, np.hypot(*hit) < 490], plane[np.hypot(*hit) < 490]
    low, high = plane - 200, plane + 200
    for _ in range(60):
        middle = (low + high) / 2
        p = pinhole[:, None] + middle * rays
        above = p[2] - vertex_z_mm - film.height(p[0], p[1]) > 0
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    p = pinhole[:, None] + (low + high) / 2 * rays
    inside = np.hypot(p[0], p[1]) <= radius_mm
    rays, p = rays[:, inside], p[:, inside]
    n = film.normal(p[0], p[1])
    mirror = np.eye(3)[:, :, None] - 2 * np.einsum("in,jn->ijn", n, n)
    u = np.einsum("ijn,jn->in", mirror, rays)
    axes = np.stack([geometry.screen_s_x, geometry.screen_s_y])
    # p + k u = O' + s_x e_x + s_y e_y: three equations for s_x, s_y and k
    matrix = np.stack([*(np.broadcast_to(axis[:, None], p.shape) for axis in axes), -u], axis=1)
    solved = np.linalg.solve(
        matrix.transpose(2, 0, 1), (p - geometry.screen_origin_mm[:, None]).T[:, :, None]
    )
    return Seen(rays, p, solved[:, :2, 0].T.copy())


def fringe_frames(
    screen_mm: FloatArray, shifts_rad: FloatArray, period_mm: float, periods: int
) -> FloatArray:
    """Intensities (N, ...) of the sinusoids at places on the screen, mean 100 and amplitude 80."""
    phase = 2 * np.pi * (screen_mm + periods * period_mm / 2) / period_mm - np.pi
    return 100 + 80 * np.cos(phase + np.asarray(shifts_rad).reshape(-1, *[1] * screen_mm.ndim))


def cone(sag_mm: float, radius_mm: float) -> HeightFunction:
    """The paper's conical starting shape."""
    return lambda x, y: sag_mm * np.hypot(x, y) / radius_mm


def v_fold(sag_mm: float, radius_mm: float) -> HeightFunction:
    """The paper's V-fold: two planes that meet in the y axis."""
    return lambda x, y: sag_mm * np.abs(x) / radius_mm + 0 * y
