"""Where a cycle failed: every exception of a device or the numerics becomes one error that names
its stage.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

Stage = Literal["screen", "camera", "reconstruction"]


class StageError(Exception):
    """A failure and its stage.

    Parameters
    ----------
    stage : "screen", "camera" or "reconstruction"
        Where the cycle failed.
    message : str
        The type of the error and its text.
    """

    def __init__(self, stage: Stage, message: str) -> None:
        super().__init__(message)
        self.stage = stage


@contextmanager
def convert_stage_errors(stage: Stage) -> Iterator[None]:
    """Turn any exception of the block into a StageError."""
    try:
        yield
    except Exception as error:
        raise StageError(stage, f"{type(error).__name__}: {error}") from error
