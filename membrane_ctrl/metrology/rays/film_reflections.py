"""Where a cushion's front film shows the screen a second and a third time.

By the film's outside, and by mirror, film and mirror, the camera sees the pattern in a part of
the mirror. Places on the screen are smooth functions of the place on the mirror, and nearly linear
in the film's errors of form: they are traced once and kept as polynomials.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import polynomial as series

from membrane_ctrl.config.schema import OpticsConfig, PatternConfig
from membrane_ctrl.metrology.rays.cushion import FRONT_ERRORS, CushionBench
from membrane_ctrl.metrology.rays.gas_lens import evaluate_tables
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.rays.surface import Surface
from membrane_ctrl.model.arrays import BoolArray, FloatArray

_DEGREE = 6  # of the polynomials: they are exact to 0.01 mm on the screen
_COARSE_PLACES = 3000  # on the mirror, to find the part that shows the pattern
_PLACES = 300  # in that part
_PLACING_STEPS = 6  # of rays to the mirror: each contracts by slope times inclination
_PAD = 1.1  # radius of the traced part over that of the part that shows the pattern
# Steps of the errors of form, for the derivatives: mm, mrad, mrad, mm, mm, mm.
_STEPS = (0.5, 0.5, 0.5, 0.2, 0.2, 0.5)
# How far beside the pattern, on the screen, a film with errors may still show it: 2 mrad of tilt,
# 1 mm of bulge.
MARGIN_MM = 15.0


@dataclass(frozen=True)
class ReflectionMap:
    """Places on the screen of both images, by the place on the mirror.

    Attributes
    ----------
    tables : (1 + FRONT_ERRORS, 4, degree + 1, degree + 1) array
        Polynomials of s_x and s_y of the first and of the second image, and their changes by a unit
        of each error of form.
    errors : (FRONT_ERRORS,) array
        Errors of form at which they were traced.
    centre_mm : (float, float)
        Middle of the traced part of the mirror.
    radius_mm : float
        Radius of that part.
    half_side_mm : float
        Half the side of the pattern.
    """

    tables: FloatArray
    errors: FloatArray
    centre_mm: tuple[float, float]
    radius_mm: float
    half_side_mm: float

    def is_traced(self, position_mm: FloatArray) -> BoolArray:
        """Which places (2, n) of the mirror are in the traced part."""
        x, y = self._from_centre(position_mm)
        return np.asarray(x * x + y * y <= 1)

    def find_images_mm(self, position_mm: FloatArray, errors: FloatArray) -> FloatArray:
        """Places of both images on the screen.

        Parameters
        ----------
        position_mm : (2, n) array
            Traced places of the mirror.
        errors : (FRONT_ERRORS,) array
            Errors of form of the front film.

        Returns
        -------
        (2, 2, n) array
            s_x and s_y of the image by the film's outside, and of that by mirror, film and mirror.
        """
        table = self.tables[0] + np.tensordot(errors - self.errors, self.tables[1:], axes=1)
        return self._evaluate(position_mm, table).reshape(2, 2, -1)

    def find_derivatives_mm(self, position_mm: FloatArray) -> FloatArray:
        """Changes (FRONT_ERRORS, 2, 2, n) of these places by a unit of each error."""
        changes = [self._evaluate(position_mm, table) for table in self.tables[1:]]
        return np.stack(changes).reshape(FRONT_ERRORS, 2, 2, -1)

    def shows_pattern(self, position_mm: FloatArray) -> BoolArray:
        """Which places (2, n) of the mirror may show an image of the pattern."""
        out = self.is_traced(position_mm)
        images_mm = self.find_images_mm(position_mm[:, out], self.errors)
        reach_mm = self.half_side_mm + MARGIN_MM
        out[out] = np.any(np.all(np.abs(images_mm) < reach_mm, axis=1), axis=0)
        return out

    def _from_centre(self, position_mm: FloatArray) -> FloatArray:
        from_centre_mm = position_mm - np.array(self.centre_mm)[:, None]
        return np.asarray(from_centre_mm / self.radius_mm)

    def _evaluate(self, position_mm: FloatArray, table: FloatArray) -> FloatArray:
        x, y = self._from_centre(position_mm)
        out = np.empty((len(table), x.size))
        evaluate_tables(np.ascontiguousarray(x), np.ascontiguousarray(y), table, out)
        return out


def map_reflections(
    geometry: Geometry,
    mirror: Surface,
    vertex_z_mm: float,
    pattern: PatternConfig,
    errors: FloatArray | None = None,
) -> ReflectionMap | None:
    """Trace the images of the screen in the front film of a bench.

    Parameters
    ----------
    geometry : Geometry
        The bench.
    mirror : Surface
        Its film.
    vertex_z_mm : float
        Height of the vertex.
    pattern : PatternConfig
        The pattern on the screen.
    errors : (FRONT_ERRORS,) array, optional
        Errors of form of the front film.

    Returns
    -------
    ReflectionMap or None
        None for a single film, and if no part of the mirror shows the pattern again.
    """
    cushion = geometry.cushion
    if cushion is None:
        return None
    if errors is None:
        errors = np.zeros(FRONT_ERRORS)
    bench = CushionBench(
        replace(cushion, errors=tuple(errors.tolist())),
        mirror,
        vertex_z_mm,
        geometry.screen_origin_mm,
        geometry.screen_axes,
    )

    # The part of the mirror that shows the pattern again.
    half_side_mm = pattern.periods * pattern.period_mm / 2
    everywhere = mirror.radius_mm * _spread_places(_COARSE_PLACES)
    images_mm = _trace_at(bench, geometry.pinhole_mm, everywhere)
    reach_mm = half_side_mm + MARGIN_MM
    shows = np.any(np.all(np.abs(images_mm) < reach_mm, axis=1), axis=0)
    if not shows.any():
        return None
    # A disc around it, wider by the spacing of the coarse places.
    low = everywhere[:, shows].min(axis=1)
    high = everywhere[:, shows].max(axis=1)
    centre = (low + high) / 2
    spacing_mm = mirror.radius_mm * np.sqrt(np.pi / _COARSE_PLACES)
    radius_mm = float(_PAD * (np.hypot(*(high - low)) / 2 + spacing_mm))

    # Polynomials there, and their changes by the errors of form.
    unit = _spread_places(_PLACES)
    places = centre[:, None] + radius_mm * unit
    tables = [_fit_images(unit, _trace_at(bench, geometry.pinhole_mm, places))]
    for step in np.diag(_STEPS):
        there = replace(bench, cushion=replace(cushion, errors=tuple((errors + step).tolist())))
        moved = _fit_images(unit, _trace_at(there, geometry.pinhole_mm, places))
        tables.append((moved - tables[0]) / step.sum())
    return ReflectionMap(
        np.stack(tables), errors, (float(centre[0]), float(centre[1])), radius_mm, half_side_mm
    )


def find_reflecting_rays(geometry: Geometry, optics: OpticsConfig, rays: FloatArray) -> BoolArray:
    """Which rays (3, n) of the camera may show the pattern by a front film.

    Parameters
    ----------
    geometry : Geometry
        The bench.
    optics : OpticsConfig
        Its mirror and pattern.
    rays : (3, n) array
        Unit vectors; NaN for a ray that does not exist.

    Returns
    -------
    (n,) bool array
    """
    radius_mm = optics.mirror.radius_mm
    sag_mm = optics.mirror.sag_mm
    mirror = Surface.hencky_bowl(sag_mm, radius_mm)
    images = map_reflections(geometry, mirror, 0.0, optics.pattern)
    if images is None:
        return np.zeros(rays.shape[1], bool)

    # Where the rays meet a paraboloid: less than a millimetre beside the bowl.
    position_mm = np.zeros((2, rays.shape[1]))
    for _ in range(_PLACING_STEPS):
        height_mm = sag_mm * np.sum(np.square(position_mm / radius_mm), axis=0)
        t = (np.minimum(height_mm, 2 * sag_mm) - geometry.pinhole_mm[2]) / rays[2]
        position_mm = geometry.pinhole_mm[:2, None] + t * rays[:2]
    return images.shows_pattern(position_mm)


def _spread_places(count: int) -> FloatArray:
    """Places (2, n) spread evenly over the unit disc: a sunflower."""
    # Radii of equal areas, and an angle that grows by the golden one.
    k = np.arange(count)
    rho = np.sqrt((k + 0.5) / count)
    theta = k * np.pi * (3 - np.sqrt(5))
    return np.stack([rho * np.cos(theta), rho * np.sin(theta)])


def _trace_at(bench: CushionBench, pinhole_mm: FloatArray, place_mm: FloatArray) -> FloatArray:
    """Images (2, 2, n) of the screen on rays by places (2, n) of the mirror."""
    height_mm = bench.vertex_z_mm + bench.mirror.height(place_mm[0], place_mm[1])
    start = np.repeat(pinhole_mm[:, None], place_mm.shape[1], axis=1)
    rays = np.vstack([place_mm, height_mm]) - start
    return bench.trace_images(start, rays / np.linalg.norm(rays, axis=0))


def _fit_images(unit: FloatArray, images_mm: FloatArray) -> FloatArray:
    """Polynomials (4, degree + 1, degree + 1) through images at places (2, n) of the unit disc; an
    image that is not there is far beside the screen.
    """
    # Columns x^i y^j with i + j up to the degree.
    chosen = [(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]
    powers = series.polyvander2d(unit[0], unit[1], [_DEGREE, _DEGREE])
    powers = powers.reshape(unit.shape[1], _DEGREE + 1, -1)
    design = np.stack([powers[:, i, j] for i, j in chosen], axis=1)

    # Each coordinate of each image from the places that show it; elsewhere the rays miss.
    out = np.zeros((4, _DEGREE + 1, _DEGREE + 1))
    for row, values in zip(out, images_mm.reshape(4, -1), strict=True):
        known = np.isfinite(values)
        solved = np.linalg.lstsq(design[known], values[known], rcond=None)[0]
        for (i, j), value in zip(chosen, solved, strict=True):
            row[i, j] = value
    return out
