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
_NO_CHANGE = 0.02  # relative: a smaller change is not named


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
    """Format the candidates for a terminal of 80 columns.

    Parameters
    ----------
    rows : tuple of Candidate
        The present gains among them, if they are to be compared.
    title : str
        Above the table.
    leak_um_per_s : float
        What the mirror loses now, for the caption.
    """
    figures = Table(title=title, box=None, padding=(0, 1, 0, 0))
    words = Table("", "against the present gains", box=None, padding=(0, 1, 0, 0))
    for number, head in enumerate(HEADS[:-1]):
        two_lines = "\n".join(head.rsplit(" ", 1))  # the unit below the name
        figures.add_column(two_lines, justify="right" if number else "left", no_wrap=True)
    for line in format_cells(rows):
        figures.add_row(*(cell.replace(" +- ", "+-") for cell in line[:-1]))
        words.add_row(line[0], line[-1])
    step = gain_search.Demands().load_step_um_per_s
    caption = (
        f"Load peak and recovery: after the leak grows from {leak_um_per_s:.2f} to "
        f"{leak_um_per_s + step:.2f} µm/s. +-: 1 sigma of the fit; for std with ten other minutes "
        "of weather like the observed, which change every std equally."
    )
    return Group(figures, "", words, "", caption)


def describe_change(row: Candidate, present: Candidate | None) -> str:
    """Describe which figures get better and which worse than with the present gains, as factors.

    Parameters
    ----------
    row : Candidate
        The candidate.
    present : Candidate or None
        The present gains; None if they are not in the table.

    Returns
    -------
    str
        Or why the candidate is not offered.
    """
    if row is present:
        return "in use"
    if why := find_refusal(row):
        return f"not offered: {why}"
    if present is None or present.predicted is None:
        return "the present gains are unstable"
    # For every figure a smaller value is better. A factor is given only between two finite values:
    # a recovery that never ended before has none.
    better: list[str] = []
    worse: list[str] = []
    for name, word in _WORDS.items():
        now = getattr(present.figures, name)
        then = getattr(row.figures, name)
        if math.isnan(now - then) or math.isclose(now, then, rel_tol=_NO_CHANGE):
            continue
        changed = word
        if 0 < now < math.inf and then < math.inf:
            changed = f"{word} x {then / now:.2f}"
        if then < now:
            better.append(changed)
        else:
            worse.append(changed)
    parts = []
    if better:
        parts.append(f"better: {', '.join(better)}")
    if worse:
        parts.append(f"worse: {', '.join(worse)}")
    return "; ".join(parts)


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
    if row.sigma is None:
        return f"{value:.{digits}f}"
    return f"{value:.{digits}f} +- {getattr(row.sigma, name):.{digits}f}"


def _format_margins(row: Candidate) -> tuple[str, ...]:
    """The cells under `MARGIN_HEADS`; the predicted ones are empty for an unstable loop."""
    predicted = ("", "")
    if row.predicted is not None:
        predicted = (f"{row.ratio:.2f}", f"{row.predicted.flow_std_um_per_s:.2f}")
    margins = (
        f"{row.margins.gain_margin:.1f}",
        f"{row.margins.phase_margin_deg:.0f}",
        f"{row.margins.delay_margin_s:.2f}",
        f"{row.margins.disk_margin:.2f}",
    )
    return (f"{row.gains.td_s:.2f}", *predicted, *margins)
