"""Drawing benches of the second world, and the tables of their answers."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from membrane_ctrl.metrology.rays.surface import PARAMETERS
from membrane_ctrl.metrology.uncertainty.budget import Budget, Source
from tests.studies.resumable_answers import answers
from tests.studies.second_benches import draw_bench
from tests.studies.second_world_errors import MeasuredErrors
from tests.studies.second_world_tables import (
    blamed,
    expected_wrong_oks,
    held,
    is_true,
    page,
    refusals,
    share_far,
    wrong_oks,
)


def answer(seed: int, verdict: str, off: float, planted: dict[str, float], reason: str = "") -> Any:
    """An answer whose every error is `off` sigma."""
    one: dict[str, Any] = {"verdict": verdict, "reason": reason, "flagged": []}
    if verdict in ("ok", "degraded"):
        one |= {"error_um": [off] * 19, "sigma_um": [1.0] * 19}
    given: dict[str, Any] = {"seed": seed, "fine": bool(seed % 2), "planted": planted}
    given |= {"commit": "0123456789ab-dirty", "cpu_s": 2.0}
    given |= {"sets": [one, one]}
    if "error_um" in one:
        given |= {"change_error_um": [0.1] * 19, "change_sigma_um": [1.0] * 19}
    return given


GIVEN = [
    answer(0, "ok", 0.5, {}),
    answer(1, "ok", 3.5, {"flicker": 0.01}),
    answer(2, "rejected", 0, {"overexposed": 1.6}, "60 % of the pixels are saturated"),
    answer(3, "rejected", 0, {"blur, px of a quarter": 1.0}, "the picture is overexposed"),
    answer(4, "refused", 0, {}, "only 0 bins see the pattern in the mirror"),
    answer(5, "degraded", 2.5, {"stale frame": 3.0}, "1 frame flagged"),
]


def test_the_share_of_intervals_counts_usable_sets_alone() -> None:
    share, width, size = held(GIVEN, "height", slice(0, 1))
    assert (share, size) == (1 / 3, 3)  # 0.5 of 0.5, 3.5, 2.5
    assert width == pytest.approx(0.6745 / 2.5)


def test_a_wrong_ok_is_found_by_its_seed() -> None:
    assert [one["seed"] for _, one in wrong_oks(GIVEN)] == [1]


def test_wrong_oks_are_compared_with_those_of_exact_bars() -> None:
    lucky = answer(6, "ok", 0.5, {})
    lucky["sets"][0] |= {"chance_far": 0.25}
    degraded = answer(7, "degraded", 0.5, {})
    degraded["sets"][0] |= {"chance_far": 0.5}
    given = [*GIVEN, lucky, degraded]
    assert expected_wrong_oks(given) == 0.25
    assert share_far(given) == (1 / 3, 3 * 19)
    text = page({"quarter": given})
    assert "numbers of `ok` sets beyond 3 sigma, of 57 | 33.33 % | 0.27 % | 0.5 % |" in text
    assert "with one of their numbers beyond 3 sigma | 1, 12.5 % | 0.2, 3.1 % | |" in text


def test_the_chance_of_independent_numbers_is_that_of_a_normal_law() -> None:
    """36 independent terms of 1 sigma each: 1 - 0.9973^36."""
    effects_mm = np.eye(PARAMETERS)
    source = Source("all", "", 1.0, effects_mm)
    one = MeasuredErrors(
        "ok", "", (), None, None, None, np.eye(PARAMETERS), Budget((source,), 0.95)
    )
    assert one.chance_beyond(3.0) == pytest.approx(1 - 0.9973**PARAMETERS, abs=0.006)


def test_a_refusal_is_true_only_if_its_cause_was_planted() -> None:
    assert [is_right for is_right, _, _ in refusals(GIVEN)] == [True, False, None]


@pytest.mark.parametrize(
    ("statement", "cause"),
    [
        ("x_sin_3.png: stale: shows x_sin_2", "stale frame"),
        ("the picture is blurred by 1.2 px (1 sigma): focus the camera", "blur, px of a quarter"),
        ("the rim is 8.2 mm off the prediction", "geometry by hand"),
        ("12.0 % of the pixels are saturated; shorten the exposure", "overexposed"),
    ],
)
def test_a_statement_blames_its_cause(statement: str, cause: str) -> None:
    _, causes = blamed(statement)
    assert is_true(causes, [cause])
    assert not is_true(causes, ["gamma above 1"])


def test_a_possible_cause_is_not_reported_as_certain() -> None:
    name, causes = blamed("cause unknown; it looks like light from a second reflection")
    assert (name, causes) == ("", ())


def test_the_page_lists_the_worst_cases() -> None:
    text = page({"quarter": GIVEN, "full": GIVEN[:2], "eighth": []})
    assert "| 1 | 3.5 sigma | flicker 0.01 | `ok` |" in text
    assert "| 4 | - |  | refused: only 0 bins see the pattern in the mirror |" in text
    assert "6 benches at a quarter of the resolution, 2.0 s of a core each" in text
    assert "2 benches at full size" in text
    assert "with one of their numbers beyond 3 sigma | 1, 16.7 % |" in text


def test_a_seed_draws_the_same_bench_at_any_resolution() -> None:
    for seed in (0, 7):
        coarse, fine = draw_bench(seed, 0.125), draw_bench(seed, 0.25)
        assert coarse.planted == fine.planted
        assert coarse.world.mirror.material == fine.world.mirror.material
        places = (coarse.world.bench.camera.place_mm, fine.world.bench.camera.place_mm)
        assert np.array_equal(*places)


def test_all_causes_are_drawn_and_a_bench_has_about_three() -> None:
    counts: Counter[str] = Counter()
    benches = 300
    for seed in range(benches):
        counts.update(draw_bench(seed, 0.05).planted.keys())
    assert 3 < counts.total() / benches < 6
    assert {"second reflection, share", "previous picture, share", "no laser"} <= set(counts)


def test_answers_begin_at_any_seed_and_are_measured_once(tmp_path: Path) -> None:
    path = tmp_path / "answers.jsonl"
    asked: list[int] = []

    def measure(seed: int) -> dict[str, Any]:
        asked.append(seed)
        return {"seed": seed}

    answers(path, 2, measure, first=5)
    given = answers(path, 3, measure, first=5)
    assert [one["seed"] for one in given] == [5, 6, 7]
    assert asked == [5, 6, 7]
