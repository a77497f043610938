"""The radial profile of a height map against Hencky's bowl, and the pressure that belongs to it."""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.film import hencky_bowl
from membrane_ctrl.model.arrays import FloatArray

# The paper's mirror film (PET, 50 µm): its sag gives the pressure, p = E t / a (w0 / (0.653 a))^3
_YOUNG_PA = 4.1e9
_THICKNESS_MM = 0.05
_CENTRE = 0.65344  # w0 / (a q^(1/3)) for a Poisson ratio of 0.3
_RINGS = 48


@dataclass(frozen=True)
class RadialProfile:
    """Height over radius.

    Attributes
    ----------
    radius_mm : (n,) array
        Middle of the rings.
    mean_mm : (n,) array
        Mean over azimuth.
    low_mm, high_mm : (n,) arrays
        Ends of the band that contains 95 % of the ring.
    hencky_mm : (n,) array
        Hencky's bowl of the sag that fits best.
    sag_mm : float
        That sag.
    pressure_pa : float
        Gauge pressure that bends the paper's film to that sag.
    """

    radius_mm: FloatArray
    mean_mm: FloatArray
    low_mm: FloatArray
    high_mm: FloatArray
    hencky_mm: FloatArray
    sag_mm: float
    pressure_pa: float


def radial_profile(axis_mm: FloatArray, height_mm: FloatArray, rim_mm: float) -> RadialProfile:
    """Profile of a height map along the radius.

    Parameters
    ----------
    axis_mm : (n,) array
        Middle of the cells, along x as along y.
    height_mm : (n, n) array
        Height; NaN where not measured.
    rim_mm : float
        Radius of the film's rim.

    Returns
    -------
    RadialProfile
        Without rings in which nothing was measured.
    """
    x, y = np.meshgrid(axis_mm, axis_mm)
    seen = np.isfinite(height_mm)
    r = np.hypot(x[seen], y[seen])
    height = height_mm[seen]

    # The bowl's sag by least squares, with a free offset: a dimple at the vertex must not shift the
    # whole comparison.
    shape = hencky_bowl.bowl_profile(r / rim_mm)
    shape_mean = shape.mean()
    height_mean = height.mean()
    shape_rest = shape - shape_mean
    sag = float(np.sum(shape_rest * (height - height_mean)) / np.sum(shape_rest**2))

    # Mean and 95 % band of each ring: of the difference from the bowl, because across a ring the
    # bowl itself climbs by millimetres.
    over_bowl = height - (sag * shape_rest + height_mean)
    edges = np.linspace(0.0, float(r.max()), _RINGS + 1)
    ring = np.clip(np.digitize(r, edges) - 1, 0, _RINGS - 1)
    rows = []
    for k in range(_RINGS):
        inside = ring == k
        if np.any(inside):
            low, high = np.percentile(over_bowl[inside], [2.5, 97.5])
            rows.append((r[inside].mean(), over_bowl[inside].mean(), low, high))
    radius, mean, low, high = np.array(rows).T

    # The bowl at these radii, and the band about it.
    bowl = sag * hencky_bowl.bowl_profile(radius / rim_mm) + height_mean - sag * shape_mean
    return RadialProfile(
        radius_mm=radius,
        mean_mm=bowl + mean,
        low_mm=bowl + low,
        high_mm=bowl + high,
        hencky_mm=bowl,
        sag_mm=sag,
        pressure_pa=pressure_pa(sag, rim_mm),
    )


def pressure_pa(sag_mm: float, rim_mm: float) -> float:
    """Gauge pressure under a film of the paper's kind, by Hencky: (w0 / (0.65344 a))^3 E t / a.

    Parameters
    ----------
    sag_mm : float
        w0, above the rim.
    rim_mm : float
        a, radius of the rim.
    """
    return (sag_mm / (_CENTRE * rim_mm)) ** 3 * _YOUNG_PA * _THICKNESS_MM / rim_mm
