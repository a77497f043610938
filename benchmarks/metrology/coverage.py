"""Coverage of the error bars of `measure` on random benches with an error in every input of the
budget.

A bench is drawn from the sigmas that `measure` states; the ray tracer of the twin, which shares no
code with the metrology, renders two sets minutes apart, and `measure`'s own steps measure them with
the stated bench. Every second bench has sigmas of a hundredth, so that light, blur and motion
count. The film has any Poisson ratio, and half of the films are stretched. The answers go to a
file, line by line: a stopped run continues at the next line. `python -m
benchmarks.metrology.coverage 60` measures up to 60 benches.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import numpy as np

from membrane_ctrl.geometry.spread_file import geometry_spread
from membrane_ctrl.metrology.cycle.live_reconstructor import LiveReconstructor
from membrane_ctrl.metrology.figure.set_motion import LASER_NOISE_UM
from membrane_ctrl.metrology.frame_checks.checked_set import RejectedSetError
from membrane_ctrl.metrology.phase.frame_stack import FrameStack
from membrane_ctrl.sim.optics.film_shape import typical_film
from membrane_ctrl.sim.optics.pattern_levels import Light
from tests.studies.measured_sets import TERMS, measured, quantities, truth_of
from tests.studies.resumable_answers import answers
from tests.support.figures import Figure, at_most
from tests.worlds.misstated_bench import (
    BentRays,
    FloatArray,
    Room,
    stated_bench,
    stated_sigmas,
    true_bench,
)

BENCHES = 100
ANSWERS = Path("logs/coverage.jsonl")
POINTS = 10  # of the map, at random
LIVE_BIN_PX = 2


def live_answer(live: LiveReconstructor, stack: FrameStack, truth: FloatArray) -> FloatArray | None:
    """Error, own sigma and geometry's sigma (3, 9) of sag and terms in µm, as a running hold has
    them.
    """
    found = live.measure_full(list(stack.frames), np.arange(18.0), stack.displacement_um)
    if found.verdict == "rejected":
        return None
    terms = list(TERMS)
    true_um = 1e3 * truth[: 1 + len(terms)]
    own = np.append(found.sag_change_sigma_um, np.sqrt(np.diag(found.covariance_um2)[terms]))
    common = np.append(
        found.geometry_sag_sigma_um, np.sqrt(np.diag(live.common_covariance_um2)[terms])
    )
    return np.stack([np.append(found.sag_um, found.coeffs_um[terms]) - true_um, own, common])


def bench(seed: int) -> dict[str, Any]:
    """One bench: errors over sigmas of the first set and of the change to the second."""
    rng = np.random.default_rng((2026, seed))
    stated = stated_bench(calibrated=bool(seed % 2))
    law = np.random.default_rng((2027, seed))
    slack, poisson = 10 ** law.uniform(-5, -3) * law.integers(2), law.uniform(0.25, 0.45)
    film = typical_film(37.1, 500.0, seed, slack, poisson)
    (there, _), room, sigmas = true_bench(stated, rng), Room.drawn(rng), stated_sigmas(stated)
    air_k_per_m, glass_mm = rng.standard_normal(2) * (sigmas.air_k_per_m, sigmas.glass_mm)
    renderer = BentRays(
        there,
        film,
        Light(gamma=room.gamma),
        seed=seed,
        air_k_per_m=air_k_per_m,
        glass_mm=abs(glass_mm),
    )

    def render(pattern: Any, displacement_um: float, gain: float) -> FloatArray:
        return renderer.render_picture(pattern, displacement_um, gain=gain).astype(float)

    radius, angle = 475 * np.sqrt(rng.random(POINTS)), 2 * np.pi * rng.random(POINTS)
    points_mm = np.stack([radius * np.cos(angle), radius * np.sin(angle)])
    rows = quantities(points_mm)
    found, answer = [], {"seed": seed, "calibrated": bool(seed % 2), "causes": room.causes()}
    spread, _ = geometry_spread(stated, None)
    live, seen_live = (
        LiveReconstructor(stated, LIVE_BIN_PX, laser_noise_um=LASER_NOISE_UM, spread=spread),
        [],
    )
    for _ in range(2):
        stack = room.stack(render, rng, stated.camera)
        truth = truth_of(film, room.mean_um, points_mm)
        seen_live.append(live_answer(live, stack, truth) if room.laser else None)  # a hold has one
        try:
            full, examined, verdict = measured(stack, stated)
        except RejectedSetError as error:
            return answer | {"verdict": "rejected", "reason": str(error)}
        if verdict == "rejected":
            return answer | {"verdict": "rejected", "reason": "quality"}
        # without a laser, which pressure the figure belongs to is unknown: the truth is at the mean
        found.append(
            (rows @ full.surface.parameters - truth, examined.budget, verdict, examined.doubts)
        )
    (first, budget, verdict, doubts), (second, later, _, _) = found
    covariances = (
        budget.covariance(True) + budget.covariance(False),
        later.change_covariance(budget),
    )
    sigma, change = (np.sqrt(np.einsum("ij,jk,ik->i", rows, c, rows)) for c in covariances)
    first_live, second_live = seen_live
    if first_live is not None and second_live is not None:
        answer |= {
            "live_error_um": first_live[0].tolist(),
            "live_sigma_um": np.hypot(first_live[1], first_live[2]).tolist(),
            "live_change_error_um": (second_live[0] - first_live[0]).tolist(),
            "live_change_sigma_um": np.hypot(first_live[1], second_live[1]).tolist(),
        }
    return answer | {
        "verdict": verdict,
        "doubts": list(doubts),
        "error_um": (1e3 * first).tolist(),
        "sigma_um": (1e3 * sigma).tolist(),
        "change_error_um": (1e3 * (second - first)).tolist(),
        "change_sigma_um": (1e3 * change).tolist(),
    }


def held(
    given: list[dict[str, Any]], of: str, part: slice = slice(None)
) -> tuple[float, float, int]:
    """Share of 95 % intervals that hold the truth, bar over scatter (1 is sharp), and intervals."""
    pairs = [
        (one[f"{of}error_um"][part], one[f"{of}sigma_um"][part])
        for one in given
        if f"{of}error_um" in one
    ]
    if not pairs:
        return math.nan, math.nan, 0
    error, sigma = np.array(pairs).transpose(1, 0, 2)
    ratio = np.abs(error) / sigma
    return float(np.mean(ratio < 1.96)), 0.6745 / float(np.median(ratio)), error.size


_ANSWERED = {
    "": "height",
    "change_": "change",
    "live_": "live cycle",
    "live_change_": "live change",
}
_PARTS = {"sag": slice(0, 1), "Z4..Z11": slice(1, 9), "map": slice(9, None)}


def run(count: int = BENCHES) -> list[Figure]:
    """Coverage by quantity, for heights and for changes."""
    given = answers(ANSWERS, count, bench)
    figures = []
    for state in (False, True):
        some = [one for one in given if one["calibrated"] == state]
        name = "sigmas / 100" if state else "sigmas by hand"
        for of, what in _ANSWERED.items():
            for quantity, part in _PARTS.items():
                share, width, size = held(some, of, part)
                if not size:
                    continue
                label = f"{name}, {what}: {quantity} in its 95 % interval ({size})"
                figures.append(
                    Figure(label, 100 * share, "%", "width over scatter", width, "93 .. 97")
                )
    accepted = [one for one in given if one["verdict"] == "ok"]
    far = sum(max(np.abs(one["error_um"]) / np.array(one["sigma_um"])) > 3 for one in accepted)
    label = f"'ok' with an error above 3 sigma, of {len(given)}"
    figures.append(at_most(label, 100 * far / len(given), "%", 0.5))
    figures.append(
        Figure(
            "rejected", 100 * sum(one["verdict"] == "rejected" for one in given) / len(given), "%"
        )
    )
    return figures


def table(given: list[dict[str, Any]]) -> list[str]:
    """Coverage for the sets with each cause, as lines of a page."""
    head = (
        "| cause | benches | height % | change % | live cycle % | live change % | width of "
        "change over scatter |"
    )
    lines = [head, "|" + 7 * "---|"]
    every = sorted({cause for one in given for cause in one["causes"]})
    for cause in ["(all)", *every]:
        some = [one for one in given if cause == "(all)" or cause in one["causes"]]
        shares = " | ".join(
            f"{100 * held(some, of)[0]:.0f}" for of in ("", "change_", "live_", "live_change_")
        )
        lines.append(f"| {cause} | {len(some)} | {shares} | {held(some, 'change_')[1]:.1f} |")
    return lines


if __name__ == "__main__":
    wanted = int(sys.argv[1]) if len(sys.argv) > 1 else BENCHES
    for figure in run(wanted):
        print(f"{figure.name}: {figure.value:.1f} {figure.unit} {figure.reference_value or ''}")
    print("\n".join(table(answers(ANSWERS, wanted, bench))))
