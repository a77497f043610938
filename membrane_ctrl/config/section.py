"""What every configuration table is."""

from typing import Any, get_args

from pydantic import BaseModel, ConfigDict, model_validator


class Section(BaseModel):
    """A configuration table: immutable, no unknown keys, no NaN or infinity, no `true` in place of a number."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _truth_is_no_number(cls, table: Any) -> Any:
        """Pydantic takes `true` for 1.0, and a key left over from a switch would pass for a quantity."""
        if isinstance(table, dict):
            for name, value in table.items():
                field = cls.model_fields.get(name)
                if field is not None and _has_truth(value) and not _takes_truth(field.annotation):
                    raise ValueError(f"{name}: {str(value).lower()} is neither a number nor a text")
        return table


def _has_truth(value: Any) -> bool:
    return isinstance(value, bool) or (isinstance(value, list | tuple) and any(map(_has_truth, value)))


def _takes_truth(annotation: Any) -> bool:
    return annotation in (bool, Any) or any(map(_takes_truth, get_args(annotation)))
