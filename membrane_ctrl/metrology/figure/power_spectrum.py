"""Power spectral density of the deviation from the best sphere."""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.figure.quantities import Figure
from membrane_ctrl.model.arrays import FloatArray


@dataclass(frozen=True)
class PowerSpectrum:
    """Power spectral density of a deviation, mean over the directions; its sum over the plane is
    the mean square.

    Attributes
    ----------
    frequency_per_mm : (m,) array
    density_um2_mm2 : (m,) array
    sigma_um2_mm2 : (m,) array
        1 sigma as an estimate of a random surface's density.
    """

    frequency_per_mm: FloatArray
    density_um2_mm2: FloatArray
    sigma_um2_mm2: FloatArray


def power_spectrum(found: Figure, axis_mm: FloatArray, aperture_mm: float) -> PowerSpectrum:
    """Spectrum of the deviation from the best sphere under a radial Hann window.

    Cells without a measurement are filled by the fit of the terms.
    """
    x, y = np.meshgrid(axis_mm, axis_mm)
    r, step = np.hypot(x, y), float(axis_mm[1] - axis_mm[0])
    window = np.where(r < aperture_mm, np.cos(np.pi / 2 * np.minimum(r / aperture_mm, 1)) ** 2, 0.0)
    values = np.where(np.isfinite(found.deviation_um), found.deviation_um, found.smooth_um)
    values = window * (values - np.sum(window * values) / np.sum(window))
    density = np.abs(np.fft.rfft2(values)) ** 2 * step**2 / np.sum(window**2)
    f = np.hypot(
        *np.meshgrid(np.fft.rfftfreq(axis_mm.size, step), np.fft.fftfreq(axis_mm.size, step))
    )
    width = 1 / (2 * aperture_mm)
    ring = np.round(f / width).astype(np.int64).ravel()
    count = np.bincount(ring)
    known = np.flatnonzero((count > 0) & (np.arange(count.size) * width < 0.5 / step))[1:]
    mean = (np.bincount(ring, density.ravel()) / np.maximum(count, 1))[known]
    # neighbours in the plane share what the window smears: fewer are independent
    independent = np.sum(window**2) ** 2 / (window.size * np.sum(window**4))
    sigma = mean / np.sqrt(np.maximum(count[known] * independent, 1.0))
    return PowerSpectrum(width * known.astype(np.float64), mean, sigma)
