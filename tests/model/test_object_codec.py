"""Objects as plain data: exact both ways, and nothing returns that a class does not declare."""

from __future__ import annotations

import json
import math
from collections import deque
from dataclasses import dataclass, field
from enum import Enum, IntEnum
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from membrane_ctrl.model.object_codec import CodecError, Decoder, encode


class Level(IntEnum):
    LOW = 0
    HIGH = 1


class Colour(Enum):
    RED = "r"


@dataclass(frozen=True, slots=True)
class Leaf:
    value: float
    word: str = ""


@dataclass(slots=True)
class Facts:
    number: float = 0.1
    count: int = 3
    yes: bool = True
    way: Literal["up", "down"] | None = "up"
    leaf: Leaf | None = None
    pair: tuple[int, float] = (1, math.pi)
    marks: tuple[int, ...] = ()
    names: set[str] = field(default_factory=set)
    levels: dict[Level, float] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    colour: Colour = Colour.RED
    free: list[dict[str, Any]] = field(default_factory=list)
    values: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))


class Machine:
    """No dataclass: what it declares is in its methods."""

    def __init__(self) -> None:
        self.facts = Facts()
        self._latest: deque[float] = deque(maxlen=3)
        self._leaf: Leaf | None = None
        self._history = [0, 1]
        self._since_s = math.nan


@pytest.fixture(autouse=True)
def ours(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("membrane_ctrl.model.object_codec._OURS", (__name__,))


def written(machine: Machine) -> Any:
    return json.loads(json.dumps(encode(machine, {})))


def read(data: Any) -> Machine:
    found = Decoder((Machine(),), {}).decode(data, Machine)
    assert isinstance(found, Machine)
    return found


def full() -> Machine:
    machine = Machine()
    machine.facts = Facts(
        number=-0.0,
        leaf=Leaf(5e-324, "\N{BELL}\N{SNOWMAN}"),
        marks=(1, 2, 3),
        names={"a", "b"},
        levels={Level.HIGH: math.inf},
        counts={"x": 2**62},
        free=[{"kind": "fault", "deep": [1, {"a": None}]}],
        values=np.random.default_rng(1).normal(size=(3, 2)),
    )
    machine._latest.extend([1.0, 2.0, 3.0, 4.0])
    machine._leaf = Leaf(1e308)
    machine._since_s = 0.1 + 0.2
    return machine


def test_everything_comes_back_to_the_last_bit() -> None:
    machine, again = full(), read(written(full()))
    was, now = machine.facts, again.facts
    for name in ("leaf", "pair", "marks", "names", "levels", "counts", "colour", "free", "way"):
        assert getattr(now, name) == getattr(was, name)
        assert type(getattr(now, name)) is type(getattr(was, name))
    assert math.copysign(1.0, now.number) == -1.0
    assert type(next(iter(now.levels))) is Level
    assert now.values.tobytes() == was.values.tobytes()
    assert now.values.shape == (3, 2)
    assert now.values.flags.writeable
    assert again._latest == deque([2.0, 3.0, 4.0], maxlen=3)
    assert again._latest.maxlen == 3
    assert again._since_s == machine._since_s
    assert math.isnan(read(written(Machine()))._since_s)


def test_a_numpy_number_stays_one() -> None:
    machine = full()
    machine._since_s = np.float64(0.1)
    machine.facts.count = np.int64(7)
    again = read(written(machine))
    assert (type(again._since_s), type(again.facts.count)) == (np.float64, np.int64)


def changed(**values: object) -> Any:
    data = written(full())
    data["facts"] |= values
    return data


@pytest.mark.parametrize(
    "values",
    [
        {"number": 2**70},
        {"number": "1"},
        {"number": True},
        {"number": {"dtype": "<i8", "shape": [], "data": "AAAAAAAAAAA="}},
        {"count": 1.0},
        {"count": True},
        {"count": 2**63},
        {"count": {"dtype": "<i8", "shape": [1], "data": "AAAAAAAAAAA="}},
        {"yes": 1},
        {"way": "sideways"},
        {"way": ["up"]},
        {"leaf": {"": "Leaf", "value": 1.0}},
        {"leaf": {"": "Leaf", "value": 1.0, "word": "", "more": 1}},
        {"leaf": {"": "Machine", "value": 1.0, "word": ""}},
        {"leaf": {"value": 1.0, "word": ""}},
        {"leaf": [1.0, ""]},
        {"pair": [1]},
        {"pair": [1, 2.0, 3.0]},
        {"pair": {"0": 1}},
        {"names": "ab"},
        {"names": [["a"]]},
        {"levels": [[2, 1.0]]},
        {"levels": [["HIGH", 1.0]]},
        {"levels": [[1]]},
        {"levels": 5},
        {"counts": {"x": "1"}},
        {"colour": "GREEN"},
        {"colour": "__class__"},
        {"values": {"dtype": "<c8", "shape": [1], "data": "AAAAAAAAAAA="}},
        {"values": {"dtype": "<f8", "shape": [2], "data": "AAAAAAAAAAA="}},
        {"values": {"dtype": "<f8", "shape": [1, 1, 1], "data": "AAAAAAAAAAA="}},
        {"values": {"dtype": "<f8", "shape": [2**62], "data": ""}},
        {"values": {"dtype": "<f8", "shape": [1], "data": "AAAAAAAAAA=="}},
        {"values": {"dtype": "<f8", "shape": [1], "data": 5}},
        {"values": {"dtype": "<f8", "shape": [1]}},
        {"more": 1},
    ],
)
def test_what_is_not_declared_is_refused(values: dict[str, object]) -> None:
    with pytest.raises(CodecError):
        read(changed(**values))


def test_a_missing_attribute_is_another_layout() -> None:
    data = written(full())
    del data["facts"]["count"]
    with pytest.raises(CodecError, match=r"another layout of Facts \(count\)"):
        read(data)


def test_an_attribute_whose_type_cannot_be_seen_is_named() -> None:
    machine = Machine()
    machine.later = None  # type: ignore[attr-defined]
    with pytest.raises(TypeError, match=r"Machine\.later: annotate it"):
        Decoder((machine,), {})


def test_what_would_come_back_twice_or_as_something_else_is_not_written() -> None:
    machine = Machine()
    machine.other = machine.facts  # type: ignore[attr-defined]
    with pytest.raises(TypeError, match="Facts is reached by two ways"):
        encode(machine, {})
    for value in (Path("x"), print, object(), b"bytes", 1j):
        machine = Machine()
        machine._leaf = value  # type: ignore[assignment]
        with pytest.raises(TypeError, match="cannot be written down"):
            encode(machine, {})


def test_what_does_not_change_may_be_shared() -> None:
    machine = Machine()
    machine._leaf = machine.facts.leaf = Leaf(1.0)
    assert read(written(machine))._leaf == Leaf(1.0)
