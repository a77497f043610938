"""The door to OPC UA: a server with one object; its variables are the published values, its methods the commands.

Without contact to the hold a variable has the status `BadNoCommunication` and no value.
"""

import asyncio
import sys
from datetime import UTC, datetime
from typing import Any

from asyncua import Server, ua
from asyncua.common.node import Node
from asyncua.crypto.permission_rules import User, UserRole

from membrane_ctrl.config.port import OpcuaConfig
from membrane_ctrl.doors.names import TABLE, Door, Value
from membrane_ctrl.model import errors
from membrane_ctrl.web.access import Action

_UNITS = "http://www.opcfoundation.org/UA/units/un/cefact"


class _Everybody:
    """Every client is a plain user: asyncua's own manager makes an administrator of whoever says `admin`."""

    def get_user(self, *_: Any, **__: Any) -> User:
        return User(UserRole.User)


async def serve(config: OpcuaConfig, door: Door) -> None:
    """Serve until cancelled. Raises DeviceError if the address is taken."""
    where = f"opc.tcp://{config.host}:{config.port}/membrane_ctrl"
    async with door.opening:
        server = Server(user_manager=_Everybody())
        await server.init()
        server.set_endpoint(where)
        server.set_server_name("membrane_ctrl")
        server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
        server.set_identity_tokens([ua.AnonymousIdentityToken])
        space = await server.register_namespace(f"urn:membrane-ctrl:{door.settings.name}")
        nodes = await _nodes(server, space, door)
        await _show(server, nodes, door)  # nobody may see the zeros that the variables were made with
        try:
            await server.start()
        except OSError as error:
            raise errors.DeviceError(f"opcua: {where}: {errors.os_reason(error)}; choose another port") from None
    print(f"opcua: {where}", file=sys.stderr, flush=True)
    try:
        while True:
            await _show(server, nodes, door)
            await asyncio.sleep(door.settings.period_s)
    finally:
        await server.stop()


async def _show(server: Server, nodes: dict[str, Node], door: Door) -> None:
    for name, value in door.values().items():
        await server.write_attribute_value(nodes[name].nodeid, _data(value, door.live))


async def _nodes(server: Server, space: int, door: Door) -> dict[str, Node]:
    """Make the object with its variables and methods; returns the variables by name."""
    name = door.settings.name
    mirror = await server.nodes.objects.add_object(ua.NodeId(name, space), ua.QualifiedName(name, space))
    found = {}
    for each in TABLE:
        node = await mirror.add_variable(
            ua.NodeId(f"{name}.{each.name}", space), ua.QualifiedName(each.name, space), 0.0 if each.unit else ""
        )
        await node.write_attribute(ua.AttributeIds.Description, ua.DataValue(ua.Variant(ua.LocalizedText(each.says))))
        if each.unit:
            unit = ua.EUInformation(_UNITS, -1, ua.LocalizedText(each.unit), ua.LocalizedText(each.says))
            await node.add_property(ua.NodeId(f"{name}.{each.name}.unit", space), "0:EngineeringUnits", unit)
        found[each.name] = node
    for do, action in door.commands.items():
        given = [_argument(action)] if action.asks else []
        node_id, browse_name = ua.NodeId(f"{name}.do.{do}", space), ua.QualifiedName(do, space)
        answer = ua.Argument(Name="answer", DataType=ua.NodeId(ua.ObjectIds.String))
        await mirror.add_method(node_id, browse_name, _method(door, do), given, [answer])
    return found


def _argument(action: Action) -> ua.Argument:
    number = action.asks == "number"
    kind = ua.ObjectIds.Double if number else ua.ObjectIds.String
    return ua.Argument(
        Name=action.unit or "text", DataType=ua.NodeId(kind), Description=ua.LocalizedText(action.does)
    )


def _method(door: Door, do: str) -> Any:
    async def call(parent: ua.NodeId, *given: ua.Variant) -> list[ua.Variant] | ua.StatusCode:
        if len(given) > 1 or any(not isinstance(each.Value, float | int | str) for each in given):
            return ua.StatusCode(ua.StatusCodes.BadInvalidArgument)
        said = await door.ask("opcua", do, given[0].Value if given else "")
        return [ua.Variant(said, ua.VariantType.String)]

    return call


def _data(value: Value, live: bool) -> ua.DataValue:
    """A value with its time; without contact, texts stay, and numbers are bad."""
    at = datetime.now(UTC)
    if value is not None:
        kind = ua.VariantType.String if isinstance(value, str) else ua.VariantType.Double
        return ua.DataValue(ua.Variant(value, kind), SourceTimestamp=at)
    bad = ua.StatusCodes.BadNoData if live else ua.StatusCodes.BadNoCommunication
    return ua.DataValue(ua.Variant(), ua.StatusCode(bad), SourceTimestamp=at)
