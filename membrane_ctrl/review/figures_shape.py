"""Pictures of the figure: the paper's stability plots, from the live cycles."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.review.figures_hold import hours_or_less
from membrane_ctrl.review.figures_svg import BLUE, GREY, ORANGE, RED, VIOLET, picture, svg
from membrane_ctrl.review.gaps import broken_at_gaps
from membrane_ctrl.review.shape_review import POINTS, ShapeReview

Column = NDArray[np.float64]

# More points than pixels only make the file large.
_LINE_POINTS = 1500
_POINT_COLOURS = {"A": BLUE, "B": ORANGE, "C": VIOLET}


def stability(shape: ShapeReview) -> str:
    """Heights at A, B, C; camera against laser; the map of the standard deviation; drift of the terms."""
    span_s = float(np.ptp(shape.time_s))
    every = max(1, shape.time_s.size // _LINE_POINTS)
    lines = {"time_s": shape.time_s, "sag": shape.sag_um, "laser": shape.laser_um, **shape.points_um}
    lines = broken_at_gaps({name: values[::every] for name, values in lines.items()})
    time, unit = hours_or_less(lines["time_s"], span_s)
    with picture(2, 2, 6.2, width_ratios=[1.9, 1]) as (figure, plots):
        points, sd, loops, drift = plots.ravel()
        for name in shape.points_um:
            points.plot(time, lines[name], color=_POINT_COLOURS[name], lw=0.9, label=name)
        points.set(title="Height at A, B and C since the first cycle, µm", xlabel=unit)
        points.legend(loc="upper right", ncols=3)
        _map(figure, sd, shape.sd_um, "Standard deviation of the height, µm", "viridis", (0, None))
        for name, (x, y) in POINTS.items():
            sd.plot(x, y, "o", ms=4, mfc="none", mec="white")
            sd.annotate(name, (x, y), color="white", fontsize=8, xytext=(4, 3), textcoords="offset points")
        loops.plot(time, lines["laser"], color=GREY, lw=0.9, label="laser (in the loop)")
        loops.plot(time, lines["sag"], color=BLUE, lw=0.9, label="sag by the camera")
        loops.set(title="In the loop and out of it: change of the centre, µm", xlabel=unit)
        loops.legend(loc="upper right", ncols=2)
        _drift(drift, shape)
        return svg(figure)


def _drift(plot: Any, shape: ShapeReview) -> None:
    noll = np.arange(2, 37)
    rate = np.array([term.per_hour for term in shape.drift_um_per_hour])
    reach = np.array([(term.high - term.low) / 2 for term in shape.drift_um_per_hour])
    colours = [RED if term.significant else GREY for term in shape.drift_um_per_hour]
    if np.isfinite(rate).any():
        plot.bar(noll, rate, yerr=reach, color=colours, error_kw={"lw": 0.7, "ecolor": "#555"})
        # one term that wandered, and whose interval says nothing, would hide all the others
        plot.set_yscale("symlog", linthresh=4 * max(float(np.nanmedian(reach)), 1e-6), linscale=2)
    plot.set(title="Drift of the terms, µm/h (95 %)", xlabel="Noll index")


def pairs(shape: ShapeReview) -> str:
    """Height change of a pair of cycles 1 and 10 minutes apart, and its uncertainty."""
    with picture(len(shape.pairs), 2, 3.4 * len(shape.pairs), squeeze=False) as (figure, plots):
        for (change, sigma), pair in zip(plots, shape.pairs, strict=True):
            most = float(np.nanmax(np.abs(pair.change_um))) or 1e-3
            title = f"Change over {pair.lag_s:.0f} s, µm (RMS {pair.rms_um:.3f})"
            _map(figure, change, pair.change_um, title, "RdBu_r", (-most, most))
            if pair.sigma_um is None:
                sigma.text(0.5, 0.5, "no covariance was recorded", ha="center", transform=sigma.transAxes)
                sigma.set_axis_off()
            else:
                title = f"Its uncertainty, 1 σ, µm (mean {pair.mean_sigma_um:.4f})"
                _map(figure, sigma, pair.sigma_um, title, "viridis", (0, None))
        return svg(figure)


def _map(figure: Any, plot: Any, values: Column, title: str, colours: str, span: tuple[float, float | None]) -> None:
    shown = plot.imshow(values, extent=(-1, 1, -1, 1), cmap=colours, vmin=span[0], vmax=span[1], interpolation="none")
    plot.set(title=title, xticks=[], yticks=[])
    plot.grid(False)
    for side in plot.spines.values():
        side.set_visible(False)
    figure.colorbar(shown, ax=plot, shrink=0.85)
