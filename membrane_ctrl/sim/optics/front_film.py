"""The clear film in front of the simulated mirror, with the gas between them."""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.config.front_film import FrontFilmConfig, GasName
from membrane_ctrl.config.optics import MirrorConfig
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.sim.optics.film_shape import FilmShape, typical_film

MIRROR_REFLECTANCE = 0.88  # of evaporated aluminium
_GAS_CONSTANT = 8.314462618  # J/(mol K)
# Gladstone and Dale: index - 1 over the density, m3/kg, at 550 nm; and molar masses, kg/mol.
_REFRACTION_M3_PER_KG: dict[GasName, float] = {
    "air": 2.268e-4,
    "nitrogen": 2.392e-4,
    "argon": 1.583e-4,
    "carbon_dioxide": 2.277e-4,
    "helium": 1.957e-4,
}
_MOLAR_MASS_KG: dict[GasName, float] = {
    "air": 0.0289647,
    "nitrogen": 0.0280134,
    "argon": 0.039948,
    "carbon_dioxide": 0.0440095,
    "helium": 0.0040026,
}
_USUAL_PRESSURE_PA = 600.0  # of a mirror whose gauge pressure is not known
_FRONT_STREAM = 77  # of random numbers: the film's errors are not those of the mirror's film


@dataclass(frozen=True, slots=True)
class FrontFilm:
    """A clear film that bulges towards the camera.

    Attributes
    ----------
    shape : FilmShape
        Depth of the film below its vertex; its sag is the bulge at displacement 0.
    sag_mm : float
        Depth of the mirror at displacement 0.
    rim_gap_mm : float
        Distance of its rim in front of the mirror's.
    thickness_mm : float
        Thickness of the film.
    index : float
        Refractive index of the film.
    gas_excess : float
        Index of the gas inside less that of the room's air.
    """

    shape: FilmShape
    sag_mm: float
    rim_gap_mm: float
    thickness_mm: float
    index: float
    gas_excess: float

    def bulge_at_mm(self, sag_mm: float) -> float:
        """Height of its vertex above its rim when the mirror is `sag_mm` deep.

        Both films go with the cube root of the pressure.
        """
        return self.shape.sag_mm * sag_mm / self.sag_mm

    @property
    def reflectance(self) -> float:
        """Of both faces together, at normal incidence, without interference."""
        of_face = ((self.index - 1.0) / (self.index + 1.0)) ** 2
        return 2.0 * of_face / (1.0 + of_face)

    @property
    def transmittance(self) -> float:
        """Share of the light that passes through the film once."""
        return 1.0 - self.reflectance

    @property
    def image_shares(self) -> tuple[float, float]:
        """Light of the two further images of the screen, over that of a mirror without the film.

        The first is reflected by the film's outside. The second goes from the mirror to the film's
        inside and by the mirror again.
        """
        outside = self.reflectance / MIRROR_REFLECTANCE
        inside = self.transmittance**2 * MIRROR_REFLECTANCE * self.reflectance
        return outside, inside


def make_front_film(mirror: MirrorConfig, sag_mm: float, seed: int | None) -> FrontFilm | None:
    """The film of a configuration; None for a mirror of a single film.

    Parameters
    ----------
    mirror : MirrorConfig
        The mirror with its front film.
    sag_mm : float
        Depth of the simulated mirror at displacement 0.
    seed : int or None
        Of the errors of mounting and of the stated bulge; None: a film without errors.
    """
    stated = mirror.front_film
    if stated is None:
        return None
    bulge_mm = stated.bulge_mm
    shape = FilmShape(bulge_mm, mirror.radius_mm)
    if seed is not None:
        rng = np.random.default_rng((_FRONT_STREAM, seed))
        bulge_mm += stated.bulge_sigma_mm * float(rng.standard_normal())
        shape = typical_film(bulge_mm, mirror.radius_mm, int(rng.integers(1 << 31)))
    return FrontFilm(
        shape,
        sag_mm,
        stated.rim_gap_mm,
        1e-3 * stated.thickness_um,
        stated.index,
        gas_excess_of(stated, mirror.pressure_pa or _USUAL_PRESSURE_PA),
    )


def gas_excess_of(stated: FrontFilmConfig, gauge_pa: float) -> float:
    """Return the index of the gas between the films less that of the air outside, by their
    densities.

    Parameters
    ----------
    stated : FrontFilmConfig
        The gas, its temperature, and the pressure of the room.
    gauge_pa : float
        Pressure of the gas above the room's.
    """
    inside = _index_less_one(stated.gas, stated.ambient_pa + gauge_pa, stated.gas_k)
    return inside - _index_less_one("air", stated.ambient_pa, stated.gas_k)


def _index_less_one(gas: GasName, pressure_pa: float, kelvin: float) -> float:
    density = pressure_pa * _MOLAR_MASS_KG[gas] / (_GAS_CONSTANT * kelvin)
    return _REFRACTION_M3_PER_KG[gas] * density


def film_constants(front: FrontFilm) -> FloatArray:
    """Thickness in mm, index of the film and of the gas, over the air's: for the kernel."""
    return np.array([front.thickness_mm, front.index, 1.0 + front.gas_excess])
