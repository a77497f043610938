"""A viewer that is too slow for a picture is named as such, with what to do."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from membrane_ctrl.review.viewer import screenshot


class SlowViewer:
    """Answers no request before its deadline."""

    def open(self, _: str) -> None:
        raise TimeoutError(110, "deadline expired before operation could complete")


@pytest.mark.parametrize("source", [Path("review.rrd"), "http://127.0.0.1:1"])
def test_a_slow_viewer_is_named(source: Path | str, monkeypatch: pytest.MonkeyPatch) -> None:
    @contextmanager
    def start() -> Iterator[SlowViewer]:
        yield SlowViewer()

    monkeypatch.setattr(screenshot, "_start_headless_viewer", start)
    expected = "the viewer did not answer in time .*deadline expired.*try again when the machine"
    with pytest.raises(RuntimeError, match=expected):
        screenshot.take_screenshot(source)
