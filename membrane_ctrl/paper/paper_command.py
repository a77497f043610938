"""The `paper` command: each figure and table of the paper, computed again."""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from membrane_ctrl.measure.result_files import write_json
from membrane_ctrl.model import errors, files, program
from membrane_ctrl.paper.bench import (
    MeasuredBench,
    PaperBench,
    PaperOptions,
    RecordedBench,
    fingerprint_sets,
)
from membrane_ctrl.paper.comparison import PartResult, round_numbers
from membrane_ctrl.paper.document import count_agreements, render_document
from membrane_ctrl.paper.paper_part import PaperPart
from membrane_ctrl.paper.parts import PARTS
from membrane_ctrl.paper.stored_parts import PartFolder

# `--quick`: a sixth of the pixels along a side, and as many sets as pairs 10 minutes apart need.
QUICK = PaperOptions(shrink=6, sets=160, trials=40)


@dataclass(frozen=True, slots=True)
class PaperCommand:
    """Options of the command.

    Attributes
    ----------
    out : Path
        Folder of the document.
    options : PaperOptions
        Size of the computation.
    sets : Path or None
        Recorded sets instead of simulated ones.
    only : sequence of str
        Names of the parts to compute; all if empty.
    as_json : bool
        Print the numbers instead of a summary.
    arguments : str
        The command's own options, for the document.
    """

    out: Path
    options: PaperOptions
    sets: Path | None = None
    only: Sequence[str] = field(default=())
    as_json: bool = False
    arguments: str = ""


def paper_command(asked: PaperCommand) -> int:
    """Compute the parts, write the document, and report. Raises CommandError."""
    known = [part.name for part in PARTS]
    unknown = sorted(set(asked.only) - set(known))
    if unknown:
        raise errors.InputError(f"--only {unknown[0]}: one of {', '.join(known)}")
    bench: MeasuredBench = PaperBench(asked.options)
    fingerprint = None
    if asked.sets is not None:
        recorded = RecordedBench(asked.options, asked.sets)
        fingerprint = fingerprint_sets(recorded.folders)
        bench = recorded
    parts = [part for part in PARTS if asked.sets is None or not part.needs_truth]
    if not bench.has_angle:
        # a part that is asked for by name fails with the reason
        left_out = [part for part in parts if part.needs_angle and part.name not in asked.only]
        parts = [part for part in parts if part not in left_out]
        names = ", ".join(part.name for part in left_out)
        print(f"left out: {names} (they need a_mm, b_mm and alpha_deg)", file=sys.stderr)

    with errors.convert_write_errors(asked.out):
        stored = PartFolder(files.make_folder(asked.out / "parts"), asked.options, fingerprint)
    results: dict[PaperPart, PartResult] = {}
    for part in parts:
        result = stored.read_part(part)
        if result is None and (not asked.only or part.name in asked.only):
            print(f"{part.title} ...", file=sys.stderr)
            result = part.compute(bench)
            result = replace(result, numbers=round_numbers(result.numbers))
            with errors.convert_write_errors(asked.out):
                stored.write_part(part, result)
        if result is not None:
            results[part] = result
    with errors.convert_write_errors(asked.out):
        _write_document(asked, bench, results)
    print(f"written to {asked.out}", file=sys.stderr)
    print(json.dumps(_make_table(asked, results)) if asked.as_json else _summarise(results))
    return 0


def _write_document(
    asked: PaperCommand, bench: MeasuredBench, results: dict[PaperPart, PartResult]
) -> None:
    """Write the page, the PDF and the table."""
    camera = bench.optics.camera
    options = asked.options
    if asked.sets is None:
        described = (
            f"Simulated frames of {camera.width_px} x {camera.height_px} pixels, {options.sets} "
            f"sets, {options.trials} trials, seed {options.seed}."
        )
    else:
        described = f"Recorded sets of {asked.sets.name}, {options.trials} trials."
    described += f" Program {program.file_origin('')['program']}."
    page, pdf = render_document(results, described, f"membrane-ctrl paper{asked.arguments}")
    files.write_text_atomic(asked.out / "paper.html", page)
    files.write_bytes_atomic(asked.out / "paper.pdf", pdf)
    write_json(asked.out / "paper.json", _make_table(asked, results))


def _make_table(asked: PaperCommand, results: dict[PaperPart, PartResult]) -> dict[str, Any]:
    """The content of `paper.json`."""
    options = asked.options
    return {
        **program.file_origin("membrane-paper/1"),
        "shrink": options.shrink,
        "sets": options.sets,
        "trials": options.trials,
        "seed": options.seed,
        "numbers": {part.name: dict(result.numbers) for part, result in results.items()},
        "timing_s": {
            part.name: dict(result.timing_s) for part, result in results.items() if result.timing_s
        },
        "comparisons": {
            part.name: [
                [each.quantity, each.paper, each.ours, str(each.agreement), each.note]
                for each in result.comparisons
            ]
            for part, result in results.items()
        },
    }


def _summarise(results: dict[PaperPart, PartResult]) -> str:
    """One line a part, and the sum."""
    lines = []
    for part, result in results.items():
        counts = count_agreements({part: result})
        shares = ", ".join(f"{count} {agreement}" for agreement, count in counts.items() if count)
        lines.append(f"{part.name:12} {part.title}: {shares}")
    return "\n".join(lines)
