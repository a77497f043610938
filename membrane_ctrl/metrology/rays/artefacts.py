"""What a calibration may see instead of the film: a flat, a sphere, or the screen itself."""

import math
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.rays.height_projection import height_projection
from membrane_ctrl.model.arrays import FloatArray


@dataclass(frozen=True)
class Artefact:
    """A surface of known form that stands in the mirror's place: a flat, or a concave sphere.

    Attributes
    ----------
    curvature_per_mm : float
        Curvature at the vertex; 0: flat.
    curvature_sigma_per_mm : float
    form_sigma_mm : float
        Standard uncertainty of each Zernike term of its form.
    vertex_mm : float
        Height of its vertex in world.
    vertex_sigma_mm : float
    radius_mm : float
        Radius of its disc.
    """

    curvature_per_mm: float
    curvature_sigma_per_mm: float
    form_sigma_mm: float
    vertex_mm: float
    vertex_sigma_mm: float
    radius_mm: float

    @property
    def name(self) -> str:
        """For a person."""
        if self.curvature_per_mm:
            return "sphere"
        return "flat"

    @property
    def doubt(self) -> str:
        """What is wrong if it disagrees with the other sets."""
        return (
            f"it is not the {self.name} that its file states, it stood elsewhere, or it was out "
            "of focus"
        )

    def terms_mm(self, tilt_x: float = 0.0, tilt_y: float = 0.0) -> FloatArray:
        """Parameters (parameters,) of the surface with these slopes at its vertex, and its terms
        beyond the fit's.
        """
        x, y, onto = height_projection()
        return np.asarray(onto @ self._heights_mm(self.curvature_per_mm, x, y, tilt_x, tilt_y))

    def covariance_mm2(self) -> FloatArray:
        """Covariance of `terms_mm` by curvature and form."""
        x, y, onto = height_projection()
        step = 1e-9  # per mm: the sag is linear in so little
        change = self._heights_mm(self.curvature_per_mm + step, x, y) - self._heights_mm(
            self.curvature_per_mm, x, y
        )
        by_curvature = onto @ change / step * self.curvature_sigma_per_mm
        return np.asarray(
            np.outer(by_curvature, by_curvature) + self.form_sigma_mm**2 * np.eye(len(onto))
        )

    def _heights_mm(
        self,
        curvature: float,
        x: FloatArray,
        y: FloatArray,
        tilt_x: float = 0.0,
        tilt_y: float = 0.0,
    ) -> FloatArray:
        """The sphere c |P|^2 = 2 n P through the origin with the normal n, at points (n,) of the
        unit disc.
        """
        x, y = x * self.radius_mm, y * self.radius_mm
        across = 1 / math.sqrt(1 + tilt_x**2 + tilt_y**2)
        q = curvature * (x * x + y * y) + 2 * across * (tilt_x * x + tilt_y * y)
        return np.asarray(q / (across + np.sqrt(across**2 - curvature * q)))


@dataclass(frozen=True)
class SeenScreen:
    """The screen itself, seen without the mirror, anywhere: it shows lens and bow.

    Attributes
    ----------
    origin_mm : (3,) array
        Approximate O' in the camera's frame.
    axes : (3, 3) array
        Rows: s_x, s_y and the normal in the camera's frame.
    """

    origin_mm: FloatArray
    axes: FloatArray
    name = "screen"
    doubt = "it shows another lens, another screen, or it was out of focus"
