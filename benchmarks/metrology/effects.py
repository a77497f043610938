"""One effect at a time that `measure` does not know: true error, error bar and verdict.

The benches are those of `benchmarks.metrology.coverage`, rendered by the twin's ray tracer, exact
but for the one effect; four films each, an eighth of the resolution. Effects of the light and of
the film have sigmas of a hundredth, so that the bar is not that of the geometry. Sets have a laser
unless said. `python -m benchmarks.metrology.effects` prints the table of
docs/measurements/uncertainty.md; it takes a minute.
"""

from __future__ import annotations

import numpy as np

from tests.studies.effects_alone import EFFECTS, Effect, FloatArray, answer

FILMS = 4


def row(effect: Effect) -> str:
    """One line of the table: RMS over the films."""
    found = [answer(effect, seed) for seed in range(FILMS)]
    good = [each for each in found if not isinstance(each, str)]
    said = {each if isinstance(each, str) else "; ".join((each[2], *each[3])) for each in found}
    if not good:
        return f"| {effect.description} | - | - | - | rejected: {' / '.join(sorted(said))} |"
    errors, sigmas = (np.array([each[k] for each in good]) for k in (0, 1))
    worst = float(np.max(np.abs(errors) / sigmas))
    cells = [
        f"{_rms(part[:, where]):.3g}"
        for where in (slice(0, 1), slice(9, None))
        for part in (errors, sigmas)
    ]
    figures = f"{cells[0]}, {cells[1]} | {cells[2]}, {cells[3]} | {worst:.1f}"
    return f"| {effect.description} | {figures} | {' / '.join(sorted(said))} |"


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


if __name__ == "__main__":
    print(
        "| effect | sag: error, sigma, µm | map: error, sigma, µm RMS | worst error / sigma "
        "| verdict |"
    )
    print("|---|---|---|---|---|")
    for each in EFFECTS:
        print(row(each), flush=True)
