"""The bridge to OPC UA: a server with one object; its variables are the published values, its
methods the commands.

Without contact to the hold a variable has the status `BadNoCommunication` and no value. Sessions
are anonymous, or of the users of a file; without a certificate they are not encrypted.
"""

import asyncio
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from asyncua import Server, ua
from asyncua.common.node import Node
from cryptography.hazmat.primitives.asymmetric import rsa

from membrane_ctrl.bridges.bridge import TABLE, Bridge
from membrane_ctrl.bridges.opcua_server import AnonymousClients, BridgeServer, NamedClients, caller
from membrane_ctrl.config.bridges import OpcuaConfig
from membrane_ctrl.model import errors, files
from membrane_ctrl.service.accounts import KnownUser, known_users
from membrane_ctrl.service.action_button import ActionButton
from membrane_ctrl.service.published_signals import Value

_UNITS = "http://www.opcfoundation.org/UA/units/un/cefact"
_OPEN = [ua.SecurityPolicyType.NoSecurity]
_ENCRYPTED = [
    ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt,
    ua.SecurityPolicyType.Aes128Sha256RsaOaep_SignAndEncrypt,
    ua.SecurityPolicyType.Aes256Sha256RsaPss_SignAndEncrypt,
]


async def serve(config: OpcuaConfig, bridge: Bridge) -> None:
    """Serve until cancelled.

    Parameters
    ----------
    config : OpcuaConfig
        Address, users and certificate.
    bridge : Bridge
        The values that become variables, and the commands that become methods.

    Raises
    ------
    InputError
        A file of users, certificate or key cannot be used.
    DeviceError
        The address is taken.
    """
    where = f"opc.tcp://{config.host}:{config.port}/membrane_ctrl"
    users = _read_users(config)
    async with bridge.opening:
        server = BridgeServer(AnonymousClients() if users is None else NamedClients(users))
        await server.init()
        server.set_endpoint(where)
        server.set_server_name("membrane_ctrl")
        await _secure(server, config, bridge.settings.name)
        space = await server.register_namespace(f"urn:membrane-ctrl:{bridge.settings.name}")
        nodes = await _make_nodes(server, space, bridge, users)
        # the variables were made with zeros, which no client may see
        await _show(server, nodes, bridge)
        try:
            await server.start()
        except OSError as error:
            raise errors.DeviceError(
                f"opcua: {where}: {errors.os_reason(error)}; choose another port"
            ) from None
    print(f"opcua: {where}", file=sys.stderr, flush=True)
    try:
        while True:
            await _show(server, nodes, bridge)
            await asyncio.sleep(bridge.settings.period_s)
    finally:
        await server.stop()


def _read_users(config: OpcuaConfig) -> dict[str, KnownUser] | None:
    """The users by name; None if clients are anonymous. Raises InputError."""
    if config.users_file is None:
        return None
    try:
        text = files.read_text(Path(config.users_file), follow=True)
    except (OSError, ValueError) as error:
        raise errors.InputError(f"bridges.opcua.users_file: {error}") from None
    users = known_users(text, config.users_file)
    if not users:
        raise errors.InputError(
            f"bridges.opcua.users_file: {config.users_file} has no users; add one with "
            "`membrane-ctrl serve add-user`"
        )
    return users


async def _secure(server: BridgeServer, config: OpcuaConfig, name: str) -> None:
    """Set how sessions are encrypted and who they may belong to. Raises InputError."""
    server.set_identity_tokens(
        [ua.AnonymousIdentityToken if config.users_file is None else ua.UserNameIdentityToken]
    )
    server.set_security_policy(_ENCRYPTED if config.encrypted else _OPEN)
    if not config.encrypted:
        return
    assert config.certificate_file is not None
    assert config.key_file is not None
    await server.set_application_uri(f"urn:membrane-ctrl:{name}")
    for key, file, load in (
        ("certificate_file", config.certificate_file, server.load_certificate),
        ("key_file", config.key_file, server.load_private_key),
    ):
        try:
            await load(Path(file), format="pem")
        except (OSError, ValueError, TypeError) as error:
            raise errors.InputError(f"bridges.opcua.{key}: {file}: {error}") from None
    if not isinstance(server.iserver.certificate.public_key(), rsa.RSAPublicKey):
        raise errors.InputError(
            f"bridges.opcua.certificate_file: {config.certificate_file}: OPC UA needs an RSA key"
        )
    if not isinstance(server.iserver.private_key, rsa.RSAPrivateKey):
        raise errors.InputError(
            f"bridges.opcua.key_file: {config.key_file}: OPC UA needs an RSA key"
        )


async def _show(server: Server, nodes: dict[str, Node], bridge: Bridge) -> None:
    for name, value in bridge.values().items():
        await server.write_attribute_value(nodes[name].nodeid, _make_data_value(value, bridge.live))


async def _make_nodes(
    server: Server, space: int, bridge: Bridge, users: dict[str, KnownUser] | None
) -> dict[str, Node]:
    """Make the object with its variables and methods; returns the variables by name."""
    name = bridge.settings.name
    mirror = await server.nodes.objects.add_object(
        ua.NodeId(name, space), ua.QualifiedName(name, space)
    )
    # A variable for each published value, with its description and its unit
    found = {}
    for each in TABLE:
        node = await mirror.add_variable(
            ua.NodeId(f"{name}.{each.name}", space),
            ua.QualifiedName(each.name, space),
            "" if each.is_text else 0.0,
        )
        await node.write_attribute(
            ua.AttributeIds.Description,
            ua.DataValue(ua.Variant(ua.LocalizedText(each.description))),
        )
        if each.unit:
            unit = ua.EUInformation(
                _UNITS, -1, ua.LocalizedText(each.unit), ua.LocalizedText(each.description)
            )
            await node.add_property(
                ua.NodeId(f"{name}.{each.name}.unit", space), "0:EngineeringUnits", unit
            )
        found[each.name] = node
    # A method for each command
    for do, action in bridge.commands.items():
        given = [_make_argument(action)] if action.asks else []
        node_id = ua.NodeId(f"{name}.do.{do}", space)
        browse_name = ua.QualifiedName(do, space)
        answer = ua.Argument(Name="answer", DataType=ua.NodeId(ua.ObjectIds.String))
        await mirror.add_method(
            node_id, browse_name, _make_method(bridge, do, users), given, [answer]
        )
    return found


def _make_argument(action: ActionButton) -> ua.Argument:
    number = action.asks == "number"
    kind = ua.ObjectIds.Double if number else ua.ObjectIds.String
    return ua.Argument(
        Name=action.unit or "text",
        DataType=ua.NodeId(kind),
        Description=ua.LocalizedText(action.does),
    )


def _make_method(bridge: Bridge, do: str, users: dict[str, KnownUser] | None) -> Any:
    async def call(parent: ua.NodeId, *given: ua.Variant) -> list[ua.Variant] | ua.StatusCode:
        if len(given) > 1 or any(not isinstance(each.Value, float | int | str) for each in given):
            return ua.StatusCode(ua.StatusCodes.BadInvalidArgument)
        value = given[0].Value if given else ""
        who = caller.get()
        role = None if users is None else users[who].role
        answer = await bridge.ask("opcua", do, value, role, who)
        return [ua.Variant(answer, ua.VariantType.String)]

    return call


def _make_data_value(value: Value, live: bool) -> ua.DataValue:
    """A value with its time; without contact, texts stay, and numbers are bad."""
    at = datetime.now(UTC)
    if value is not None:
        if isinstance(value, str):
            kind = ua.VariantType.String
        else:
            kind = ua.VariantType.Double
        return ua.DataValue(ua.Variant(value, kind), SourceTimestamp=at)
    if live:
        bad = ua.StatusCodes.BadNoData
    else:
        bad = ua.StatusCodes.BadNoCommunication
    return ua.DataValue(ua.Variant(), ua.StatusCode(bad), SourceTimestamp=at)
