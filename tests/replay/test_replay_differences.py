"""Where a replay differs from the record: the report on decisions and fields."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from membrane_ctrl.model.telemetry import FIELDS, TelemetryRow
from membrane_ctrl.replay.replay import Decision, differing_fields, find_unmatched

CHECK, HOLD, FAULT = (
    Decision(1.0, "state", "check"),
    Decision(5.0, "state", "hold"),
    Decision(9.0, "fault", "late"),
)
ROW = TelemetryRow(**dict.fromkeys(FIELDS, 1.0))


def at(decision: Decision, time_s: float) -> Decision:
    return replace(decision, time_s=time_s)


@pytest.mark.parametrize(
    ("recorded", "today", "messages"),
    [
        ([CHECK, HOLD], [CHECK, HOLD], []),
        ([CHECK, HOLD], [CHECK, at(HOLD, 6.0)], []),
        (
            [CHECK, HOLD],
            [CHECK, at(HOLD, 6.1)],
            ["recorded: state hold at 5.00 s; today: state hold at 6.10 s"],
        ),
        ([CHECK, HOLD], [CHECK], ["recorded: state hold at 5.00 s; today: nothing more"]),
        ([CHECK], [CHECK, HOLD, FAULT], ["recorded: nothing more; today: state hold at 5.00 s"]),
        (
            [CHECK, FAULT],
            [HOLD, FAULT],
            ["recorded: state check at 1.00 s; today: state hold at 5.00 s"],
        ),
    ],
)
def test_decisions_are_the_same_ones_within_the_slack_until_one_is_another(
    recorded: list[Decision], today: list[Decision], messages: list[str]
) -> None:
    assert find_unmatched(recorded, today, 1.0) == messages


def test_each_wrong_time_is_reported() -> None:
    late = [at(CHECK, 3.0), at(HOLD, 8.0)]
    assert len(find_unmatched([CHECK, HOLD], late, 1.0)) == 2


def test_a_value_that_came_or_went_is_a_difference_and_no_value_twice_is_none() -> None:
    none = replace(ROW, trim_um=math.nan)
    assert not differing_fields(none, none)
    assert list(differing_fields(none, ROW)) == ["trim_um"]
    assert differing_fields(ROW, none)["trim_um"] == pytest.approx((math.nan, 1.0), nan_ok=True)
