"""Faults that a simulated set can carry: what goes wrong with single frames on a real bench."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

FaultKind = Literal[
    "stale", "swapped", "missing", "saturated", "dark", "flicker", "moved", "wrong_size", "wrong_depth"
]

# Strength of a fault that has one: exposure against nominal, or um of film displacement
_DEFAULT_AMOUNT: dict[FaultKind, float] = {"saturated": 2.0, "dark": 0.05, "flicker": 0.8, "moved": 200.0}


@dataclass(frozen=True, slots=True)
class FrameFault:
    """One fault of one frame.

    Attributes
    ----------
    kind : str
        "stale" (the picture of the frame before, byte for byte), "swapped" (with the frame after), "missing" (listed
        but not written), "saturated", "dark", "flicker" (wrong exposure), "moved" (the film stood elsewhere and the
        laser did not say so), "wrong_size" (one row short), "wrong_depth" (8 for 16 bit and the reverse).
    frame : str
        The frame's name, as `x_sin_2`.
    amount : float or None
        Exposure against nominal, or um for "moved"; None: a usual one.
    """

    kind: FaultKind
    frame: str
    amount: float | None = None

    def __post_init__(self) -> None:
        if self.kind not in get_args(FaultKind):
            raise ValueError(f"faults: kind {self.kind!r} is not one of {', '.join(get_args(FaultKind))}")
        if self.amount is not None and self.kind not in _DEFAULT_AMOUNT:
            raise ValueError(f"faults: {self.kind} has no amount")

    @property
    def strength(self) -> float:
        """The amount, or the usual one of this kind."""
        return _DEFAULT_AMOUNT[self.kind] if self.amount is None else self.amount

    @classmethod
    def parse(cls, text: str) -> FrameFault:
        """Read `kind:frame` or `kind:frame:amount`.

        Raises
        ------
        ValueError
            If the text has another form, names no known kind or its amount is not a number.
        """
        kind, _, rest = text.partition(":")
        frame, _, amount = rest.partition(":")
        if not frame:
            raise ValueError(f"faults: {text!r} must read kind:frame or kind:frame:amount, as flicker:x_sin_2:0.8")
        try:
            return cls(kind, frame, float(amount) if amount else None)  # type: ignore[arg-type]  # checked above
        except ValueError as error:
            if str(error).startswith("faults"):
                raise
            raise ValueError(f"faults: amount {amount!r} of {text!r} is not a number") from None
