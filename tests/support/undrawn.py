"""Empty pictures, for tests of the texts and numbers beside them:
a report takes seconds to draw.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO, Any
from unittest.mock import patch

import cv2
import numpy as np


def _empty(self: object, file: IO[Any], **options: object) -> None:
    file.write(
        "<svg></svg>"
        if options["format"] == "svg"
        else cv2.imencode(".png", np.zeros((1, 1)))[1].tobytes()
    )


@contextmanager
def undrawn_figures() -> Iterator[None]:
    """Meanwhile every figure is written as an empty picture."""
    with patch("matplotlib.backend_bases.FigureCanvasBase.print_figure", _empty):
        yield
