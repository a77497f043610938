"""The nitrogen between the films: its amount, its temperature, and the resulting pressure.

Amounts and flows are in mL at reference conditions (nominal absolute pressure, 23 deg C), as a
mass-flow meter counts them: one mL is always the same number of molecules.
"""

from dataclasses import dataclass

from membrane_ctrl.sim.film import NOMINAL_PRESSURE_PA

STANDARD_AMBIENT_PA = 101_325.0
REFERENCE_K = 296.15  # 23 deg C, the standard laboratory atmosphere (ISO 291); 123 µm/K holds there
JOULE_PER_ML = (
    STANDARD_AMBIENT_PA + NOMINAL_PRESSURE_PA
) * 1e-6  # P V of a reference mL at 23 deg C
GAS_FOLLOWS_AIR_S = 12.0  # through 10 µm of PET (docs/explanation/physics.md, estimate)


@dataclass(slots=True)
class Gas:
    """State of the gas."""

    amount_ml: float  # gas between the films; flat films contain none
    temperature_k: float
    root_pa: float  # cube root of the gauge pressure

    @property
    def gauge_pressure_pa(self) -> float:
        """Pressure above ambient."""
        return self.root_pa**3

    def step(
        self, added_ml: float, follow: float, ambient_pa: float, air_k: float, volume: float
    ) -> None:
        """Advance by one time step: gas added (or lost), warmed towards the air, and back in
        balance with the films.

        Ideal gas in films of volume V = c p^(1/3): with u = p^(1/3), (ambient + u^3) c u = P V of
        the gas. The left side is convex and almost linear in u (u^3 is 0.6 % of ambient), so that
        one Newton step from the last u is exact to 1e-11 in the twin's small steps; the next step
        removes the error of a sudden jump.

        Parameters
        ----------
        added_ml : float
            Reference mL in minus out.
        follow : float
            Share of the difference to the air's temperature that this step closes.
        ambient_pa : float
            Pressure of the room.
        air_k : float
            Temperature of the room.
        volume : float
            The c of both films, in m^3 per Pa^(1/3).
        """
        amount_ml = self.amount_ml + added_ml
        self.amount_ml = amount_ml if amount_ml > 0.0 else 0.0  # a third of the time of max()
        self.temperature_k += (air_k - self.temperature_k) * follow

        # f(u) = u (ambient + u^3) - P V / c, f'(u) = ambient + 4 u^3.
        pv = self.amount_ml * JOULE_PER_ML * self.temperature_k / REFERENCE_K
        u = self.root_pa
        u3 = u * u * u
        u -= (u * (ambient_pa + u3) - pv / volume) / (ambient_pa + 4 * u3)
        self.root_pa = u if u > 0.0 else 0.0

    def root_pa_per_ml(self, ambient_pa: float, volume: float) -> float:
        """Return du/d(amount) at constant temperature and ambient pressure.

        Parameters
        ----------
        ambient_pa : float
            Pressure of the room.
        volume : float
            The c of both films, in m^3 per Pa^(1/3).
        """
        joule_per_ml = JOULE_PER_ML * self.temperature_k / REFERENCE_K
        return joule_per_ml / (volume * (ambient_pa + 4 * self.gauge_pressure_pa))


def fill_gas(
    gauge_pressure_pa: float, temperature_k: float, ambient_pa: float, volume: float
) -> Gas:
    """Return the gas at a gauge pressure between films.

    Parameters
    ----------
    gauge_pressure_pa, ambient_pa : float
        Pressures.
    temperature_k : float
        Of the gas.
    volume : float
        The c of both films, in m^3 per Pa^(1/3).
    """
    root_pa = gauge_pressure_pa ** (1 / 3)
    pv = (ambient_pa + gauge_pressure_pa) * volume * root_pa
    return Gas(pv / (JOULE_PER_ML * temperature_k / REFERENCE_K), temperature_k, root_pa)
