"""Findings on the bridges to other systems: who may act without being known."""

from membrane_ctrl.config.bridge_access import list_bridge_accesses
from membrane_ctrl.config.schema import Config
from membrane_ctrl.controller.cross_check_plant import ConfigFindings

_REMEDIES = {
    "bridges.mqtt": "give username and password_file, and let the broker's access list decide",
    "bridges.opcua": "give users_file, or set the role to read",
    "bridges.epics": "set the role to read, unless every user of this machine may act",
}


def judge_bridges(config: Config, findings: ConfigFindings) -> None:
    """Warn of bridges through which unidentified clients may act.

    Parameters
    ----------
    config : Config
        Whose `[bridges]` are judged.
    findings : ConfigFindings
        Gets a warning for each.
    """
    for bridge in list_bridge_accesses(config.bridges):
        acts = bridge.unknown and config.bridges.role != "read"
        findings.warn(
            acts, "bridges.role", f"{bridge.where}: {bridge.who} may act", _REMEDIES[bridge.field]
        )
