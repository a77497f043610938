"""What follows from a mirror's data: pressure, stress, limits, first gains, times.

The films follow Hencky's law (`metrology/film/film_law.py`): sag and volume go with the cube root
of the pressure p. The gas of volume V at the ambient pressure P follows the ideal gas law. With
dV / V = dp / (3 p) and dw / w = dp / (3 p) follow

    added gas      dG = dp ((P + p) V / (3 p) + V) / P
    barometer      dw/dP = -w / (P + 4 p)
    temperature    dw/dT = (w / T) / (1 + 3 p / (P + p))
"""

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from membrane_ctrl.commissioning.guide import thresholds
from membrane_ctrl.control.filling_time import find_fall_s, find_filling_s, find_leak_speed
from membrane_ctrl.metrology.film.film_law import Bowl, FilmLaw

AMBIENT_PA, ROOM_K = 101_325.0, 295.0
# Shares of the sag between setpoint and limits: the paper's mirror has -2000 and +500 µm of 37 mm
_BELOW_SHARE, _ABOVE_SHARE = 0.05395, 0.0135
# Pressure limit over the working pressure; the alarm acts before the board's own limit
_PRESSURE_SHARE = 1.25
_VENTED_PA = 100.0
_RINGS = 400  # of the integral of the volume


class MirrorFacts(BaseModel):
    """What a person states of a mirror."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    diameter_mm: Annotated[float, Field(ge=20, le=100_000)] = 1000.0
    sag_mm: Annotated[float, Field(ge=0.1, le=10_000)] = 37.1
    thickness_um: Annotated[float, Field(ge=1, le=1000)] = 50.0
    modulus_gpa: Annotated[float, Field(ge=0.01, le=500)] = 4.1
    poisson: Annotated[float, Field(ge=0, le=0.5)] = 0.3
    yield_mpa: Annotated[float, Field(ge=0.1, le=5000)] = 100.0
    back_thickness_um: Annotated[float, Field(ge=1, le=1000)] = 10.0
    pump_ml_per_s: Annotated[float, Field(gt=0, le=1e5)] = 6.0
    pump_proportional: bool = False
    """Whether the flow follows the command from 0 on, as that of a flow controller; a diaphragm
    pump starts at a fifth of its drive, and stalls below a seventh."""
    leak_time_constant_s: Annotated[float, Field(ge=10, le=1e8)] = 10_000.0
    relief_pa: Annotated[float, Field(ge=0, le=1e5)] = 0.0
    """0: no relief valve."""
    front_bulge_mm: Annotated[float, Field(ge=0, le=5000)] = 0.0
    """Height of a clear film through which the camera sees the mirror; 0: the camera sees it
    directly."""

    @property
    def radius_mm(self) -> float:
        """Of the ring."""
        return self.diameter_mm / 2.0


def find_other_bulge_mm(facts: MirrorFacts) -> float:
    """Height of the other film at the same pressure and modulus: sag goes with (p / t)^(1/3)."""
    ratio = facts.thickness_um / facts.back_thickness_um
    return float(facts.sag_mm * ratio ** (1.0 / 3.0))


# The paper's mirror: PET, its modulus measured there. Yield: tabulated for biaxial PET film.
PAPER_MIRROR = MirrorFacts()


@dataclass(frozen=True, slots=True)
class MirrorDesign:
    """What follows from a mirror's data."""

    pressure_pa: float
    front_stress_mpa: float  # at the working pressure
    back_stress_mpa: float
    stress_at_limit_mpa: float
    relief_most_pa: float  # a relief valve must open below this
    volume_l: float  # of gas
    um_per_ml: float  # motion of the centre
    flow_full_um_per_s: float
    leak_um_per_s: float
    gauge_max_pa: float
    displacement_min_um: float
    displacement_max_um: float
    filling_s: float
    lowering_s: float  # by the leak alone
    barometer_um_per_pa: float
    temperature_um_per_k: float

    @property
    def stress_mpa(self) -> float:
        """The larger stress of the two films at the working pressure."""
        return max(self.front_stress_mpa, self.back_stress_mpa)

    @property
    def pump_reserve(self) -> float:
        """Leak over the pump's full flow."""
        return self.leak_um_per_s / self.flow_full_um_per_s


def derive_design(facts: MirrorFacts) -> MirrorDesign:
    """Derive pressure, stress, limits and times from a mirror's data."""
    # The mirror's sag gives the pressure, and the pressure the other film's sag.
    front = FilmLaw(0.0, facts.poisson, _stiffness(facts, facts.thickness_um), facts.radius_mm)
    back = FilmLaw(0.0, facts.poisson, _stiffness(facts, facts.back_thickness_um), facts.radius_mm)
    front_bowl = front.with_sag(facts.sag_mm)
    pressure_pa = float(front.pressure_pa(front_bowl))
    back_bowl = back.under_pressure(pressure_pa)
    front_stress_mpa = _stress_mpa(front, front_bowl, facts.thickness_um)
    back_stress_mpa = _stress_mpa(back, back_bowl, facts.back_thickness_um)
    stress_mpa = max(front_stress_mpa, back_stress_mpa)

    # Gas: volume between the films, and the motion of the centre for a millilitre more of it.
    volume_m3 = _volume_m3(front_bowl) + _volume_m3(back_bowl)
    sag_um = 1e3 * facts.sag_mm
    total_pa = AMBIENT_PA + pressure_pa
    gas_m3_per_pa = (total_pa * volume_m3 / (3 * pressure_pa) + volume_m3) / AMBIENT_PA
    um_per_ml = 1e-6 * sag_um / (3 * pressure_pa) / gas_m3_per_pa
    flow_um_per_s = um_per_ml * facts.pump_ml_per_s
    leak_um_per_s = find_leak_speed(facts.sag_mm, facts.leak_time_constant_s)

    # Stress goes with p^(2/3).
    gauge_max_pa = _round_down(_PRESSURE_SHARE * pressure_pa)
    relief_share = facts.yield_mpa / (thresholds.RELIEF_MARGIN.value * stress_mpa)
    lowering_s = math.inf
    if pressure_pa > _VENTED_PA:
        lowering_s = find_fall_s(facts.sag_mm, pressure_pa, _VENTED_PA, leak_um_per_s)
    return MirrorDesign(
        pressure_pa=pressure_pa,
        front_stress_mpa=front_stress_mpa,
        back_stress_mpa=back_stress_mpa,
        stress_at_limit_mpa=stress_mpa * (gauge_max_pa / pressure_pa) ** (2 / 3),
        relief_most_pa=pressure_pa * relief_share**1.5,
        volume_l=1e3 * volume_m3,
        um_per_ml=um_per_ml,
        flow_full_um_per_s=flow_um_per_s,
        leak_um_per_s=leak_um_per_s,
        gauge_max_pa=gauge_max_pa,
        displacement_min_um=-_round_down(_BELOW_SHARE * sag_um),
        displacement_max_um=_round_down(_ABOVE_SHARE * sag_um),
        filling_s=find_filling_s(facts.sag_mm, flow_um_per_s, leak_um_per_s),
        lowering_s=lowering_s,
        barometer_um_per_pa=-sag_um / (AMBIENT_PA + 4 * pressure_pa),
        temperature_um_per_k=sag_um / ROOM_K / (1 + 3 * pressure_pa / total_pa),
    )


def _stiffness(facts: MirrorFacts, thickness_um: float) -> float:
    """E t in N/m."""
    return 1e9 * facts.modulus_gpa * 1e-6 * thickness_um


def _stress_mpa(film: FilmLaw, bowl: Bowl, thickness_um: float) -> float:
    """The largest stress of a bowl: at its centre, where radial and hoop stress are equal."""
    radial, _ = bowl.stresses(np.array([0.0]))
    force_n_per_m = float(radial[0]) * float(film.stiffness_n_per_m)
    return force_n_per_m / thickness_um


def _volume_m3(bowl: Bowl) -> float:
    """Volume under a bowl, by rings of equal area: pi a^2 times the mean depth."""
    rho = np.sqrt((np.arange(_RINGS) + 0.5) / _RINGS)
    mean_depth_mm = float(np.mean(float(bowl.sag_mm) - bowl.height_mm(rho)))
    return math.pi * bowl.radius_mm**2 * mean_depth_mm * 1e-9


def _round_down(value: float) -> float:
    """Two significant digits, for people; not above the value."""
    if value <= 0:
        return 0.0
    step = 10.0 ** (math.floor(math.log10(value)) - 1)
    return math.floor(value / step + 1e-9) * step
