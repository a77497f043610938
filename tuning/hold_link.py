"""A hold as a session sees it: commands in, ticks and events out. The twin and the control port each give one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from membrane_ctrl.commands import Command
from membrane_ctrl.config import Config
from membrane_ctrl.estimate import ShapeEstimate
from membrane_ctrl.telemetry import TelemetryRow
from membrane_ctrl.tick import Event


class HoldError(Exception):
    """The hold refuses, or has left its state; the message says which and what to do."""


@dataclass(frozen=True, slots=True)
class News:
    """What has come since the last call, each in its order."""

    rows: tuple[TelemetryRow, ...]
    events: tuple[Event, ...]
    shapes: tuple[ShapeEstimate, ...]


class HoldLink(Protocol):
    """What a session needs of a hold."""

    @property
    def config(self) -> Config:
        """Of the run."""
        ...

    @property
    def name(self) -> str:
        """Where the data come from: a run folder, or the twin."""
        ...

    def ask(self, command: Command) -> None:
        """Hand a command to the next tick. Raises HoldError with the reason if it is refused."""
        ...

    def news(self) -> News:
        """Wait a moment, then return what has come. Raises HoldError if the hold has ended."""
        ...

    def close(self) -> None:
        """Let go."""
        ...
