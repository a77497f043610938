"""A limit of the acceptance, with its unit and its reason."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Threshold:
    """A limit of the acceptance.

    Attributes
    ----------
    name : str
        What is limited.
    value : float
        The limit, in `unit`.
    unit : str
        Empty for a ratio or a count.
    reason : str
        Why this value.
    is_least : bool
        Whether the measured value must be at least this; otherwise at most.
    """

    name: str
    value: float
    unit: str
    reason: str
    is_least: bool = False

    @property
    def words(self) -> str:
        """The limit for people: `at most 5 Pa`."""
        side = "at least" if self.is_least else "at most"
        return f"{side} {self.value:g} {self.unit}".rstrip()

    def is_met(self, measured: float) -> bool:
        """Whether a measured value is within the limit; False for NaN."""
        if self.is_least:
            return measured >= self.value
        return measured <= self.value
