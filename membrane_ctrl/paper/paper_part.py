"""A figure, table or statement of the paper, and the function that computes it again."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from membrane_ctrl.paper.comparison import PartResult


@dataclass(frozen=True, slots=True)
class PaperPart:
    """A figure, table or statement of the paper.

    Attributes
    ----------
    name : str
        For `--only` and the files.
    title : str
        Heading.
    source : str
        Where it stands in the paper.
    compute : callable
        Gets the bench and returns a PartResult.
    needs_truth : bool
        Whether only a simulated bench will do.
    needs_angle : bool
        Whether the geometry must be given as a, b and alpha.
    """

    name: str
    title: str
    source: str
    compute: Callable[[Any], PartResult]
    needs_truth: bool = False
    needs_angle: bool = False
