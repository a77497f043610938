"""What a calibration may see instead of the film: a flat, a sphere, or the screen itself."""

import math
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.rays.height_projection import height_projection
from membrane_ctrl.model.arrays import FloatArray

_CURVATURE_STEP_PER_MM = 1e-9  # the sag is linear in so little


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
        """Return the artefact as parameters of the surface fit.

        Parameters
        ----------
        tilt_x, tilt_y : float
            Slopes at its vertex.

        Returns
        -------
        (k,) array
            Parameters of the surface in mm, followed by its terms beyond the fit's.
        """
        x, y, onto = height_projection()
        return np.asarray(onto @ self._heights_mm(self.curvature_per_mm, x, y, tilt_x, tilt_y))

    def covariance_mm2(self) -> FloatArray:
        """Covariance of `terms_mm` by curvature and form."""
        x, y, onto = height_projection()
        stated_mm = self._heights_mm(self.curvature_per_mm, x, y)
        bent_mm = self._heights_mm(self.curvature_per_mm + _CURVATURE_STEP_PER_MM, x, y)
        change = bent_mm - stated_mm
        by_curvature = onto @ change / _CURVATURE_STEP_PER_MM * self.curvature_sigma_per_mm
        by_form = self.form_sigma_mm**2 * np.eye(len(onto))
        return np.asarray(np.outer(by_curvature, by_curvature) + by_form)

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
        x_mm = x * self.radius_mm
        y_mm = y * self.radius_mm

        # With P = (x, y, z) and n = across (-tilt_x, -tilt_y, 1): c z^2 - 2 across z + q = 0, of
        # which the root near the origin is q / (across + root), stable for c = 0 too.
        across = 1 / math.sqrt(1 + tilt_x**2 + tilt_y**2)
        bent = curvature * (x_mm * x_mm + y_mm * y_mm)
        tilted = 2 * across * (tilt_x * x_mm + tilt_y * y_mm)
        q = bent + tilted
        root = np.sqrt(across**2 - curvature * q)
        return np.asarray(q / (across + root))


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
