"""The result of a benchmark: a figure, its reference from the same run, and its target."""

from __future__ import annotations

import os
import platform
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table


@dataclass(frozen=True, slots=True)
class Figure:
    """One measured number.

    Attributes
    ----------
    name, unit : str
    value : float
    reference : str
        Name of the reference.
    reference_value : float or None
        Measured or computed in the same run, same unit.
    target : str
        For people, e.g. "<= 0.25"; empty if there is none.
    met : bool or None
        Whether the target is met.
    """

    name: str
    value: float
    unit: str
    reference: str = ""
    reference_value: float | None = None
    target: str = ""
    met: bool | None = None

    @property
    def ratio(self) -> float | None:
        """Value over reference."""
        return None if not self.reference_value else self.value / self.reference_value


def at_most(
    name: str,
    value: float,
    unit: str,
    limit: float | None = None,
    reference: str = "",
    reference_value: float | None = None,
) -> Figure:
    """A figure that should not be more than `limit`."""
    if limit is None:
        return Figure(name, value, unit, reference, reference_value)
    return Figure(
        name, value, unit, reference, reference_value, f"<= {limit:g}", bool(value <= limit)
    )


def at_least(
    name: str,
    value: float,
    unit: str,
    limit: float,
    reference: str = "",
    reference_value: float | None = None,
) -> Figure:
    """A figure that should not be less than `limit`."""
    return Figure(
        name, value, unit, reference, reference_value, f">= {limit:g}", bool(value >= limit)
    )


def machine() -> dict[str, Any]:
    """The machine of the figures."""
    model = next(
        (
            line.split(":", 1)[1].strip()
            for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
            if line.startswith("model name")
        ),
        platform.processor(),
    )
    return {
        "cpu": model,
        "cores": os.cpu_count(),
        "memory_gb": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1),
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "load_1min": round(os.getloadavg()[0], 2),
    }


def show(title: str, figures: list[Figure]) -> None:
    """Print a table."""
    table = Table(title=title, title_justify="left")
    for column in ("figure", "value", "unit", "reference", "ratio", "target", "met"):
        table.add_column(column, justify="right" if column in {"value", "ratio"} else "left")
    for f in figures:
        reference = (
            f"{f.reference} {f.reference_value:.4g}"
            if f.reference_value is not None
            else f.reference
        )
        table.add_row(
            f.name,
            f"{f.value:.4g}",
            f.unit,
            reference,
            "" if f.ratio is None else f"{f.ratio:.3g}",
            f.target,
            {True: "yes", False: "MISSED", None: ""}[f.met],
        )
    Console(width=150).print(table)


def as_json(figures: list[Figure]) -> list[dict[str, Any]]:
    """The figures as plain data."""
    return [{**asdict(f), "ratio": f.ratio} for f in figures]
