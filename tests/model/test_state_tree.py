"""State trees: exact in both directions, and only declared fields are decoded."""

from __future__ import annotations

import json
import math
import random
import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum, IntEnum
from typing import Annotated, Any, Literal

import numpy as np
import pytest

from membrane_ctrl.config.schema import LoopConfig
from membrane_ctrl.model.arrays import ComplexArray, FloatArray
from membrane_ctrl.model.state_tree import (
    ArrayShape,
    Count,
    StateError,
    StateNode,
    decode_state,
    describe_tree,
    encode_state,
    find_differences,
    to_plain,
)

MOST_BYTES = 100_000


class Level(IntEnum):
    LOW = 0
    HIGH = 1


class Colour(Enum):
    RED = "r"


@dataclass(frozen=True, slots=True)
class Leaf(StateNode):
    value: float
    word: str = ""


@dataclass(slots=True)
class Tree(StateNode):
    number: float = 0.1
    count: Count = 3
    yes: bool = True
    way: Literal["up", "down"] | None = "up"
    leaf: Leaf | None = None
    pair: tuple[int, float] = (1, math.pi)
    marks: tuple[int, ...] = ()
    levels: dict[Level, float] = field(default_factory=dict)
    colours: dict[Colour, float] = field(default_factory=dict)
    level: Level = Level.LOW
    last: deque[float] = field(default_factory=deque)
    leaves: list[Leaf] = field(default_factory=list)
    loop: LoopConfig = field(default_factory=LoopConfig)
    matrix: Annotated[FloatArray, ArrayShape((3, 2))] = field(
        default_factory=lambda: np.zeros((3, 2))
    )
    phasors: Annotated[ComplexArray, ArrayShape((2,), "<c16")] = field(
        default_factory=lambda: np.zeros(2, complex)
    )


def full() -> Tree:
    return Tree(
        number=-0.0,
        leaf=Leaf(5e-324, "\N{BELL}\N{SNOWMAN} \"'\\"),
        marks=(1, 2, 3),
        levels={Level.HIGH: math.inf},
        colours={Colour.RED: math.nan},
        level=Level.HIGH,
        last=deque([1.0, 2.0]),
        leaves=[Leaf(1e308), Leaf(-math.inf)],
        loop=LoopConfig(kp_per_s=0.3),
        matrix=np.random.default_rng(1).normal(size=(3, 2)),
        phasors=np.array([1j, complex(math.nan, -0.0)]),
    )


def decoded(data: bytes) -> Tree:
    return decode_state(data, Tree, MOST_BYTES)


def test_a_state_is_restored_bit_by_bit() -> None:
    was, now = full(), decoded(encode_state(full()))
    assert find_differences(was, now) == []
    assert encode_state(now) == encode_state(was)
    assert math.copysign(1.0, now.number) == -1.0
    assert type(now.level) is Level
    assert now.matrix.tobytes() == was.matrix.tobytes()
    assert now.phasors.tobytes() == was.phasors.tobytes()
    assert now.matrix.flags.writeable
    assert now.loop == was.loop
    now.last.append(3.0)


def test_every_number_keeps_its_bits() -> None:
    bits = random.Random(7)
    numbers = [struct.unpack("<d", bits.randbytes(8))[0] for _ in range(2000)]
    now = decoded(encode_state(Tree(last=deque(numbers)))).last
    for before, after in zip(numbers, now, strict=True):
        assert struct.pack("<d", before) == struct.pack("<d", after) or math.isnan(
            before
        ) == math.isnan(after)


def changed(**values: object) -> bytes:
    return spelled(json.loads(encode_state(full())) | values)


def spelled(data: Any) -> bytes:
    return json.dumps(data, separators=(",", ":"), ensure_ascii=False).encode()


def test_the_spelling_of_the_values_does_not_matter() -> None:
    assert (
        find_differences(
            decoded(json.dumps(json.loads(encode_state(full())), indent=1).encode()), full()
        )
        == []
    )


@pytest.mark.parametrize(
    "values",
    [
        {"number": "1"},
        {"number": True},
        {"number": None},
        {"count": 1.0},
        {"count": True},
        {"count": -1},
        {"count": 2**53},
        {"yes": 1},
        {"way": "sideways"},
        {"way": ["up"]},
        {"leaf": {"value": 1.0}},
        {"leaf": {"value": 1.0, "word": "", "more": 1}},
        {"leaf": [1.0, ""]},
        {"pair": [1]},
        {"pair": [1, 2.0, 3.0]},
        {"pair": {"0": 1}},
        {"levels": {"2": 1.0}},
        {"levels": [1]},
        {"colours": {"g": 1.0}},
        {"level": 7},
        {"level": "HIGH"},
        {"last": 1.0},
        {"last": [None]},
        {"leaves": [{}]},
        {"loop": {}},
        {"loop": {"kp_per_s": -1.0}},
        {"matrix": "AAAAAAAAAAA="},
        {"matrix": "AAAAAAAAAA=="},
        {"matrix": "not base64"},
        {"matrix": 5},
        {"phasors": "AAAAAAAAAAA="},
        {"more": 1},
    ],
)
def test_undeclared_fields_are_refused(values: dict[str, object]) -> None:
    with pytest.raises(StateError, match=rf"{next(iter(values))}|another layout"):
        decoded(changed(**values))


@pytest.mark.parametrize("name", ["count", "leaf", "matrix", "loop"])
def test_a_missing_field_is_another_layout(name: str) -> None:
    data = json.loads(encode_state(full()))
    del data[name]
    with pytest.raises(StateError, match=f"another layout: {name} is missing"):
        decoded(spelled(data))


def test_a_missing_field_of_a_part_is_named_with_its_place() -> None:
    data = json.loads(encode_state(full()))
    del data["leaves"][1]["word"]
    with pytest.raises(StateError, match=r"another layout: leaves\.1\.word is missing"):
        decoded(spelled(data))


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"{",
        b"[]",
        b"null",
        b"[" * 50_000,
        b"\xff",
        b" " * (MOST_BYTES + 1),
        encode_state(full()) + b"]",
    ],
)
def test_data_that_is_no_tree_is_refused(data: bytes) -> None:
    with pytest.raises(StateError):
        decoded(data)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda tree: setattr(tree, "number", "text"),
        lambda tree: setattr(tree, "leaf", object()),
        lambda tree: setattr(tree, "matrix", np.zeros((2, 2))),
        lambda tree: setattr(tree, "matrix", np.zeros((3, 2), np.float32)),
    ],
)
def test_a_value_of_another_type_is_not_encoded(spoil: Callable[[Tree], None]) -> None:
    tree = full()
    spoil(tree)
    with pytest.raises(ValueError, match=r"Expected|serializ|array"):
        encode_state(tree)


def test_a_fresh_start_sets_every_field_to_its_default() -> None:
    tree = full()
    tree.start_afresh()
    assert find_differences(tree, Tree()) == []


def test_differences_are_named_with_place_and_values() -> None:
    one, other = full(), full()
    other.number = 0.0
    other.leaves[0] = Leaf(2.0)
    other.matrix[2, 1] = 1.0
    other.levels = {Level.LOW: math.inf}
    found = find_differences(one, other)
    assert found[0] == "number: -0.0, 0.0"
    assert found[1] == "levels.HIGH: inf, 'absent'"
    assert found[3] == "leaves.0.value: 1e+308, 2.0"
    assert found[4].startswith("matrix.2.1: ")


def test_a_tree_is_described_value_by_value() -> None:
    @dataclass(slots=True)
    class Wide(StateNode):
        wide: Annotated[FloatArray, ArrayShape((3, 3))]
        empty: Annotated[FloatArray, ArrayShape((9,))]
        tree: Tree

    lines = describe_tree(Wide(np.diag([1.0, 2.0, math.nan]), np.full(9, math.nan), full()))
    assert [line.split(maxsplit=1) for line in lines[:2]] == [
        ["wide", "3 x 3 numbers, 0 to 2"],
        ["empty", "9 numbers, none finite"],
    ]
    values = {line.split()[0]: line[48:].strip() for line in lines}
    assert (values["tree.level"], values["tree.leaves.1.value"]) == ("HIGH", "-inf")
    assert values["tree.levels.HIGH"] == "inf"
    assert values["tree.last"] == "[1.0, 2.0]"


def test_people_read_names_and_numbers() -> None:
    plain = to_plain(full())
    assert plain["level"] == "HIGH"
    assert plain["colours"].keys() == {"RED"}
    assert np.shape(plain["matrix"]) == (3, 2)


@dataclass(slots=True)
class Columns(StateNode):
    values: Annotated[FloatArray, ArrayShape((-1, 2))]


@pytest.mark.parametrize("rows", [0, 1, 5])
def test_an_array_may_have_one_axis_of_any_length(rows: int) -> None:
    was = Columns(np.arange(2.0 * rows).reshape(rows, 2))
    now = decode_state(encode_state(was), Columns, MOST_BYTES)
    assert now.values.shape == (rows, 2)
    assert np.array_equal(now.values, was.values)


def test_the_other_axes_are_checked() -> None:
    with pytest.raises(ValueError, match="is declared"):
        encode_state(Columns(np.zeros((2, 3))))
    with pytest.raises(ValueError, match="is declared"):
        encode_state(Columns(np.zeros(2)))
    three = json.loads(encode_state(Tree()))["matrix"][:32]  # 3 numbers
    with pytest.raises(StateError, match="3 numbers where"):
        decode_state(json.dumps({"values": three}).encode(), Columns, MOST_BYTES)
