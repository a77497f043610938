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
    measured = [each for each in found if not isinstance(each, str)]
    refusals = {each for each in found if isinstance(each, str)}
    if not measured:
        return f"| {effect.description} | - | - | - | rejected: {' / '.join(sorted(refusals))} |"
    verdicts = refusals | {"; ".join((each[2], *each[3])) for each in measured}
    errors = np.array([each[0] for each in measured])
    sigmas = np.array([each[1] for each in measured])
    worst = float(np.max(np.abs(errors) / sigmas))
    sag = f"{_rms(errors[:, :1]):.3g}, {_rms(sigmas[:, :1]):.3g}"
    figure = f"{_rms(errors[:, 9:]):.3g}, {_rms(sigmas[:, 9:]):.3g}"
    texts = " / ".join(sorted(verdicts))
    return f"| {effect.description} | {sag} | {figure} | {worst:.1f} | {texts} |"


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
