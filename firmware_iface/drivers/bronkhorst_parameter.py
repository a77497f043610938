"""A parameter of a Bronkhorst instrument, by process and number."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class InstrumentParameter:
    """One value of an instrument; `kind` is "u8", "u16", "f32" or "text", `chars` the length of a
    text.
    """

    name: str
    process: int
    number: int
    kind: str
    chars: int = 0
