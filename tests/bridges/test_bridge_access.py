"""`check` states who may act through each bridge, and warns where nobody knows who acts."""

from __future__ import annotations

import json

import pytest

from membrane_ctrl.commissioning.check import check_config
from membrane_ctrl.config.bridge_access import describe_bridges
from membrane_ctrl.config.bridges import BridgesConfig, EpicsConfig, MqttConfig, OpcuaConfig
from membrane_ctrl.config.schema import Config
from membrane_ctrl.controller.cross_check import cross_check

USERS = OpcuaConfig(users_file="users.txt")


def warnings(**bridges: object) -> list[str]:
    config = Config(bridges=BridgesConfig(**bridges))  # type: ignore[arg-type]
    return [
        f"{found.why}; {found.remedy}"
        for found in cross_check(config)
        if found.field == "bridges.role"
    ]


@pytest.mark.parametrize(
    ("bridges", "message"),
    [
        (
            {"opcua": OpcuaConfig()},
            "OPC UA on 127.0.0.1:4840: every program on this machine may act; give users_file",
        ),
        (
            {"epics": EpicsConfig()},
            "EPICS on 127.0.0.1: every program on this machine may act; set the role to read",
        ),
        (
            {"mqtt": MqttConfig()},
            "MQTT by the broker 127.0.0.1:1883: everyone whom the broker lets publish there",
        ),
    ],
)
@pytest.mark.parametrize("role", ["operate", "tune"])
def test_a_bridge_through_which_anybody_acts_gives_a_warning(
    bridges: dict[str, object], message: str, role: str
) -> None:
    (found,) = warnings(role=role, **bridges)
    assert found.startswith(message)


@pytest.mark.parametrize(
    "bridges",
    [
        {"role": "read", "opcua": OpcuaConfig(), "epics": EpicsConfig(), "mqtt": MqttConfig()},
        {"role": "operate", "opcua": USERS},
        {"role": "operate", "mqtt": MqttConfig(username="mirror")},
        {"role": "tune"},
    ],
    ids=str,
)
def test_known_clients_and_readers_give_no_warning(bridges: dict[str, object]) -> None:
    assert warnings(**bridges) == []


def test_check_states_who_may_act(capsys: pytest.CaptureFixture[str]) -> None:
    config = Config(bridges=BridgesConfig(role="operate", opcua=OpcuaConfig()))
    assert check_config(config, "lab.toml", as_json=True) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["would"]["bridges"] == (
        "OPC UA on 127.0.0.1:4840: every program on this machine may read and act (role "
        "operate at most)"
    )
    assert [each["field"] for each in found["findings"]] == ["bridges.role"]
    assert check_config(config, "lab.toml", as_json=False) == 0
    shown = capsys.readouterr().out
    assert (
        "lab.toml: warning: bridges.role = operate: OPC UA on 127.0.0.1:4840: every program on "
        "this machine"
    ) in shown


def test_the_words_for_users_and_for_readers() -> None:
    assert describe_bridges(BridgesConfig()) == "none"
    encrypted = OpcuaConfig(
        host="0.0.0.0", users_file="users.txt", certificate_file="a.pem", key_file="a.key"
    )
    assert describe_bridges(BridgesConfig(role="operate", opcua=encrypted)) == (
        "OPC UA on 0.0.0.0:4840, encrypted: the users in users.txt, each by its role may "
        "read and act "
        "(role operate at most)"
    )
    assert describe_bridges(BridgesConfig(epics=EpicsConfig())).endswith("may read, but not act")
