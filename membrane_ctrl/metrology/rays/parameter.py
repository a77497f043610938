"""One number of a bench that may be wrong."""

from dataclasses import dataclass

from membrane_ctrl.config.optics import SigmasConfig

# a, b and alpha: the paper's; the principal point: of the paper's camera
_BY_HAND = {
    "a_mm": 2.0,
    "b_mm": 2.0,
    "alpha_deg": 0.3,
    "principal_x_px": 20.0,
    "principal_y_px": 20.0,
}
_BY_HAND |= SigmasConfig().model_dump()


@dataclass(frozen=True)
class Parameter:
    """One number that may be wrong.

    Attributes
    ----------
    name : str
        Name, which ends in the unit.
    description : str
        Description for people.
    """

    name: str
    description: str

    @property
    def sigma(self) -> float:
        """Of its hand measurement, in that unit: ruler, laser meter, protractor, data sheet."""
        return _BY_HAND[self.name]

    @property
    def unit(self) -> str:
        """The unit in the name; empty for a plain number."""
        tail = self.name.rsplit("_", 1)[-1]
        if tail in ("mm", "deg", "px"):
            return tail
        return ""
