"""The report of a calibration (`report.calibration_report`) as lines for a terminal."""

from collections.abc import Sequence
from typing import Any

from membrane_ctrl.metrology.calibration import screen_advice
from membrane_ctrl.metrology.rays import bench_parameters

_SOME_LASER = 0.5  # sigma of the laser's scale without any reading: 1
_SCREENS = {
    "screen": "stand the screen itself {:.0f} mm before the camera, "
    "tilted by {:.0f} degrees to two sides",
    "screen_moved": "see a film again with the screen {:.0f} mm further from the mirror, "
    "known to {:g} mm",
}
_SCREEN_KNOWN = {"screen": screen_advice.TILT_DEG, "screen_moved": screen_advice.RAIL_SIGMA_MM}


def format_report(report: dict[str, Any]) -> list[str]:
    """Format the report of `calibration_report` for a terminal."""
    lines = [f"verdict: {report['verdict']}"]
    for finding in report["findings"]:
        mark = "  note: "
        if finding["fatal"]:
            mark = "  ! "
        lines.append(mark + finding["description"])
    if "parameters" not in report:
        return lines

    lines += _format_parameters(report["parameters"])
    lines += _format_sets(report["sets"])
    # What the geometry is good for, and what would make it better.
    claim = report["uncertainty"]
    lines.append(
        f"figure with this geometry: sag +- {claim['sag_um']:.2f} µm, figure +- "
        f"{claim['figure_rms_um']:.2f} µm RMS, with its tilt +- {claim['height_rms_um']:.1f} µm RMS"
    )
    lines += _format_advice(report)

    # Checks: the laser's scale, and what these sets leave open.
    laser = report["laser"]
    if laser["sigma"] < _SOME_LASER:
        lines.append(f"laser against optics: {laser['scale']:.5f} +- {laser['sigma']:.5f}")
    lines.append(f"condition number {report['condition']:.2g}; not determined by the sets:")
    for each in report["not_determined"]:
        lines.append(f"  {each['sigma_left']:.0%} left: {each['description']}")
    if not report["not_determined"]:
        lines.append("  nothing")
    if report.get("out"):
        lines.append(f"written: {report['out']} (hash {report['hash']})")
    return lines


def _format_parameters(rows: Sequence[dict[str, Any]]) -> list[str]:
    """The table of the free parameters."""
    lines = ["what           stated wrong by   +-        known before"]
    for row in rows:
        description = bench_parameters.ALL[bench_parameters.NAMES.index(row["name"])].description
        lines.append(
            f"{row['name']:<18}{row['value']:>+11.4f}  {row['sigma']:<9.4f} "
            f"{row['sigma_before']:<8.4g} {description}"
        )
    return lines


def _format_sets(rows: Sequence[dict[str, Any]]) -> list[str]:
    """The table of the sets, then what was found of turned ones.

    An artefact has its name in place of the reading.
    """
    lines = ["set                 reading µm   sag mm    noise  residual µm  against the others"]
    for row in rows:
        if row["surface"] != "film":
            reading = row["surface"]
        elif row["displacement_um"] is None:
            reading = "-"
        else:
            reading = f"{row['displacement_um']:.1f}"
        lines.append(
            f"{row['name']:<18}{reading:>12}{row['sag_mm']:>10.4f}{row['noise_ratio']:>8.2f}"
            f"{row['screen_residual_um']:>12.2f}  {row['left_out_fall']:.0f} of "
            f"{row['left_out_freedom']} expected"
        )
    for row in rows:
        turn = row["turned"]
        if turn is not None:
            lines.append(
                f"{row['name']}: mirror turned by {turn['found_deg']:.2f} +- "
                f"{turn['sigma_deg']:.2f} degrees ({turn['angle_deg']:g} stated), its axis at "
                f"({turn['x_mm']:+.2f}, {turn['y_mm']:+.2f}) +- {turn['seat_sigma_mm']:.2f} mm"
            )
    return lines


def _format_advice(report: dict[str, Any]) -> list[str]:
    """What to measure next: a number of the bench, a sphere, or sets of the screen."""
    lines = []
    number = report["advice"]
    if number is not None:
        unit = bench_parameters.ALL[bench_parameters.NAMES.index(number["name"])].unit
        known = f"{number['sigma']:.2g} {unit}".strip()
        lines.append(
            f"best next: {number['name']} known to {known} would give sag +- "
            f"{number['sag_um']:.2g} µm"
        )

    sphere = report["artefact_advice"]
    if sphere is not None:
        confused = " and ".join(sphere["together"][:2])
        why = "better: put"
        if confused:
            why = f"not separable with these sets: {confused}; put"
        lines.append(
            f"{why} a sphere of about {sphere['curvature_radius_mm']:.0f} mm (known to "
            f"{sphere['curvature_radius_sigma_mm']:.2g} mm, its vertex to "
            f"{sphere['vertex_sigma_mm']:.2g} mm, {2 * sphere['radius_mm']:.0f} mm wide) in the "
            f"mirror's place: sag +- {sphere['sag_um']:.2g} µm"
        )

    for order, each in zip(
        ("with the screen alone", "and then"), report["screen_advice"], strict=False
    ):
        distance_mm = abs(each["distance_mm"])
        action = _SCREENS[each["sets"]].format(distance_mm, _SCREEN_KNOWN[each["sets"]])
        lines.append(f"{order}: {action}: sag +- {each['sag_um']:.2g} µm")
    return lines
