"""The parts of the document, in the order of the paper."""

from membrane_ctrl.paper import (
    convergence_parts,
    gradient_parts,
    monte_carlo_part,
    pattern_parts,
    profile_part,
    stability_parts,
    timing_parts,
)
from membrane_ctrl.paper.paper_part import PaperPart

PARTS = (
    PaperPart(
        "patterns", "Patterns and captured frames", "section 2.2", pattern_parts.compare_patterns
    ),
    PaperPart(
        "phases",
        "Wrapped phase, K1, K2 and absolute phase",
        "section 2.2, equations 1 and 2",
        pattern_parts.compare_phases,
        needs_truth=True,
    ),
    PaperPart("gray", "Gray-code table", "section 2.2", pattern_parts.compare_gray_table),
    PaperPart(
        "gradients",
        "From phase to slope",
        "section 2.3, equations 3 to 14",
        gradient_parts.compare_gradients,
        needs_truth=True,
    ),
    PaperPart(
        "convergence",
        "Convergence of the iteration",
        "section 2.4, equation 22",
        convergence_parts.compare_convergence,
        needs_angle=True,
    ),
    PaperPart(
        "starts",
        "Starting shapes",
        "section 2.4",
        convergence_parts.compare_starts,
        needs_angle=True,
    ),
    PaperPart("profile", "Surface and radial profile", "section 3.1", profile_part.compare_profile),
    PaperPart(
        "monte_carlo",
        "Monte Carlo of the height and of its change",
        "sections 3.1 and 3.2",
        monte_carlo_part.compare_monte_carlo,
        needs_angle=True,
    ),
    PaperPart("stability", "Stability and pairs", "section 3.2", stability_parts.compare_stability),
    PaperPart(
        "timings",
        "Timings",
        "sections 2.1, 2.4 and 4",
        timing_parts.compare_timings,
    ),
    PaperPart("limitations", "Limitations", "section 4", timing_parts.compare_limitations),
)
