"""The table `[climate]`: how temperature and humidity strain film and ring."""

from typing import Annotated

from pydantic import Field

from firmware_iface.settings import Section

PartsPerMillion = Annotated[float, Field(ge=-1000, le=1000)]


class ClimateConfig(Section):
    """Strains of film and ring, of which the change of the figure is predicted, and by which laser
    and gauge may differ. It needs the sensor roles `film_thermometer`, `ring_thermometer` or
    `hygrometer`, or the air thermometer.
    """

    film_ppm_per_k: PartsPerMillion = 17.0
    """Thermal expansion of the film: PET 17 (Mylar bulletin H-37232-3). Set it to what
    `membrane-ctrl climate` found in a night."""
    film_ppm_per_percent: PartsPerMillion = 6.0
    """Expansion of the film for each per cent of relative humidity: PET 6 (3M, Sound Talk II 1,
    1969); other films of PET have 5 to 11 (assumed). Set it to what `membrane-ctrl climate` found
    in a night."""
    ring_ppm_per_k: PartsPerMillion = 23.0
    """Thermal expansion of the ring: aluminium 23, steel 12. Change it to your ring's."""
    film_sigma_relative: Annotated[float, Field(ge=0, le=1)] = 0.15
    """Share by which the film's two expansions may be wrong, 1 sigma. Lower it to the error that
    `membrane-ctrl climate` states."""
    film_follows_humidity_s: Annotated[float, Field(ge=0, le=1e6)] = 2000.0
    """Time constant with which the film takes up water: 50 µm of PET, open on one side (assumed).
    Change it for another film: it grows with the square of the thickness."""
    ring_follows_air_s: Annotated[float, Field(ge=0, le=1e6)] = 7200.0
    """Time constant with which the ring follows the air; used without a ring thermometer. Change it
    for a lighter or heavier ring."""
    uneven_k: Annotated[float, Field(ge=0, le=100)] = 0.3
    """Temperature of a patch of the film of some 90 mm over that of the rest, 1 sigma, that no
    thermometer shows: a lamp, a hand, the screen (assumed). Lower it in a room without lamps and
    people; raise it beside a window."""
    figure_max_um: Annotated[float, Field(gt=0, le=1e4)] = 3.0
    """Predicted change of the figure, RMS, that raises the notice `climate_figure`. Change it to
    what your optics need."""
