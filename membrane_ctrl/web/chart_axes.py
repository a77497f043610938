"""Colours and axes that the charts have in common."""

from __future__ import annotations

from typing import Any

GREY, RULE = "#8a8a8a", "rgba(128, 128, 128, 0.3)"  # legible on white and on black


def make_axis(name: str, gap_px: int) -> dict[str, Any]:
    """Options of an axis of ECharts.

    Parameters
    ----------
    name : str
    gap_px : int
        Between the axis and its name.
    """
    return {
        "name": name,
        "nameGap": gap_px,
        "nameLocation": "middle",
        "nameTextStyle": {"color": GREY},
        "axisLabel": {"color": GREY, "hideOverlap": True},
        "splitLine": {"lineStyle": {"color": RULE}},
    }
