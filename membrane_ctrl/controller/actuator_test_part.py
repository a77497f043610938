"""A part of the actuator test: one command, and how long its response may take."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Part:
    """A part of the actuator test.

    Attributes
    ----------
    name : str
    pump_fraction, vent_fraction : float
        Commands.
    wait_s : float
        What a quick actuator needs to respond: lag 0.15 s, transport 0.1 s.
    measure_s : float
        Time over which a speed is measured.
    longest_s : float
        After which the test fails without a response.
    """

    name: str
    pump_fraction: float
    vent_fraction: float
    wait_s: float
    measure_s: float
    longest_s: float
