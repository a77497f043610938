"""Who may read and act through each bridge of a configuration, in words for `check`."""

from __future__ import annotations

from dataclasses import dataclass

from membrane_ctrl.config.bridges import BridgesConfig
from membrane_ctrl.config.port import LOCAL_HOSTS


@dataclass(frozen=True, slots=True)
class BridgeAccess:
    """Who may use a bridge."""

    field: str  # of the configuration
    where: str  # its address
    who: str  # may read, and act as far as the role allows
    unknown: bool  # whether clients act that neither this program nor a broker's log-in can name


def list_bridge_accesses(bridges: BridgesConfig) -> list[BridgeAccess]:
    """The configured bridges."""
    found = []
    if bridges.mqtt is not None:
        mqtt = bridges.mqtt
        who = "everyone whom the broker lets publish there (its access list)"
        where = f"MQTT by the broker {mqtt.host}:{mqtt.port}"
        found.append(BridgeAccess("bridges.mqtt", where, who, mqtt.username is None))
    if bridges.opcua is not None:
        opcua = bridges.opcua
        where = f"OPC UA on {opcua.host}:{opcua.port}" + (", encrypted" if opcua.encrypted else "")
        known = opcua.users_file is not None
        if known:
            who = f"the users in {opcua.users_file}, each by its role"
        else:
            who = _is_open_to_anybody(opcua.host)
        found.append(BridgeAccess("bridges.opcua", where, who, not known))
    if bridges.epics is not None:
        where = f"EPICS on {bridges.epics.host}"
        found.append(
            BridgeAccess("bridges.epics", where, _is_open_to_anybody(bridges.epics.host), True)
        )
    return found


def describe_bridges(bridges: BridgesConfig) -> str:
    """The configured bridges, and who may do what through them, in one line."""
    accesses = list_bridge_accesses(bridges)
    if not accesses:
        return "none"
    may = "read, but not act"
    if bridges.role != "read":
        may = f"read and act (role {bridges.role} at most)"
    return "; ".join(f"{each.where}: {each.who} may {may}" for each in accesses)


def _is_open_to_anybody(host: str) -> str:
    if host in LOCAL_HOSTS:
        return "every program on this machine"
    return "every program on the network"
