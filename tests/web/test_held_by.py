"""What holds the mirror, in words."""

from __future__ import annotations

from typing import Any

import pytest

from membrane_ctrl.web.held_by import describe_holder

ESTIMATE = {
    "estimate_sigma_um": 0.0213,
    "optics_share": 0.38,
    "laser_innovation": 0.4,
    "optics_innovation": -1.0,
    "displacement_um": 0.1,
    "displacement_quality": 0.0,
}


def status(state: str = "hold", shape: str = "off", **row: Any) -> dict[str, Any]:
    return {"state": state, "shape": shape, "row": row}


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (status(**ESTIMATE), "held by laser 62 %, optics 38 %: centre ± 0.021 µm (1 σ)"),
        (
            status(**ESTIMATE | {"laser_innovation": None, "optics_share": 1.0}),
            "held by optics 100 %: centre ± 0.021 µm (1 σ)",
        ),
        (status(displacement_um=0.1, displacement_quality=0.0), "held by the laser"),
        (
            status(shape="tracking", displacement_um=0.1, displacement_quality=0.0),
            "held by the laser; the optics correct its setpoint",
        ),
        (status(displacement_um=0.1), "held by the optics"),
        (status(), "held by nothing: no reading"),
        (status("fault", **ESTIMATE), ""),
        ({"state": "hold"}, ""),
        (
            status(displacement_um=0.1, displacement_quality=0.0, held_offset_um=12.3)
            | {"held": {"holds": "focus", "state": "tracking", "reason": ""}},
            "held by the laser; focus is held; the centre stands +12.30 µm from the setpoint for "
            "it",
        ),
    ],
)
def test_the_holder_is_named_with_weights(given: dict[str, Any], expected: str) -> None:
    assert describe_holder(given) == expected
