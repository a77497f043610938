"""One row of the state timeline."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Lane:
    """One row of the state timeline.

    Attributes
    ----------
    path : str
        Rerun entity.
    field : str
        Telemetry field that holds the code; empty if the lane does not come from telemetry.
    words : dict
        Code to word.
    colours : dict
        Word to 0xRRGGBBAA; a word without one gets the viewer's choice.
    """

    path: str
    field: str
    words: dict[int, str]
    colours: dict[str, int]

    def name_code(self, code: int) -> str:
        """The word for a code; an unknown code is shown as a number."""
        return self.words.get(code, f"code {code}")
