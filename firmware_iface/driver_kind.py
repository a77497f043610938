"""A kind of driver: its name for people, its entry points, and the drivers of this package."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    pass


@dataclass(frozen=True, slots=True)
class DriverKind:
    """A kind of driver: its name for people, its entry point groups, and the drivers of this
    package in the first.
    """

    name: str
    group: str
    emulators: str
    built_in: dict[str, str]  # name and object of an entry point
