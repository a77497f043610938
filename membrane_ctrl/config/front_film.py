"""The table of a clear film in front of the mirror's: the second film of a cushion."""

from typing import Annotated, Literal

from pydantic import Field

from firmware_iface.settings import Section

GasName = Literal["air", "nitrogen", "argon", "carbon_dioxide", "helium"]


class FrontFilmConfig(Section):
    """The clear film of a cushion, through which camera and screen see the mirror: absent for a
    single film.

    It bulges towards the camera, with gas between it and the mirror. An empty table describes the
    paper's.
    """

    bulge_mm: Annotated[float, Field(gt=0, le=5000)] = 63.4
    """Height of its vertex above its rim, towards the camera, at displacement 0. Set it to the
    measured one.
    """
    bulge_sigma_mm: Annotated[float, Field(ge=0, le=1000)] = 1.0
    """Standard uncertainty of `bulge_mm`. Set it to that of your measurement."""
    rim_gap_mm: Annotated[float, Field(ge=0, le=5000)] = 0.0
    """Distance of its rim in front of the mirror's. Set it to the thickness of the ring between."""
    thickness_um: Annotated[float, Field(ge=0, le=10_000)] = 10.0
    """Thickness of the film. Set it from the film's data sheet."""
    thickness_sigma_relative: Annotated[float, Field(ge=0, le=1)] = 0.03
    """Standard uncertainty of the thickness, and of its evenness, of its value. Set it from the
    film's data sheet.
    """
    index: Annotated[float, Field(gt=1, le=3)] = 1.6
    """Refractive index of the film. Set it from the film's data sheet: it gives the reflectance."""
    gas: GasName = "nitrogen"
    """Gas between the films. Set it to what the pump delivers."""
    gas_k: Annotated[float, Field(ge=200, le=400)] = 293.15
    """Temperature of the gas and of the room. Set it to the room's mean."""
    ambient_pa: Annotated[float, Field(ge=10_000, le=120_000)] = 101_325.0
    """Pressure of the room's air. Set it for a laboratory far above the sea."""
    gas_sigma_relative: Annotated[float, Field(ge=0, le=10)] = 0.1
    """Standard uncertainty of gas index less air index, of its value. Raise it if the gas is not
    pure.
    """
