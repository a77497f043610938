"""The charts of the sliders: Bode plot with margins, responses, sensitivity and Nyquist plot."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.web.chart_axes import GREY, Options, stack_panels

if TYPE_CHECKING:  # it takes seconds to import, and the service may never need it
    from tuning.explore.crossings import Crossing
    from tuning.explore.curves import Curves

YOURS = "yours"
# legible on white and on black
_COLOURS = (GREY, "#3b8fd0")
_YOURS_COLOUR, _LIMIT_COLOUR = "#e07b00", "#d55e00"
_POINTS = 300  # of a curve: more than a panel has pixels between two of them
_DIGITS = 4
_NYQUIST_NEAR = 30.0  # |L| beyond which the Nyquist plot shows nothing
_GAINS, _PHASES_DEG = (1e-3, 1e4), (-360.0, -60.0)
_SENSITIVITY_MOST = 2.5
_LOWEST_HERTZ = 1e-3
CHARTS = ("bode", "responses", "noise", "nyquist")

Points = list[list[float]]


def make_gains_charts(
    found: Mapping[str, Curves],
    crossings: tuple[Crossing | None, Crossing | None],
    step_um: float,
    load_um_per_s: float,
    ms_most: float,
    dt_s: float,
) -> dict[str, Options]:
    """Options of ECharts for each of `CHARTS`, as plain data.

    Parameters
    ----------
    found : mapping of Curves
        By the name of the gains; the last are those of the sliders.
    crossings : (Crossing or None, Crossing or None)
        Of the last: where its margins are drawn.
    step_um, load_um_per_s : float
        Of the responses: step of the setpoint, and of the leak.
    ms_most : float
        Largest sensitivity that a design accepts.
    dt_s : float
        Of a tick.
    """
    names = list(found)
    highest_hertz = 0.5 / dt_s
    hertz = {"type": "log", "min": _LOWEST_HERTZ, "max": highest_hertz}
    frequency = {name: each.w_rad_per_s / (2 * math.pi) for name, each in found.items()}
    gain = _lines(names, lambda name: _points(frequency[name], np.abs(found[name].open_loop)), 0)
    phase = _lines(names, lambda name: _points(frequency[name], found[name].phase_deg), 1)
    _draw_margins(gain[-1], phase[-1], crossings)
    sensitivity = _lines(
        names, lambda name: _points(frequency[name], np.abs(1 / (1 + found[name].open_loop))), 0
    )
    sensitivity[-1]["markLine"] = _make_limit(ms_most, "limit of Ms")
    spectrum = _lines(
        # two-sided per rad/s becomes one-sided per hertz
        names,
        lambda name: _points(frequency[name], 2 * found[name].centre_um2_s),
        1,
    )
    step = _lines(names, lambda name: _points(found[name].time_s, found[name].step_um), 0)
    load = _lines(names, lambda name: _points(found[name].time_s, found[name].load_um), 1)
    return {
        "bode": stack_panels(
            names,
            ("frequency, Hz", hertz),
            (
                ("gain |L|", {"type": "log", "min": _GAINS[0], "max": _GAINS[1]}, gain),
                (
                    "phase, °",
                    {"min": _PHASES_DEG[0], "max": _PHASES_DEG[1], "interval": 60},
                    phase,
                ),
            ),
        ),
        "responses": stack_panels(
            names,
            ("time, s", {"type": "value", "min": 0}),
            (
                (f"setpoint +{step_um:g} µm: centre, µm", {"scale": True}, step),
                (f"leak +{load_um_per_s:g} µm/s: centre, µm", {"scale": True}, load),
            ),
        ),
        "noise": stack_panels(
            names,
            ("frequency, Hz", hertz),
            (
                ("sensitivity |S|", {"min": 0, "max": _SENSITIVITY_MOST}, sensitivity),
                ("true centre, µm²/Hz", {"type": "log"}, spectrum),
            ),
        ),
        "nyquist": _make_nyquist(names, found),
    }


def _make_nyquist(names: Sequence[str], found: Mapping[str, Curves]) -> Options:
    """The open loop about -1 in the complex plane; points far from it would hide the distance."""

    def near(name: str) -> Points:
        response = found[name].open_loop
        response = response[np.abs(response) < _NYQUIST_NEAR]
        return _points(response.real, response.imag)

    lines = _lines(names, near, 0)
    lines[-1]["markPoint"] = {
        "symbol": "circle",
        "symbolSize": 9,
        "itemStyle": {"color": _LIMIT_COLOUR},
        "label": {"show": True, "formatter": "-1", "position": "bottom", "color": _LIMIT_COLOUR},
        "data": [{"coord": [-1, 0]}],
    }
    real = ("real part of L", {"type": "value", "min": -3, "max": 1})
    options = stack_panels(names, real, (("imaginary part of L", {"min": -2, "max": 1}, lines),))
    options["tooltip"] = {"show": False}
    return options


def _lines(names: Sequence[str], points: Any, panel: int) -> list[Options]:
    """A line for each set of gains; the last one, that of the sliders, is wider and has its own
    colour.
    """
    lines = []
    for place, name in enumerate(names):
        is_yours = place == len(names) - 1
        colour = _YOURS_COLOUR if is_yours else _COLOURS[min(place, len(_COLOURS) - 1)]
        lines.append(
            {
                "type": "line",
                "name": name,
                "symbol": "none",
                "data": points(name),
                "xAxisIndex": panel,
                "yAxisIndex": panel,
                "clip": True,
                "lineStyle": {"width": 2.5 if is_yours else 1.5},
                "itemStyle": {"color": colour},
            }
        )
    return lines


def _draw_margins(
    gain: Options, phase: Options, crossings: tuple[Crossing | None, Crossing | None]
) -> None:
    """Draw the margins as vertical lines between the curve and its limit, with their values."""
    at_gain, at_phase = crossings
    gain["markLine"] = _make_limit(1.0)
    phase["markLine"] = _make_limit(-180.0)
    if at_phase is not None:
        words = f"gain margin ×{1 / at_phase.gain:.2g}"
        ends = (at_phase.gain, 1.0)
        gain["markLine"]["data"].append(_make_segment(at_phase.hertz, ends, words))
    if at_gain is not None:
        margin_deg = at_gain.phase_deg + 180.0
        ends = (-180.0, at_gain.phase_deg)
        segment = _make_segment(at_gain.hertz, ends, f"phase margin {margin_deg:.0f}°")
        phase["markLine"]["data"].append(segment)


def _make_limit(value: float, words: str = "") -> Options:
    label = {"show": bool(words), "formatter": words, "position": "insideStartTop", "color": GREY}
    line = {
        "yAxis": value,
        "lineStyle": {"type": "dashed", "color": GREY, "width": 1},
        "label": label,
    }
    return {"symbol": "none", "silent": True, "animation": False, "data": [line]}


def _make_segment(hertz: float, ends: tuple[float, float], words: str) -> list[Options]:
    label = {"show": True, "formatter": words, "position": "end", "color": _YOURS_COLOUR}
    style = {"type": "solid", "color": _YOURS_COLOUR, "width": 3}
    begin, end = ([_round(hertz), _round(each)] for each in ends)
    return [{"coord": begin, "lineStyle": style, "label": label}, {"coord": end}]


def _points(x: FloatArray, y: FloatArray) -> Points:
    """The points of a line, as many as a screen shows."""
    if not x.size:
        return []
    chosen = np.unique(np.linspace(0, x.size - 1, min(_POINTS, x.size)).round().astype(int))
    return [
        [_round(float(x[place])), _round(float(y[place]))]
        for place in chosen
        if math.isfinite(x[place]) and math.isfinite(y[place])
    ]


def _round(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")
