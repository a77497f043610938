"""A liquid-crystal panel in front of an emulated camera: refresh, latency and first-order response.

The light of a shown image begins at the first refresh after it was sent, plus a latency, and
approaches the image as 1 - exp(-t / tau). A camera that exposes for a while sees the mean over that
while.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

Image = TypeVar("Image")


@dataclass(frozen=True, slots=True)
class PanelResponse:
    """Of a usual desktop panel."""

    refresh_hz: float = 60.0
    latency_s: float = 1 / 60
    tau_s: float = 0.012


class EmulatedPanel(Generic[Image]):
    """The panel's light.

    Parameters
    ----------
    response : PanelResponse
    now : callable
        The clock.
    """

    def __init__(self, response: PanelResponse, now: Callable[[], float]) -> None:
        self._response, self._now = response, now
        self._shown: deque[tuple[float, Image]] = deque(maxlen=3)  # (its light begins, image)

    def send(self, image: Image) -> None:
        """Show from the next refresh on."""
        response = self._response
        refresh_s = math.ceil(self._now() * response.refresh_hz) / response.refresh_hz
        self._shown.append((refresh_s + response.latency_s, image))

    def lit(self, exposure_s: float) -> list[tuple[float, Image]]:
        """Shares of the images in the light of an exposure that begins now; the newest first, their
        sum is 1.
        """
        left, shares = 1.0, []
        begin_s = self._now()
        for lights_s, image in reversed(self._shown):
            dark = self._mean_left(begin_s - lights_s, exposure_s)
            shares.append((left * (1.0 - dark), image))
            left *= dark
        if shares:
            shares[-1] = (shares[-1][0] + left, shares[-1][1])  # earlier images have long faded
        return shares

    def _mean_left(self, from_s: float, exposure_s: float) -> float:
        """Mean of exp(-t / tau), 1 before t = 0, over an exposure that begins at `from_s`."""
        tau_s = self._response.tau_s
        before_s = min(max(-from_s, 0.0), exposure_s)
        start_s, end_s = max(from_s, 0.0), max(from_s + exposure_s, 0.0)
        after_s = tau_s * (math.exp(-start_s / tau_s) - math.exp(-end_s / tau_s))
        return (before_s + after_s) / exposure_s
