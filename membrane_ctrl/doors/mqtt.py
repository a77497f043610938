"""The door to MQTT: one JSON object of all values, a retained availability, commands, Home Assistant's discovery.

Topics, below `membrane/<name>/`: `values`, `availability` (`online`, `offline`; retained, also the last will),
`do/<command>`, `answer`.
"""

import asyncio
import json
import ssl
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import aiomqtt

from membrane_ctrl.config.port import MqttConfig
from membrane_ctrl.doors.names import TABLE, Door, Published
from membrane_ctrl.model import errors, files

_LEAVES_S = 2.0
_AGAIN_S = 1.0  # a returned broker has values within two seconds, however long it was away
_QUEUED_MOST = 32  # commands that wait; aiomqtt drops what a flood brings beyond
_KEEPALIVE_S = 10  # the broker notices a cut line after one and a half of these
_STATE_LETTERS = 255  # the longest state that Home Assistant takes
_CLASSES = {"Pa": "pressure", "°C": "temperature"}  # of Home Assistant; it knows no micrometres


async def serve(config: MqttConfig, door: Door) -> None:
    """Publish until cancelled; connect again whenever the broker returns. Raises InputError for a wrong file."""
    base = f"membrane/{door.settings.name}"
    password = _read(config.password_file)
    context = _context(config)
    will = aiomqtt.Will(f"{base}/availability", "offline", qos=1, retain=True)
    told, where = False, f"{config.host}:{config.port}"
    async with door.opening:
        pass  # a connection would time out meanwhile
    while True:
        try:
            async with aiomqtt.Client(
                config.host,
                config.port,
                username=config.username,
                password=password,
                will=will,
                tls_context=context,
                keepalive=_KEEPALIVE_S,
                max_queued_incoming_messages=_QUEUED_MOST,
            ) as client:
                told = False
                print(f"mqtt: connected to {where}", file=sys.stderr, flush=True)
                await _converse(client, config, door, base)
        except* (aiomqtt.MqttError, OSError) as group:
            if not told:
                reason = "; ".join(str(error) for error in group.exceptions)
                print(f"mqtt: {where}: {reason}; trying again", file=sys.stderr, flush=True)
            told = True
        await asyncio.sleep(_AGAIN_S)


def _read(file: str | None) -> str | None:
    try:
        return None if file is None else files.read_text(Path(file), follow=True).strip()
    except (OSError, ValueError) as error:
        raise errors.InputError(f"doors.mqtt.password_file: {error}") from None


def _context(config: MqttConfig) -> ssl.SSLContext | None:
    try:
        return None if config.ca_file is None else ssl.create_default_context(cafile=config.ca_file)
    except OSError as error:
        raise errors.InputError(f"doors.mqtt.ca_file: {config.ca_file}: {error}") from None


async def _converse(client: aiomqtt.Client, config: MqttConfig, door: Door, base: str) -> None:
    await client.subscribe(f"{base}/do/+", qos=1)
    if config.discovery_prefix:
        topic = f"{config.discovery_prefix}/device/membrane_{door.settings.name}/config"
        await client.publish(topic, json.dumps(discovery(door, base)), qos=1, retain=True)
    try:
        async with asyncio.TaskGroup() as both:
            both.create_task(_publish(client, door, base))
            both.create_task(_obey(client, door, base))
    except asyncio.CancelledError:  # a clean goodbye suppresses the last will
        async with asyncio.timeout(_LEAVES_S):
            await client.publish(f"{base}/availability", "offline", qos=1, retain=True)
        raise


async def _publish(client: aiomqtt.Client, door: Door, base: str) -> None:
    said = ""
    while True:
        now = "online" if door.live else "offline"
        message = {"time_utc": datetime.now(UTC).isoformat(timespec="milliseconds"), **door.values()}
        await client.publish(f"{base}/values", json.dumps(message))
        if now != said:  # after the values: whoever sees `online` has them
            await client.publish(f"{base}/availability", now, qos=1, retain=True)
            said = now
        await asyncio.sleep(door.settings.period_s)


async def _obey(client: aiomqtt.Client, door: Door, base: str) -> None:
    async for message in client.messages:
        name = str(message.topic).rpartition("/")[2]
        if message.retain:  # an old command, delivered again at each connection
            said = f"{name} refused: a retained message is no command"
        else:
            given = message.payload.decode("utf-8", "replace") if isinstance(message.payload, bytes) else ""
            action = door.commands.get(name)
            said = await door.ask("mqtt", name, given if action is None or action.asks else "")
        await client.publish(f"{base}/answer", said, qos=1)


def discovery(door: Door, base: str) -> dict[str, Any]:
    """The device with its entities, as Home Assistant takes it (device discovery, 2024.11 and later)."""
    name = door.settings.name
    found = {each.name: _sensor(each, name) for each in TABLE}
    for do, action in door.commands.items():
        entity: dict[str, Any] = {"unique_id": f"membrane_{name}_do_{do}", "command_topic": f"{base}/do/{do}"}
        entity |= {"name": action.label, "icon": "mdi:gesture-tap-button"}
        if action.asks == "number":
            low, high = door.bounds[do]
            shown = "target_um" if do == "setpoint" else "flow_um_per_s"
            entity |= {"platform": "number", "min": low, "max": high, "step": 0.01, "mode": "box"}
            entity |= {"unit_of_measurement": action.unit, "value_template": f"{{{{ value_json.{shown} }}}}"}
            entity |= {"state_topic": f"{base}/values"}
        else:
            entity |= {"platform": "text" if action.asks else "button"}
        found[f"do_{do}"] = entity
    return {
        "device": {"identifiers": [f"membrane_{name}"], "name": name, "model": "membrane mirror"},
        "origin": {"name": "membrane-ctrl"},
        "state_topic": f"{base}/values",
        "availability_topic": f"{base}/availability",
        "components": found,
    }


def _sensor(each: Published, name: str) -> dict[str, Any]:
    found: dict[str, Any] = {"platform": "sensor", "unique_id": f"membrane_{name}_{each.name}", "name": each.name}
    if not each.unit:
        found["value_template"] = f"{{{{ (value_json.{each.name} or '')[:{_STATE_LETTERS}] }}}}"
        return found
    found |= {"value_template": f"{{{{ value_json.{each.name} }}}}", "state_class": "measurement"}
    if each.unit != "1":
        found["unit_of_measurement"] = each.unit
    if each.unit in _CLASSES:
        found["device_class"] = _CLASSES[each.unit]
    return found
