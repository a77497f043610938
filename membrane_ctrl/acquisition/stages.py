"""Where a cycle failed: whatever a device or the numerics raise becomes one kind of error that names the stage."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

Stage = Literal["screen", "camera", "reconstruction"]


class StageError(Exception):
    """What was raised, and in which stage."""

    def __init__(self, stage: Stage, message: str) -> None:
        super().__init__(message)
        self.stage = stage


@contextmanager
def during(stage: Stage) -> Iterator[None]:
    """Raise whatever the block raises as a StageError."""
    try:
        yield
    except Exception as error:
        raise StageError(stage, f"{type(error).__name__}: {error}") from error
