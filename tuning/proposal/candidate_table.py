"""The candidates side by side: what each gives and costs, against the present gains."""

import math

from rich.console import Group
from rich.table import Table

from tuning.proposal import gain_search
from tuning.proposal.candidate import PRESENT, Candidate, find_refusal

HEADS = (
    "candidate",
    "K 1/s",
    "Ti s",
    "filter s",
    "std µm",
    "load peak µm",
    "recovery s",
    "Ms",
    "against present",
)
MARGIN_HEADS = ("Td s", "/ least", "flow std µm/s", "GM", "PM deg", "delay margin s", "disk margin")
_WORDS = {"std_um": "std", "load_peak_um": "load peak", "load_recovery_s": "recovery", "ms": "Ms"}
_DIGITS = {"std_um": 3, "load_peak_um": 2, "load_recovery_s": 1, "ms": 2}
_ALIKE = 0.02  # a smaller change is none


def format_cells(rows: tuple[Candidate, ...]) -> list[tuple[str, ...]]:
    """The cells under `HEADS`, the present gains first."""
    present = next((row for row in rows if row.name == PRESENT), None)
    ordered = sorted(rows, key=lambda row: row is not present)
    return [
        (row.name, *_format_gains(row), *_format_figures(row), describe_change(row, present))
        for row in ordered
    ]


def format_markdown(rows: tuple[Candidate, ...]) -> str:
    """The candidates as a Markdown table, with all margins."""
    heads = (*HEADS, *MARGIN_HEADS)
    margins = {row.name: _format_margins(row) for row in rows}
    lines = [
        heads,
        ("---", *["---:"] * (len(heads) - 1)),
        *((*line, *margins[line[0]]) for line in format_cells(rows)),
    ]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def format_terminal(rows: tuple[Candidate, ...], title: str, leak_um_per_s: float) -> Group:
    """The candidates for a terminal of 80 columns; `leak_um_per_s` is what the mirror loses now."""
    figures = Table(title=title, box=None, padding=(0, 1, 0, 0))
    words = Table("", "against the present gains", box=None, padding=(0, 1, 0, 0))
    for number, head in enumerate(HEADS[:-1]):
        figures.add_column(
            "\n".join(head.rsplit(" ", 1)), justify="right" if number else "left", no_wrap=True
        )
    for line in format_cells(rows):
        figures.add_row(*(cell.replace(" +- ", "+-") for cell in line[:-1]))
        words.add_row(line[0], line[-1])
    step = gain_search.Demands().load_step_um_per_s
    caption = (
        f"Load peak and recovery: after the leak grows from {leak_um_per_s:.2f} to "
        f"{leak_um_per_s + step:.2f} µm/s. "
        "+-: 1 sigma of the fit; for std with ten other minutes of weather like the "
        "observed, which change every std "
        "alike."
    )
    return Group(figures, "", words, "", caption)


def describe_change(row: Candidate, present: Candidate | None) -> str:
    """What gets better and what gets worse than with the present gains, as factors; or why it is
    not offered.
    """
    if row is present:
        return "in use"
    if why := find_refusal(row):
        return f"not offered: {why}"
    if present is None or present.predicted is None:
        return "the present gains are unstable"
    better: list[str] = []
    worse: list[str] = []
    for name, word in _WORDS.items():
        now, then = getattr(present.figures, name), getattr(row.figures, name)
        if not math.isnan(now - then) and not math.isclose(now, then, rel_tol=_ALIKE):
            factor = f" x {then / now:.2f}" if 0 < now < math.inf and then < math.inf else ""
            (better if then < now else worse).append(word + factor)
    return "; ".join(
        f"{word}: {', '.join(quantities)}"
        for word, quantities in (("better", better), ("worse", worse))
        if quantities
    )


def _format_gains(row: Candidate) -> tuple[str, ...]:
    gains = row.gains
    return f"{gains.kp_per_s:.3f}", f"{gains.ti_s:.2f}", f"{gains.filter_s:.2f}"


def _format_figures(row: Candidate) -> list[str]:
    if row.predicted is None:
        return ["unstable", "", "", ""]
    return [_format_figure(row, name, digits) for name, digits in _DIGITS.items()]


def _format_figure(row: Candidate, name: str, digits: int) -> str:
    value = float(getattr(row.figures, name))
    if math.isnan(value):
        return "not known"
    sigma = "" if row.sigma is None else f" +- {getattr(row.sigma, name):.{digits}f}"
    return f"{value:.{digits}f}{sigma}"


def _format_margins(row: Candidate) -> tuple[str, ...]:
    m, p = row.margins, row.predicted
    predicted = (f"{row.ratio:.2f}", f"{p.flow_std_um_per_s:.2f}") if p is not None else ("", "")
    margins = (
        f"{m.gain_margin:.1f}",
        f"{m.phase_margin_deg:.0f}",
        f"{m.delay_margin_s:.2f}",
        f"{m.disk_margin:.2f}",
    )
    return (f"{row.gains.td_s:.2f}", *predicted, *margins)
