"""An address may try only so often."""

from __future__ import annotations

import random

from membrane_ctrl.bridges.connection_turns import Turns


def test_turns_come_back_with_time_and_memory_is_bounded() -> None:
    now_s = 0.0
    turns = Turns(lambda: now_s)
    assert [turns.take("a") for _ in range(12)] == [True] * 10 + [False] * 2
    assert turns.take("b")
    now_s = 0.5
    assert [turns.take("a"), turns.take("a")] == [True, False]
    now_s = 1000.0
    assert [turns.take("a") for _ in range(12)] == [True] * 10 + [False] * 2
    chance = random.Random(1)
    for _ in range(5000):
        turns.take(str(chance.random()))
    assert len(turns._left) == 1024
    assert turns.take("a")
