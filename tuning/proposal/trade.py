"""What each candidate gives and what it costs, against the present gains."""

import math

from pydantic import ValidationError
from rich.console import Group
from rich.table import Table

from membrane_ctrl.config.schema import LoopConfig
from tuning.gains_file import MS_MAX
from tuning.proposal import candidates, design

HEADS = ("candidate", "K 1/s", "Ti s", "filter s", "std um", "load peak um", "recovery s", "Ms", "against present")
MARGIN_HEADS = ("Td s", "/ least", "flow std um/s", "GM", "PM deg", "delay margin s", "disk margin")
_WORDS = {"std_um": "std", "load_peak_um": "load peak", "load_recovery_s": "recovery", "ms": "Ms"}
_DIGITS = {"std_um": 3, "load_peak_um": 2, "load_recovery_s": 1, "ms": 2}
_ALIKE = 0.02  # a smaller change is none


def cells(rows: tuple[design.Candidate, ...]) -> list[tuple[str, ...]]:
    """The cells under `HEADS`, the present gains first."""
    present = next((row for row in rows if row.name == design.PRESENT), None)
    ordered = sorted(rows, key=lambda row: row is not present)
    return [(row.name, *_gains(row), *_figures(row), against(row, present)) for row in ordered]


def table(rows: tuple[design.Candidate, ...]) -> str:
    """The candidates as a Markdown table, with all margins."""
    heads = (*HEADS, *MARGIN_HEADS)
    margins = {row.name: _margins(row) for row in rows}
    lines = [heads, ("---", *["---:"] * (len(heads) - 1)), *((*line, *margins[line[0]]) for line in cells(rows))]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def shown(rows: tuple[design.Candidate, ...], title: str, leak_um_per_s: float) -> Group:
    """The candidates for a terminal of 80 columns; `leak_um_per_s` is what the mirror loses now."""
    figures = Table(title=title, box=None, padding=(0, 1, 0, 0))
    words = Table("", "against the present gains", box=None, padding=(0, 1, 0, 0))
    for number, head in enumerate(HEADS[:-1]):
        figures.add_column("\n".join(head.rsplit(" ", 1)), justify="right" if number else "left", no_wrap=True)
    for line in cells(rows):
        figures.add_row(*(cell.replace(" +- ", "+-") for cell in line[:-1]))
        words.add_row(line[0], line[-1])
    step = candidates.Demands().load_step_um_per_s
    caption = (
        f"Load peak and recovery: after the leak grows from {leak_um_per_s:.2f} to {leak_um_per_s + step:.2f} um/s. "
        "+-: 1 sigma of the fit; for std with ten other minutes of weather like the observed, which change every std "
        "alike."
    )
    return Group(figures, "", words, "", caption)


def against(row: design.Candidate, present: design.Candidate | None) -> str:
    """What gets better and what gets worse than with the present gains, as factors; or why it is not offered."""
    if row is present:
        return "in force"
    if why := refusal(row):
        return f"not offered: {why}"
    if present is None or present.predicted is None:
        return "the present gains are unstable"
    better: list[str] = []
    worse: list[str] = []
    for name, word in _WORDS.items():
        now, then = getattr(present.figures, name), getattr(row.figures, name)
        if not math.isclose(now, then, rel_tol=_ALIKE):
            factor = f" x {then / now:.2f}" if 0 < now < math.inf and then < math.inf else ""
            (better if then < now else worse).append(word + factor)
    return "; ".join(f"{word}: {', '.join(said)}" for word, said in (("better", better), ("worse", worse)) if said)


def refusal(row: design.Candidate) -> str:
    """Why these gains must not be applied; empty if they may."""
    if row.predicted is None:
        return "unstable"
    if row.margins.ms > MS_MAX:
        return f"Ms {row.margins.ms:.2f}, the limit is {MS_MAX:g}"
    try:
        row.gains.applied_to(LoopConfig())
    except ValidationError:
        return "outside the range of the configuration"
    return ""


def _gains(row: design.Candidate) -> tuple[str, ...]:
    gains = row.gains
    return f"{gains.kp_per_s:.3f}", f"{gains.ti_s:.2f}", f"{gains.filter_s:.2f}"


def _figures(row: design.Candidate) -> list[str]:
    if row.predicted is None:
        return ["unstable", "", "", ""]
    found = [f"{getattr(row.figures, name):.{digits}f}" for name, digits in _DIGITS.items()]
    if row.sigma is None:
        return found
    sigmas = [f"{getattr(row.sigma, name):.{digits}f}" for name, digits in _DIGITS.items()]
    return [f"{value} +- {sigma}" for value, sigma in zip(found, sigmas, strict=True)]


def _margins(row: design.Candidate) -> tuple[str, ...]:
    m, p = row.margins, row.predicted
    predicted = (f"{row.ratio:.2f}", f"{p.flow_std_um_per_s:.2f}") if p is not None else ("", "")
    margins = f"{m.gain_margin:.1f}", f"{m.phase_margin_deg:.0f}", f"{m.delay_margin_s:.2f}", f"{m.disk_margin:.2f}"
    return (f"{row.gains.td_s:.2f}", *predicted, *margins)
