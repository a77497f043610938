"""Films of a second world: Foeppl's energy in Cartesian coordinates, minimised over Chebyshev
polynomials.

It shares no code, no coordinates and no equation of equilibrium with the product: only the strain
of a film, e_ij = (u_i,j + u_j,i + w_i w_j) / 2, the plane-stress energy and the work of the
pressure. The ring's displacements are constraints at points of the ring, which may be of any form.
"""

from collections.abc import Callable

import numpy as np
from numpy.polynomial import chebyshev, legendre
from numpy.typing import NDArray
from scipy.linalg import svd

FloatArray = NDArray[np.float64]
Ring = Callable[[FloatArray], FloatArray]  # azimuth -> value


class MinimalFilm:
    """A film of radius 1 and E t = 1 under the load q."""

    def __init__(
        self,
        load: float,
        poisson: float,
        prestrain: Ring,
        height: Ring = np.zeros_like,
        wider: Ring = np.zeros_like,
        degree: int = 10,
    ) -> None:
        self._powers = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
        radial, weight = legendre.leggauss(degree + 10)
        r, angle = np.meshgrid(
            (radial + 1) / 2, 2 * np.pi * np.arange(2 * degree + 16) / (2 * degree + 16)
        )
        rim = 1 + wider(angle)  # r runs to the ring, wherever it is
        area = np.broadcast_to(weight / 2, r.shape) * r * rim**2 * 2 * np.pi / r.shape[0]
        x, y = (r * rim * np.cos(angle)).ravel(), (r * rim * np.sin(angle)).ravel()
        self._value, self._by_x, self._by_y = self._basis(x, y)
        self._area = area.ravel()
        self._load, self._poisson = load, poisson
        ring = 2 * np.pi * np.arange(4 * degree) / (4 * degree)
        edge = 1 + wider(ring)
        at_ring = self._basis(edge * np.cos(ring), edge * np.sin(ring))[0]
        outward = prestrain(ring) * edge
        wanted = np.concatenate([outward * np.cos(ring), outward * np.sin(ring), height(ring)])
        u, s, vt = svd(at_ring, full_matrices=True)
        rank = int(np.sum(s > 1e-9 * s[0]))
        free, solve = vt[rank:].T, vt[:rank].T / s[:rank] @ u[:, :rank].T
        self._inside, self._free = free, np.kron(np.eye(3), free)
        start = np.concatenate([solve @ part for part in np.split(wanted, 3)])
        self._unknowns = self._newton(start)

    def _basis(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        top = self._powers[-1][0]
        eye = np.eye(top + 1)
        tx, ty = (chebyshev.chebval(np.clip(c, -1.2, 1.2) / 1.2, eye) for c in (x, y))
        dx, dy = (chebyshev.chebval(c / 1.2, chebyshev.chebder(eye)) / 1.2 for c in (x, y))
        i, j = np.array(self._powers).T
        return (tx[i] * ty[j]).T, (dx[i] * ty[j]).T, (tx[i] * dy[j]).T

    def _newton(self, start: FloatArray) -> FloatArray:
        bx, by = self._by_x, self._by_y
        zero = np.zeros_like(bx)
        nu = self._poisson
        elastic = np.array([[1, nu, 0], [nu, 1, 0], [0, 0, (1 - nu) / 2]]) / (1 - nu**2)
        q = start.copy()
        n = bx.shape[1]
        # a paraboloid that meets the ring, so that the first film is not flat
        bowl = -0.5 * self._load ** (1 / 3)
        xy = np.linspace(-1, 1, 15)
        gx, gy = (part.ravel() for part in np.meshgrid(xy, xy))
        paraboloid = np.linalg.lstsq(
            self._basis(gx, gy)[0], bowl * (1 - gx**2 - gy**2), rcond=None
        )[0]
        q[2 * n :] += self._inside @ (self._inside.T @ paraboloid)
        for _ in range(60):
            wx, wy = bx @ q[2 * n :], by @ q[2 * n :]
            rows = [
                np.hstack([bx, zero, wx[:, None] * bx]),
                np.hstack([zero, by, wy[:, None] * by]),
                np.hstack([by, bx, wx[:, None] * by + wy[:, None] * bx]),
            ]
            linear = [bx @ q[:n], by @ q[n : 2 * n], by @ q[:n] + bx @ q[n : 2 * n]]
            strain = np.array([linear[0] + wx**2 / 2, linear[1] + wy**2 / 2, linear[2] + wx * wy])
            force = elastic @ strain
            gradient = sum(row.T @ (self._area * f) for row, f in zip(rows, force, strict=True))
            gradient[2 * n :] += self._load * (self._value.T @ self._area)
            matrix = sum(
                elastic[a, b] * rows[a].T @ (self._area[:, None] * rows[b])
                for a in range(3)
                for b in range(3)
                if elastic[a, b]
            )
            tension = (
                bx.T @ ((self._area * force[0])[:, None] * bx)
                + by.T @ ((self._area * force[1])[:, None] * by)
                + bx.T @ ((self._area * force[2])[:, None] * by)
                + by.T @ ((self._area * force[2])[:, None] * bx)
            )
            matrix[2 * n :, 2 * n :] += tension
            inner = self._free.T @ matrix @ self._free
            move = self._free @ np.linalg.lstsq(inner, -(self._free.T @ gradient), rcond=1e-13)[0]
            q = q + move
            if np.abs(self._value @ move[2 * n :]).max() < 1e-10:
                return q
        raise ArithmeticError("the film of the second world does not settle")

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Height above the vertex, in radii."""
        n = len(self._powers)
        w = self._unknowns[2 * n :]
        return self._basis(x, y)[0] @ w - self._basis(np.zeros(1), np.zeros(1))[0] @ w
