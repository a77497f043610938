"""A value that the interface for programs and the bridges publish."""

from __future__ import annotations

from dataclasses import dataclass

from membrane_ctrl.model.columns import COLUMNS, unit_of


@dataclass(frozen=True, slots=True)
class Published:
    """A published value: a text, or a number with its unit (empty for counts and fractions)."""

    name: str
    description: str
    is_text: bool = False

    @property
    def unit(self) -> str:
        """Unit for people, from the name."""
        return unit_of(self.name)

    @property
    def title(self) -> str:
        """Name for people."""
        column = COLUMNS.get(self.name)
        return self.name if column is None else column.title
