"""What counts as a claim to a name at an MQTT broker: any client may publish anything there."""

import json

import pytest

from membrane_ctrl.bridges.mqtt_owner import NameOwnership, OwnerClaim, parse_claim

VALID = {"instance": "0123456789abcdef", "host": "bench", "pid": 7, "since_s": 5.0}


def test_a_claim_survives_the_wire() -> None:
    claim = OwnerClaim.of_this_process()
    assert parse_claim(claim.encode()) == claim


@pytest.mark.parametrize(
    "changed",
    [
        {"host": []},
        {"host": {}},
        {"host": None},
        {"host": "a\nb"},
        {"host": "x" * 65},
        {"pid": True},
        {"pid": "7"},
        {"instance": 7},
        {"instance": "0123456789ABCDEF"},
        {"since_s": 10**400},
        {"since_s": True},
        {"since_s": -1},
        {"since_s": float("nan")},
        {"since_s": "5"},
        {"more": 1},
    ],
)
async def test_a_claim_with_a_wrong_field_is_none(changed: dict[str, object]) -> None:
    payload = json.dumps(VALID | changed).encode()
    assert parse_claim(payload) is None
    NameOwnership(OwnerClaim.of_this_process(), "the name").receive(payload, retained=False)


@pytest.mark.parametrize("payload", [b"", b"\xff", b"[" * 400, b"[]", b"1", b"x" * 600])
def test_other_messages_are_no_claim(payload: bytes) -> None:
    assert parse_claim(payload) is None
