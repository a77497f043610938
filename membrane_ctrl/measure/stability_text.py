"""The table of a stability run as lines of text."""

from collections.abc import Mapping
from typing import Any


def format_stability(table: Mapping[str, Any]) -> list[str]:
    """The table of `stability.json` as lines of text."""
    sets = table["sets"]
    sd_um = table["sd_um"]
    rmse_um = table["rmse_um"]
    out = [
        f"sets      {sets['used']} of {sets['found']} used, {sets['degraded']} degraded, "
        f"{sets['bad']} bad",
        f"SD        mean {sd_um['mean']:.4g} µm, largest {sd_um['max']:.4g} µm",
    ]
    first = table["first_set"]
    if first is not None:
        known = first["geometry_known"]
        reason = ""
        if first["reason"]:
            reason = f": {first['reason']}"
        out.append(f"first set {first['verdict']}{reason}")
        out.append(f"geometry  {known['state']}: {known['source']}")
    out += [
        f"point {name:3s} ({p['x_mm']:.0f}, {p['y_mm']:.0f}) mm: SD {p['sd_um']:.4g} µm, "
        f"peak to peak {p['peak_to_peak_um']:.4g} µm"
        for name, p in table["points"].items()
    ]
    out += [_pair_line(pair) for pair in table["pairs"]]
    return [
        *out,
        f"height    RMSE {rmse_um['mean']:.4g} µm, shared by all sets "
        f"({table['geometry']['source']})",
    ]


def _pair_line(pair: dict[str, Any]) -> str:
    lag = f"{pair['lag_s'] / 60:g} min"
    if not pair["count"]:
        return f"{lag:9s} no pairs"
    change_um = pair["change_rms_um"]["mean"]
    rmse_um = pair["rmse_um"]["mean"]
    return (
        f"{lag:9s} {pair['count']} pairs: change {change_um:.4g} µm RMS, RMSE {rmse_um:.4g} µm on "
        "average"
    )
