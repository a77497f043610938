"""What is known of a mirror that was turned for a set."""

from dataclasses import dataclass

# Of a mirror that is turned by hand, by marks on its ring.
TURN_SIGMA_DEG = 0.2
SEAT_SIGMA_MM = 0.5


@dataclass(frozen=True)
class TurnedMirror:
    """A mirror that was turned about its axis; height and tilt of its seat are free.

    Attributes
    ----------
    angle_deg : float
        Counter-clockwise as the camera sees the mirror.
    angle_sigma_deg : float
        Its standard uncertainty.
    seat_sigma_mm : float
        Standard uncertainty of the place of its axis, along x and along y.
    figure_turns : bool
        False: its figure is unknown, whatever the other sets show.
    """

    angle_deg: float
    angle_sigma_deg: float = TURN_SIGMA_DEG
    seat_sigma_mm: float = SEAT_SIGMA_MM
    figure_turns: bool = True
