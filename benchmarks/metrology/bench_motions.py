"""Smallest motion of each part of the bench that tracking names, and what smaller ones cost.

`python -m benchmarks.metrology.bench_motions`: each degree of freedom grows by half from frame to
frame, from 1 to about 1500 µm or µrad. The world's rays share no code with the product.
"""

from __future__ import annotations

import contextlib
import io
import math
import shutil
import tempfile
from pathlib import Path

import numpy as np

from membrane_ctrl.cli import run
from tests.studies.tracked_errors import CLEAN, SIZE, TrackedErrors, compared
from tests.worlds.moving_bench import LENS, PARTS, TURNS, MovingBench

FRAME_S, STEPS, GROWING = 0.43, 5, 19
GROWTH = 1.5


def growing(time_s: float) -> float:
    """Amount at a time: 0 during the steps that anchor the frames."""
    number = round((time_s - 0.5) / FRAME_S) - STEPS
    return 0.0 if number < 0 else GROWTH**number


def tracked(reference: Path, folder: Path, part: str) -> TrackedErrors:
    """Errors while a part moves."""
    shutil.copytree(reference, folder / "full")
    scale = 0.01 if part.startswith("sensor") else 1.0  # 1 µm of the sensor: 60 µrad
    motions = {part: lambda t: scale * growing(t)}
    world = MovingBench(seed=2, **SIZE | CLEAN, motions=motions)  # type: ignore[arg-type]
    times = 0.5 + FRAME_S * np.arange(STEPS + GROWING)
    world.write_track(folder / "track", times, math.inf)
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        run(["track", str(folder / "track"), "--no-pictures"])
    return compared(world, folder)


def row(part: str, found: TrackedErrors) -> str:
    """A row of the table in docs/measurements/tracking.md."""
    scale = 0.01 if part.startswith("sensor") else 1.0
    unit = "µm"
    if part in TURNS:
        unit = "µrad"
    elif part == "focal":
        unit = "ppm"
    # The last frame before the first that is not `ok`, and the motion in it
    ok = np.array(found.verdicts) == "ok"
    refused = np.flatnonzero(~ok[STEPS:])
    last = STEPS + GROWING - 1
    if refused.size:
        last = STEPS + int(refused[0]) - 1
    amount = scale * GROWTH ** (last - STEPS)
    named = f"none up to {amount:.4g} {unit}"
    reason = ""
    if refused.size:
        named = f"{amount * GROWTH:.3g} {unit}"
        reason = found.reasons[last + 1].split(";")[0]
    # Errors of the usable frames, and of that last one with its error bars
    given = np.flatnonzero(found.given)
    usable = ok[given]
    figures = np.abs(found.moved_terms[usable, 2:]).max()
    sags = np.abs(found.moved_sag[usable]).max()
    place = int(np.flatnonzero(given == last)[0])
    figure_nm = 1e3 * np.abs(found.terms_um[place, 2:]).max()
    bar_nm = 1e3 * found.terms_sigma_um[place, 2:].max()
    sag_nm = 1e3 * abs(found.sag_um[place])
    sag_bar_nm = 1e3 * found.sag_sigma_um[place]
    return (
        f"| {part} | {named} | {figure_nm:.0f} ({bar_nm:.0f}) | {sag_nm:.0f} ({sag_bar_nm:.0f}) "
        f"| {figures:.1f}, {sags:.1f} | {reason} |"
    )


def main() -> None:
    """Print the table."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        MovingBench(seed=1, **SIZE | CLEAN).write_reference(folder / "full")  # type: ignore[arg-type]
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            run(["measure", str(folder / "full"), "--no-pictures"])
        print("| part | first degraded | last ok: figure, nm (bar) | sag, nm (bar) | worst of ok |")
        for part in (*PARTS, *TURNS, *LENS):
            print(row(part, tracked(folder / "full", folder / part, part)), flush=True)


if __name__ == "__main__":
    main()
