"""The inflated film as a surface in the world, at any displacement of its centre, and its truth.

World: millimetres, origin at the vertex at displacement 0, z out of the reflective side. The ring
does not move; at displacement d the centre is at z = -d.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from math import factorial

import numpy as np
from numpy.typing import NDArray

from tests.worlds.second_optics.film import Field, FilmSolver, Material, Ring, Shape
from tests.worlds.second_optics.seat import Seat

FloatArray = NDArray[np.float64]

NODE_UM = 400.0  # between solved displacements; a parabola through three gives any other
ZERNIKE_TERMS = 36


@dataclass(frozen=True)
class Wrinkles:
    """Radial wrinkles at the ring, added to the height.

    Attributes
    ----------
    amplitude_um : float
        At the ring.
    count : int
        Waves around the ring.
    depth_mm : float
        Distance from the ring at which the amplitude has fallen to 1/e.
    """

    amplitude_um: float
    count: int = 48
    depth_mm: float = 25.0


@dataclass
class Mirror:
    """A film of some material in a ring, inflated to a sag.

    Attributes
    ----------
    sag_mm : float
        Depth of the centre below the mean height of the ring at displacement 0.
    """

    sag_mm: float = 37.1
    radius_mm: float = 500.0
    material: Material = field(default_factory=Material)
    ring: Ring = field(default_factory=Ring)
    wrinkles: Wrinkles | None = None
    seat: Seat | None = None  # None: the mirror stands as usual

    def __post_init__(self) -> None:
        self._solved: dict[int, tuple[Shape, FloatArray]] = {}

    def without_wrinkles(self) -> Mirror:
        """The same film without its wrinkles, which no term of a fit represents."""
        if self.wrinkles is None:
            return self
        smooth = replace(self, wrinkles=None)
        smooth._solved = self._solved  # wrinkles are no part of the equilibrium
        return smooth

    def seated(self, seat: Seat) -> Mirror:
        """The same film in a mirror that stands otherwise."""
        other = replace(self, seat=seat)
        other._solved = self._solved
        return other

    def own_axes(self, xy: FloatArray) -> FloatArray:
        """Places (2, n) of the world in the axes of the mirror, about."""
        return xy if self.seat is None else self.seat.unturned(xy)

    def load(self, displacement_um: float = 0.0) -> float:
        """Pressure over E1 t / R."""
        return self._shape(displacement_um).load

    def position_mm(
        self, x: FloatArray, y: FloatArray, displacement_um: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Places (3, n) in the world of material points in radii, and their derivatives by each."""
        if self.seat is not None:
            displacement_um = displacement_um + 1e3 * self.seat.raised_mm
        shape = self._shape(displacement_um)
        u, u_x, u_y = shape.u.values(x, y)
        v, v_x, v_y = shape.v.values(x, y)
        w, w_x, w_y = shape.w.values(x, y)
        if self.wrinkles is not None:
            added = self._wrinkled(self.wrinkles, x, y)
            w, w_x, w_y = w + added[0], w_x + added[1], w_y + added[2]
        scale = self.radius_mm
        place = scale * np.stack([x + u, y + v, w]) + np.array([[0.0], [0.0], [self.sag_mm]])
        along_x = scale * np.stack([1 + u_x, v_x, w_x])
        along_y = scale * np.stack([u_y, 1 + v_y, w_y])
        if self.seat is None:
            return place, along_x, along_y
        turn = self.seat.rotation()
        place = self.seat.places(place, -1e-3 * displacement_um)
        return place, turn @ along_x, turn @ along_y

    def height_mm(self, x_mm: FloatArray, y_mm: FloatArray, displacement_um: float) -> FloatArray:
        """Height above the centre of the film at places of the world."""
        wanted = np.stack(np.atleast_1d(x_mm, y_mm))
        place, _, _ = self._place_over(wanted, displacement_um)
        return np.asarray(place[2] - self._centre_height_mm(displacement_um))

    def surface_mm(
        self, x_mm: FloatArray, y_mm: FloatArray, displacement_um: float
    ) -> tuple[FloatArray, FloatArray]:
        """Height as `height_mm`, and normals (3, n) with z = 1."""
        wanted = np.stack(np.atleast_1d(x_mm, y_mm))
        place, along_x, along_y = self._place_over(wanted, displacement_um)
        normal = np.cross(along_x, along_y, axis=0)
        return place[2] - self._centre_height_mm(displacement_um), normal / normal[2]

    def _centre_height_mm(self, displacement_um: float) -> float:
        """Height of the centre in the world."""
        zero = np.zeros(1)
        if self.seat is None:
            centre, _, _ = self.position_mm(zero, zero, displacement_um)
        else:
            centre, _, _ = self._place_over(np.zeros((2, 1)), displacement_um)
        return float(centre[2, 0])

    def _place_over(
        self, wanted: FloatArray, displacement_um: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The film's points (3, n) at places (2, n) of the world, with their derivatives by the
        material: Newton's method.
        """
        material = self.own_axes(wanted) / self.radius_mm
        for _ in range(40):
            found = self.position_mm(material[0], material[1], displacement_um)
            off = wanted - found[0][:2]
            if np.abs(off).max() < 1e-10:
                break
            (xx, yx, _), (xy, yy, _) = found[1], found[2]
            solved = np.stack([yy * off[0] - xy * off[1], xx * off[1] - yx * off[0]])
            material = material + solved / (xx * yy - xy * yx)
        return found

    def rim_sag_um(self, displacement_um: float) -> float:
        """Mean height of the ring above the centre."""
        angle = 2 * np.pi * np.arange(180) / 180
        x_mm, y_mm = self.radius_mm * np.cos(angle), self.radius_mm * np.sin(angle)
        return 1e3 * float(self.height_mm(x_mm, y_mm, displacement_um).mean())

    def zernike_um(self, displacement_um: float) -> FloatArray:
        """Noll's terms 1..36 of the height over the whole disc: integrals, not a fit."""
        nodes, weights = np.polynomial.legendre.leggauss(24)
        square, angle = np.meshgrid((nodes + 1) / 2, 2 * np.pi * np.arange(96) / 96, indexing="ij")
        rho = np.sqrt(square)
        x_mm, y_mm = self.radius_mm * rho * np.cos(angle), self.radius_mm * rho * np.sin(angle)
        height_um = 1e3 * self.height_mm(x_mm.ravel(), y_mm.ravel(), displacement_um)
        height_um = height_um.reshape(rho.shape)
        mean = weights[:, None] / 2 / angle.shape[1]
        terms = [
            float(np.sum(mean * height_um * zernike(noll, rho, angle)))
            for noll in range(1, ZERNIKE_TERMS + 1)
        ]
        return np.array(terms)

    @cached_property
    def _solver(self) -> FilmSolver:
        return FilmSolver(self.material, self.ring)

    def _node(self, index: int) -> Shape:
        if index not in self._solved:
            near = min(self._solved, key=lambda known: abs(known - index), default=None)
            start = None if near is None else self._solved[near][1]
            depth_mm = self.sag_mm + 1e-3 * NODE_UM * index
            self._solved[index] = self._solver.solve(depth_mm / self.radius_mm, start)
        return self._solved[index][0]

    def _shape(self, displacement_um: float) -> Shape:
        """Displacements by a parabola through the nearest three solved equilibria."""
        middle = round(displacement_um / NODE_UM)
        f = displacement_um / NODE_UM - middle
        if abs(f) < 1e-9:
            return self._node(middle)
        shares = (f * (f - 1) / 2, (1 - f) * (1 + f), f * (f + 1) / 2)
        shapes = [self._node(middle + k) for k in (-1, 0, 1)]

        def mixed(name: str) -> Field:
            parts = zip(shares, shapes, strict=True)
            return Field(sum(share * getattr(s, name).coefficients for share, s in parts))

        load = sum(share * shape.load for share, shape in zip(shares, shapes, strict=True))
        return Shape(mixed("u"), mixed("v"), mixed("w"), load)

    def _wrinkled(
        self, wrinkles: Wrinkles, x: FloatArray, y: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Value and derivatives of the wrinkles, in radii."""
        radius = np.maximum(np.hypot(x, y), 1e-6)
        angle = np.arctan2(y, x)
        depth = wrinkles.depth_mm / self.radius_mm
        envelope = np.exp(np.minimum(radius - 1, 0.1) / depth)
        amplitude = 1e-3 * wrinkles.amplitude_um / self.radius_mm
        wave, turned = np.cos(wrinkles.count * angle), np.sin(wrinkles.count * angle)
        by_radius = amplitude * envelope * wave / depth
        by_angle = -amplitude * envelope * wrinkles.count * turned
        cosine, sine = x / radius, y / radius
        return (
            amplitude * envelope * wave,
            by_radius * cosine - by_angle * sine / radius,
            by_radius * sine + by_angle * cosine / radius,
        )


def zernike(noll: int, rho: FloatArray, angle: FloatArray) -> FloatArray:
    """Noll's term of unit RMS over the unit disc; even indices are cosines, odd ones sines."""
    order = 0
    while (order + 1) * (order + 2) // 2 < noll:
        order += 1
    rank = noll - order * (order + 1) // 2 - 1
    wave = 2 * ((rank + 1) // 2) if order % 2 == 0 else 2 * (rank // 2) + 1
    radial = np.zeros_like(rho)
    for s in range((order - wave) // 2 + 1):
        factor = (-1) ** s * factorial(order - s) / factorial(s)
        lower = factorial((order + wave) // 2 - s) * factorial((order - wave) // 2 - s)
        radial = radial + factor / lower * rho ** (order - 2 * s)
    if wave == 0:
        return np.asarray(np.sqrt(order + 1) * radial)
    turn = np.cos(wave * angle) if noll % 2 == 0 else np.sin(wave * angle)
    return np.asarray(np.sqrt(2 * (order + 1)) * radial * turn)


def drawn_mirror(rng: np.random.Generator, orthotropic: bool, sag_mm: float = 37.1) -> Mirror:
    """A mirror with random material, ring and thickness."""
    ratio = float(rng.uniform(0.88, 0.98)) if orthotropic else 1.0
    stretched = float(10 ** rng.uniform(-5, -3.3) * rng.integers(2))
    uneven = float(rng.uniform(-0.3, 0.3)) * stretched * orthotropic
    material = Material(
        ratio=ratio,
        poisson=float(rng.uniform(0.25, 0.42)),
        direction_rad=float(rng.uniform(0, np.pi)),
        prestrain=(stretched + uneven, stretched - uneven, 0.0),
        thickness_slope=(float(rng.normal(0, 2e-3)), float(rng.normal(0, 2e-3))),
    )
    waves = {m: tuple(rng.normal(0, 1e-3 / m**1.5, 2).tolist()) for m in (2, 3, 4, 5)}
    wider = {2: tuple(rng.normal(0, 2e-5, 2).tolist())}
    return Mirror(sag_mm, 500.0, material, Ring(waves, wider))
