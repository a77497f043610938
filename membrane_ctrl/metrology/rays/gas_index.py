"""Refractive index of gases, for the gas between two films and the air of the room."""

from collections.abc import Callable
from types import MappingProxyType

from membrane_ctrl.config.front_film import FrontFilmConfig, GasName

_WAVE_PER_UM2 = 1 / 0.55**2  # square of the wave number: green, the middle of a screen's white
_ZERO_K = 273.15
_STANDARD_PA = 101_325.0
_USUAL_GAUGE_PA = 600.0  # of a mirror whose pressure is not known


def _air(s: float) -> float:
    """Dry air with 450 ppm of CO2, from 15 to 0 deg C as an ideal gas (Ciddor, Appl. Opt. 35, 1566
    (1996), eq. 1).
    """
    at_15_c = 5_792_105e-8 / (238.0185 - s) + 167_917e-8 / (57.362 - s)
    return at_15_c * 288.15 / _ZERO_K


def _nitrogen(s: float) -> float:
    """Peck and Khanna, J. Opt. Soc. Am. 56, 1059 (1966)."""
    return 6.8552e-5 + 3.243157e-2 / (144 - s)


def _argon(s: float) -> float:
    """Peck and Fisher, J. Opt. Soc. Am. 54, 1362 (1964)."""
    return 6.786711e-5 + 3.0182943e-2 / (144 - s)


def _carbon_dioxide(s: float) -> float:
    """Bideau-Mehu et al., Opt. Commun. 9, 432 (1973)."""
    strong = 6.99100e-2 / (166.175 - s) + 1.44720e-3 / (79.609 - s)
    weak = 6.42941e-5 / (56.3064 - s) + 5.21306e-5 / (46.0196 - s)
    return strong + weak + 1.46847e-6 / (0.0584738 - s)


def _helium(s: float) -> float:
    """Mansfield and Peck, J. Opt. Soc. Am. 59, 199 (1969)."""
    return 1.470091e-2 / (423.98 - s)


# Index - 1 at 0 deg C and 101325 Pa, of the square of the wave number in 1/um2.
_DISPERSION: MappingProxyType[GasName, Callable[[float], float]] = MappingProxyType(
    {
        "air": _air,
        "nitrogen": _nitrogen,
        "argon": _argon,
        "carbon_dioxide": _carbon_dioxide,
        "helium": _helium,
    }
)


def compute_gas_excess(front: FrontFilmConfig, gauge_pa: float) -> float:
    """Index of the gas between the films less that of the air of the room.

    Parameters
    ----------
    front : FrontFilmConfig
        Gas, temperature and pressure of the room.
    gauge_pa : float
        Pressure of the gas over the room's; 0: unknown.
    """
    inside = _index_less_one(front.gas, front.ambient_pa + (gauge_pa or _USUAL_GAUGE_PA), front)
    return inside - _index_less_one("air", front.ambient_pa, front)


def _index_less_one(gas: GasName, pressure_pa: float, front: FrontFilmConfig) -> float:
    """Index - 1: it goes with the density of an ideal gas."""
    density = pressure_pa / _STANDARD_PA * _ZERO_K / front.gas_k
    return _DISPERSION[gas](_WAVE_PER_UM2) * density
