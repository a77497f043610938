"""The map of the figure as numbers, which the browser draws with axes, colour bar and profile, and
the chart of its terms.
"""

from __future__ import annotations

import gzip
import json
import math
from collections.abc import Collection
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from membrane_ctrl.config.schema import Config
from membrane_ctrl.metrology.figure.held_quantities import find_held_scalars, measure_scalars
from membrane_ctrl.model.colours import DIVERGING_MAP
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.zernike_terms import FIRST_FIGURE_INDEX, zernike_labels
from membrane_ctrl.run_files import shapes
from membrane_ctrl.web.chart_axes import GREY, RULE

SCRIPT = (Path(__file__).parent / "figure_map.js").read_text(encoding="utf-8")
# terms that a viewer may remove, with their Noll indices
REMOVABLE = {
    "piston": (1,),
    "tilt": (2, 3),
    "power": (4,),
    "astigmatism": (5, 6),
    "coma": (7, 8),
    "trefoil": (9, 10),
    "spherical": (11,),
}
_STEPS = 1000  # of the colour scale: finer than a screen shows
_COLOURS = 64
_LEAST_SCALE_UM = 1e-6
_BESIDE = {"nameLocation": "middle", "nameGap": 40}  # of the name of an axis


@dataclass(frozen=True, slots=True)
class FigureMap:
    """A map for the page.

    Attributes
    ----------
    data : bytes
        JSON for `figure_map.js`, in gzip.
    words : str
        What it shows, with its figures: also for a screen reader.
    terms : dict
        Options of the chart of its terms.
    """

    data: bytes
    words: str
    terms: dict[str, Any]


def make_figure_map(
    figure: ShapeEstimate,
    reference: ShapeEstimate | None,
    removed: Collection[str],
    config: Config | None,
) -> FigureMap:
    """The change of a figure since a reference, or its height without one, less some terms.

    Parameters
    ----------
    figure, reference : ShapeEstimate
        The figure that is shown, and the one that it is compared with; None: the height is shown.
    removed : collection of str
        Names of `REMOVABLE`.
    config : Config or None
        Of the run, for the axes, and for focus and distance from the reference.
    """
    radius_mm = None if config is None else config.optics.mirror.radius_mm
    # The map, without the removed terms.
    is_change = reference is not None
    if reference is not None:
        height_um = shapes.difference_map_um(figure, reference)
    else:
        height_um = shapes.height_map_mm(figure) * 1e3
    indices = [index for name, group in REMOVABLE.items() if name in removed for index in group]
    if indices:
        height_um = shapes.without_noll_terms(height_um, indices)
    # Its figures, and the range of its colours.
    measured = np.isfinite(height_um)
    values_um = height_um[measured].astype(np.float64)
    peak_to_valley_um = float(np.ptp(values_um))
    rms_um = float(values_um.std())
    low_um, high_um = float(values_um.min()), float(values_um.max())
    if is_change or indices:  # colours around zero
        high_um = max(abs(low_um), abs(high_um), _LEAST_SCALE_UM)
        low_um = -high_um
    span_um = max(high_um - low_um, _LEAST_SCALE_UM)
    # Heights as steps of that range: a browser needs no floats.
    steps = np.round(_STEPS * (height_um - low_um) / span_um)
    title = "change" if is_change else "height above the vertex"
    without = f" without {', '.join(sorted(removed))}" if removed else ""
    data = {
        "size": len(height_um),
        "steps": [None if math.isnan(step) else int(step) for step in steps.ravel()],
        "steps_most": _STEPS,
        "low_um": low_um,
        "high_um": high_um,
        "pv_um": peak_to_valley_um,
        "rms_um": rms_um,
        "radius_mm": radius_mm,
        "title": f"{title}{without}, µm",
        "colours": _list_colours(),
    }
    words = (
        f"{figure.verdict}; {title}{without}: PV {peak_to_valley_um:.3g} µm, RMS {rms_um:.3g} µm"
    )
    if config is not None and figure.verdict != "rejected":
        words += f". {describe_scalars(figure, reference, config)}"
    packed = gzip.compress(json.dumps(data).encode(), 1)
    return FigureMap(packed, words, make_terms_chart(figure, reference))


def describe_scalars(figure: ShapeEstimate, reference: ShapeEstimate | None, config: Config) -> str:
    """Vertex, focus and RMS against a reference with their standard deviations, as a line.

    Parameters
    ----------
    figure : ShapeEstimate
        The figure to describe; its covariance gives the standard deviations.
    reference : ShapeEstimate or None
        Taken as exact: the line states the change since that figure. None: only the focus, which
        needs no reference.
    config : Config
        Of the run: mirror and used aperture.
    """
    against = figure if reference is None else reference
    found = measure_scalars(
        find_held_scalars(config),
        figure.coeffs_um,
        figure.hencky_um,
        figure.covariance_um2,
        against.coeffs_um,
    )
    focus = f"Focus {found.focus_mm:.4f} ± {found.focus_sigma_mm:.4f} mm"
    if reference is None:
        return focus
    return (
        f"Vertex {found.vertex_um:+.3f} ± {found.vertex_sigma_um:.3f} µm of sag; {focus}; RMS "
        f"{found.rms_um:.3f} ± {found.rms_sigma_um:.3f} µm, at the best depth "
        f"{found.least_rms_um:.3f} µm"
    )


@cache
def _list_colours() -> list[str]:
    """Colours of the map from its lowest to its highest value, as CSS."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    return [to_hex(colormaps[DIVERGING_MAP](share)) for share in np.linspace(0.0, 1.0, _COLOURS)]


def make_terms_chart(figure: ShapeEstimate, reference: ShapeEstimate | None) -> dict[str, Any]:
    """Options of the bar chart of the terms from Z4, with an error bar of one standard deviation.

    Parameters
    ----------
    figure : ShapeEstimate
        Terms in µm; piston and tilt are not shown, because the mount determines them.
    reference : ShapeEstimate or None
        The bars are the change since it; None: the bars are the height. The error bar is that of
        `figure` alone.

    Returns
    -------
    dict
        Options of Apache ECharts, plain JSON: NaN is None.
    """
    shown = slice(FIRST_FIGURE_INDEX - 1, None)
    terms_um = figure.coeffs_um - (0.0 if reference is None else reference.coeffs_um)
    sigma_um = np.sqrt(np.diag(figure.covariance_um2))
    labels = zernike_labels(FIRST_FIGURE_INDEX)
    names = {"color": GREY}
    axis = {"axisLabel": names, "nameTextStyle": names, "splitLine": {"lineStyle": {"color": RULE}}}
    return {
        "animation": False,
        "aria": {"enabled": True},
        "grid": {"left": 56, "right": 12, "top": 28, "bottom": 36},
        "legend": {"data": ["change" if reference is not None else "height", "1 σ"], "top": 0}
        | {"textStyle": names},
        "tooltip": {"trigger": "axis", "confine": True},
        "xAxis": {**axis, "type": "category", "data": labels},
        "yAxis": {**axis, "type": "value", "name": "µm", **_BESIDE},
        "series": [
            {
                "type": "bar",
                "name": "change" if reference is not None else "height",
                "itemStyle": {"color": "#56b4e9"},
                "data": [_round_um(value) for value in terms_um[shown]],
            },
            {
                "type": "line",
                "name": "1 σ",
                "symbol": "none",
                "step": "middle",
                "lineStyle": {"width": 1, "color": "#d55e00"},
                "itemStyle": {"color": "#d55e00"},
                "data": [_round_um(value) for value in sigma_um[shown]],
            },
        ],
    }


def _round_um(value: float) -> float | None:
    return round(float(value), 4) if math.isfinite(value) else None
