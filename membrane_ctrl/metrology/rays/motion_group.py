"""A rigid motion of camera, screen, lens or mirror, in words and numbers."""

from dataclasses import dataclass

LARGEST = 1500.0  # motion that is considered, in µm, µrad or ppm


@dataclass(frozen=True)
class MotionGroup:
    """A motion whose direction is free: one or two components, in µm or µrad each.

    Attributes
    ----------
    name : str
        What moved, and how, for people.
    components : int
        One or two.
    unit : str
        Of the components: "µm", "µrad", or "ppm" of the focal length.
    allowance : float
        How far a body may move between a reference and a frame without any sign of it, in `unit`. 3
        µm: a steel mount of a metre in a quarter of a kelvin; 10 µm: the 2.7 m to the mirror. The
        mirror has none: only the places of camera and screen relative to it count.
    knock : float
        Size of a knock, in `unit`: larger motions count as the cause only if they are well visible.
    is_of_mirror : bool
        Whether the figure relative to camera and screen changes as the mirror itself does.
    is_hidden : bool
        Whether the motion looks like a change of the bowl, or of the film within its ring, and
        tilts the ring by less than a mirror that settles: only the ring's saddle shows it.
    """

    name: str
    components: int
    unit: str
    allowance: float = 3.0
    knock: float = 100.0
    is_of_mirror: bool = False
    is_hidden: bool = False

    @classmethod
    def hidden(cls, name: str, unit: str, allowance: float = 10.0) -> "MotionGroup":
        """Return a hidden motion of one component.

        Parameters
        ----------
        name : str
            For people.
        unit : str
            Of the motion.
        allowance : float
            See the attribute.
        """
        return cls(name, 1, unit, allowance, knock=LARGEST, is_hidden=True)
