"""The measured figures as a page for people, made from the JSON file beside it."""

from __future__ import annotations

from typing import Any

HEAD = """# Measured figures

Made by `make bench` (or one part by `python -m benchmarks NAME`) from [bench.json](bench.json); not written by hand.
Each figure stands beside what it is compared with, measured in the same run; *ratio* is value over reference.
A target that was missed says so. `load` is that of the machine when the part began.
"""
COLUMNS = ("figure", "value", "unit", "reference", "ratio", "target", "met")


def page(report: dict[str, Any]) -> str:
    """Return the page of a report, as Markdown: one table a benchmark."""
    return "\n".join([HEAD, *(_section(name, entry) for name, entry in report.items())])


def _section(name: str, entry: dict[str, Any]) -> str:
    about = entry["machine"]
    lines = [
        f"## {name}",
        "",
        f"{entry['date_utc']}, {about['cores']} cores {about['cpu']}, {about['memory_gb']:.0f} GB, "
        f"Python {about['python']}, load {about['load_1min']}",
        "",
        f"| {' | '.join(COLUMNS)} |",
        f"|{'---|' * len(COLUMNS)}",
        *(f"| {' | '.join(_cells(figure))} |" for figure in entry["figures"]),
        "",
    ]
    return "\n".join(lines)


def _cells(figure: dict[str, Any]) -> list[str]:
    reference = figure["reference"]
    if figure["reference_value"] is not None:
        reference = f"{reference} {figure['reference_value']:.4g}".strip()
    return [
        figure["name"].replace("|", "\\|"),
        f"{figure['value']:.4g}",
        figure["unit"],
        reference,
        "" if figure["ratio"] is None else f"{figure['ratio']:.3g}",
        figure["target"].replace("<", "&lt;").replace(">", "&gt;"),
        {True: "yes", False: "**missed**", None: ""}[figure["met"]],
    ]
