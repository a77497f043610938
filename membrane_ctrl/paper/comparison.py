"""What one part of the paper states, beside what is computed here."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

# Linear algebra rounds its sums by where arrays lie in memory: more digits differ from run to run.
DIGITS = 9


class Agreement(StrEnum):
    """How a number here compares with the paper's."""

    REPRODUCED = "reproduced"
    DIFFERS = "differs"
    ASSUMED = "assumed here"
    UNSTATED = "not stated in the paper"


@dataclass(frozen=True, slots=True)
class PaperStatement:
    """One statement of the paper, beside ours.

    Attributes
    ----------
    quantity : str
        What is compared, with its unit.
    paper : str
        As the paper states it; empty if it does not.
    ours : str
        The same computed here, for people.
    agreement : Agreement
    note : str
        Why it differs, or how it was computed.
    """

    quantity: str
    paper: str
    ours: str
    agreement: Agreement
    note: str = ""


@dataclass(frozen=True, slots=True)
class PartResult:
    """The result of one part.

    Attributes
    ----------
    comparisons : sequence of PaperStatement
    numbers : mapping of str to numbers, lists or mappings
        Everything computed, with units in the names. Deterministic for a seed.
    pictures : mapping of str to bytes
        PNG images by their title.
    timing_s : mapping of str to float
        What differs from run to run.
    """

    comparisons: Sequence[PaperStatement]
    numbers: Mapping[str, Any]
    pictures: Mapping[str, bytes]
    timing_s: Mapping[str, float] = field(default_factory=dict)


def judge_within(value: float, low: float, high: float) -> Agreement:
    """Return REPRODUCED if a value lies between two bounds, which count as inside, else DIFFERS.

    Parameters
    ----------
    value : float
        The number computed here; NaN differs.
    low, high : float
        Bounds of the paper's number, in the same unit.
    """
    return Agreement.REPRODUCED if low <= value <= high else Agreement.DIFFERS


def round_numbers(value: Any) -> Any:
    """A number, or the numbers in lists and mappings, to `DIGITS` significant digits."""
    if isinstance(value, float):
        return float(f"{value:.{DIGITS - 1}e}")
    if isinstance(value, Mapping):
        return {name: round_numbers(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [round_numbers(each) for each in value]
    return value
