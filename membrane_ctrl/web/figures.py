"""What the page draws, once for all viewers: the history chart, the map of the figure."""

import asyncio
import io
import math
import time
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Generic, TypeVar

import numpy as np

from membrane_ctrl.model.arrays import Column
from membrane_ctrl.model.columns import COLUMNS
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.zernike_terms import FIRST_FIGURE_INDEX, zernike_labels
from membrane_ctrl.run_files import shapes
from membrane_ctrl.service.feed import Series
from membrane_ctrl.service.work_pools import WorkPool

T = TypeVar("T")
_GREY, _RULE = "#8a8a8a", "rgba(128, 128, 128, 0.3)"  # legible on white and on black
_MARKS_MOST, _MARK_LETTERS = 20, 24  # newest marks on a chart, and what fits beside each

REMOVED = {"nothing": 0, "piston, tilt": 3, "piston, tilt, defocus": 4}
_BAND = {
    "type": "line",
    "symbol": "none",
    "lineStyle": {"opacity": 0},
    "silent": True,
    "stack": "band",
    "stackStrategy": "all",  # also where its lower edge is negative
}


@dataclass(frozen=True, slots=True)
class MapPicture:
    """A map as a picture for the page, with its figures in words, and the terms beside it."""

    png: bytes
    words: str
    terms: dict[str, Any]  # options of their chart


def chart(
    signal: str, series: Series, utc: bool, marks: Sequence[tuple[float, str]] = ()
) -> dict[str, Any]:
    """Options of the history chart (ECharts): the mean, the band between least and largest value,
    and the marks.

    `marks` are UTC seconds and texts, oldest first.
    """
    name = COLUMNS[signal].title
    shift_ms = 0.0 if utc else _offset_s(series) * 1e3
    at_ms = series.utc_s * 1e3 + shift_ms
    lines = [
        {"xAxis": at_s * 1e3 + shift_ms, "name": text[:_MARK_LETTERS]}
        for at_s, text in marks[-_MARKS_MOST:]
    ]
    low, mean, high = (
        [[t, _plain(v)] for t, v in zip(at_ms, y, strict=True)] for y in _stacked(series)
    )
    options: dict[str, Any] = {
        "animation": False,
        "useUTC": True,  # the local time is in the values: ECharts knows no time zone of the bench
        "grid": {"left": 64, "right": 16, "top": 24, "bottom": 64},
        "tooltip": {"trigger": "axis"},
        "xAxis": {**_axis("UTC" if utc else "local time", 28), "type": "time"},
        "yAxis": {**_axis(name, 48), "type": "value", "scale": True},
        "dataZoom": [{"type": "inside"}, {"type": "slider", "height": 18, "bottom": 6}],
        "series": [
            {**_BAND, "data": low},
            {**_BAND, "data": high, "areaStyle": {"color": "#1f77b4", "opacity": 0.25}},
            {
                "type": "line",
                "name": name,
                "symbol": "none",
                "data": mean,
                "lineStyle": {"width": 1.5},
                "itemStyle": {"color": "#1f77b4"},
                "markLine": _mark_lines(lines),
            },
        ],
    }
    return options


def _axis(name: str, gap_px: int) -> dict[str, Any]:
    label = {"color": _GREY, "hideOverlap": True}
    place = {
        "name": name,
        "nameGap": gap_px,
        "nameLocation": "middle",
        "nameTextStyle": {"color": _GREY},
    }
    return {**place, "axisLabel": label, "splitLine": {"lineStyle": {"color": _RULE}}}


def _mark_lines(lines: list[dict[str, Any]]) -> dict[str, Any]:
    label = {"formatter": "{b}", "color": _GREY, "position": "insideEndTop", "fontSize": 10}
    return {
        "symbol": "none",
        "animation": False,
        "lineStyle": {"color": _GREY},
        "label": label,
        "data": lines,
    }


def _stacked(series: Series) -> tuple[Column, Column, Column]:
    """The band as ECharts stacks it: its lower edge and its width; and the mean."""
    return series.low, series.mean, series.high - series.low


def _offset_s(series: Series) -> float:
    at_s = float(series.utc_s[-1]) if series.utc_s.size else 0.0
    offset = datetime.fromtimestamp(at_s, UTC).astimezone().utcoffset()
    return offset.total_seconds() if offset else 0.0


def _plain(value: float) -> float | None:
    return round(float(value), 4) if math.isfinite(value) else None


def terms_chart(figure: ShapeEstimate, reference: ShapeEstimate | None) -> dict[str, Any]:
    """Options of the bar chart of the terms from Z4: change since the reference, µm, with its
    standard deviation.
    """
    shown = slice(FIRST_FIGURE_INDEX - 1, None)
    change_um = (
        figure.coeffs_um - reference.coeffs_um if reference is not None else figure.coeffs_um
    )
    sigma_um = np.sqrt(np.diag(figure.covariance_um2))
    return {
        "animation": False,
        "grid": {"left": 56, "right": 12, "top": 16, "bottom": 40},
        "tooltip": {"trigger": "axis"},
        "xAxis": {**_axis("", 0), "type": "category", "data": zernike_labels(FIRST_FIGURE_INDEX)},
        "yAxis": {**_axis("µm", 40), "type": "value"},
        "series": [
            {"type": "bar", "name": "change, µm", "data": [_plain(v) for v in change_um[shown]]},
            {
                "type": "scatter",
                "name": "sigma, µm",
                "symbolSize": 4,
                "data": [_plain(v) for v in sigma_um[shown]],
            },
        ],
    }


def map_picture(figure: ShapeEstimate, reference: ShapeEstimate | None, removed: int) -> MapPicture:
    """The figure less `removed` terms: its change since the reference in µm, without one its height
    in µm.
    """
    from matplotlib import colormaps
    from PIL import Image

    height_um = shapes.height_map_mm(figure) * 1e3
    if change := reference is not None and reference is not figure:
        height_um = shapes.difference_map_um(figure, reference)
    left = shapes.without_terms(height_um, removed) if removed else height_um
    there = np.isfinite(left)
    values = left[there].astype(np.float64)
    scale_um = max(float(np.abs(values).max()), 1e-6)
    share = np.where(there, 0.5 + 0.5 * left / scale_um, 0.5)
    picture = (colormaps["RdBu_r"](share) * 255).astype(np.uint8)
    picture[~there, 3] = 0
    file = io.BytesIO()
    Image.fromarray(picture).resize((384, 384), Image.Resampling.NEAREST).save(file, "PNG")
    of = "change since the reference" if change else "height above the vertex"
    words = (
        f"{of}: {values.max() - values.min():.3g} µm PV, {values.std():.3g} µm rms, scale "
        f"±{scale_um:.3g} µm"
    )
    return MapPicture(file.getvalue(), f"{figure.verdict}; {words}", terms_chart(figure, reference))


class Shared(Generic[T]):
    """Makes a thing on a thread of a pool, once for all who ask for it within its life."""

    def __init__(self, make: Callable[..., T], pool: WorkPool, life_s: float) -> None:
        self._make, self._pool, self._life_s = make, pool, life_s
        self._made: dict[tuple[Hashable, ...], tuple[asyncio.Task[T], float]] = {}

    async def get(self, *key: Hashable) -> T:
        """What `make` returns, or raises, for these arguments."""
        now_s = time.monotonic()
        self._made = {k: made for k, made in self._made.items() if _is_current(*made, now_s)}
        if key not in self._made:
            self._made[key] = (
                asyncio.create_task(self._pool.run(self._make, *key)),
                now_s + self._life_s,
            )
        return await asyncio.shield(self._made[key][0])  # a viewer who leaves takes it from nobody


def _is_current(task: asyncio.Task[Any], end_s: float, now_s: float) -> bool:
    """Whether a task still runs, or has made a thing that is not too old."""
    if not task.done():
        return True
    failed = task.cancelled() or task.exception() is not None
    return not failed and end_s > now_s
