"""Fifth step of a session: simulate present and proposed gains on the fitted twin."""

from dataclasses import dataclass
from statistics import fmean

from membrane_ctrl.report_pages.blocks import PageSection, PageTable
from membrane_ctrl.sessions import folder, session_json
from tuning.gains_file import load_gains
from tuning.proposal import preview
from tuning.steps.identify import load_identified
from tuning.steps.observe import load_disturbance

_PREVIEW_SEEDS = 3


@dataclass(frozen=True, slots=True)
class Previewed:
    """`preview.json`: present and proposed gains on the fitted twin, one row per seed."""

    present: tuple[preview.Preview, ...]
    proposed: tuple[preview.Preview, ...]


def run_preview(session: folder.SessionFolder) -> Previewed:
    """Simulate present and proposed gains on the fitted twin with its one-sided pump, for several
    weather seeds.
    """
    session.require_done("design")
    found, disturbance = load_identified(session), load_disturbance(session)
    gains = load_gains(session.file_path("gains.toml"))
    session.begin_step("preview")
    pump, model = session.config.pump, found.identified.model
    present, proposed = (
        tuple(
            preview.preview_loop(loop, pump, model, disturbance, seed)
            for seed in range(1, _PREVIEW_SEEDS + 1)
        )
        for loop in (session.head.before, gains.loop)
    )
    done = Previewed(present, proposed)
    session_json.write_session_file(session.file_path("preview.json"), done)
    return done


def load_preview(session: folder.SessionFolder) -> Previewed:
    """Result of the preview."""
    return session.read_result("preview", "preview.json", Previewed)


def describe_result(session: folder.SessionFolder) -> str:
    """Present and proposed gains on the fitted twin in one line."""
    done = load_preview(session)

    def change(name: str, digits: int) -> str:
        present = fmean(getattr(seen, name) for seen in done.present)
        proposed = fmean(getattr(seen, name) for seen in done.proposed)
        return f"{present:.{digits}f} -> {proposed:.{digits}f}"

    return (
        f"on the fitted twin std {change('std_um', 3)} µm, load peak {change('load_peak_um', 2)} "
        f"µm, recovery {change('recovery_s', 1)} s"
    )


def make_report_part(session: folder.SessionFolder) -> PageSection | None:
    """The preview, for the report; None before the step is done."""
    if not session.is_done("preview"):
        return None
    done = load_preview(session)
    rows = [
        (
            name,
            f"{seen.std_um:.3f}",
            f"{seen.bias_um:+.3f}",
            f"{seen.load_peak_um:.2f}",
            f"{seen.recovery_s:.1f}",
        )
        for name, group in (("present", done.present), ("proposed", done.proposed))
        for seen in group
    ]
    heads = ("", "std", "bias", "load peak", "recovery s")
    return PageSection("Preview on the fitted twin", [PageTable(heads, rows)])
