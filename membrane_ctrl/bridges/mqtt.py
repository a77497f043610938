"""The bridge to MQTT: one JSON object of all values, a retained availability, commands, Home
Assistant's discovery.

Topics, below `membrane/<name>/`: `values`, `availability` (`online`, `offline`; retained, also the
last will), `do/<command>`, `answer`, `owner` (`mqtt_owner`), `order` (`mqtt_barrier`).

There are two connections. The first one has the safety commands and the claim to the name. A broker
queues messages for each connection separately and drops what a slow one does not take, so no flood
of other commands can drop a `latch`. The second one publishes the values and has all other
commands; only its will reports that the bridge has gone.
"""

import asyncio
import json
import ssl
import sys
import time
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, cast

import aiomqtt
from aiomqtt.exceptions import MqttConnectError
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from membrane_ctrl.bridges.bridge import TABLE, Bridge
from membrane_ctrl.bridges.command_lanes import MOVES_NOTHING, overtaken
from membrane_ctrl.bridges.mqtt_barrier import OrderBarrier
from membrane_ctrl.bridges.mqtt_client import CancellableClient
from membrane_ctrl.bridges.mqtt_inbox import HandleMessage, Inbox, Reports
from membrane_ctrl.bridges.mqtt_owner import NameOwnership, OwnerClaim
from membrane_ctrl.config.bridges import MqttConfig
from membrane_ctrl.control_port.safety_commands import SAFETY, is_safety_command
from membrane_ctrl.model import errors, files
from membrane_ctrl.model.columns import QUANTITY_OF_UNIT
from membrane_ctrl.service.published_signal import Published

_LEAVES_S = 2.0
_ANSWER_S = 5.0  # of the broker to each message
_AGAIN_S = 1.0  # a returned broker has values within two seconds, however long it was away
# a connection that lasted so long worked: the next failure is a new one, and is printed
_STEADY_S = 10.0
_KEEPALIVE_S = 10  # the broker notices a cut line after one and a half of these
_PACKET_BYTES_MAX = 1 << 20  # a broker of MQTT 5 delivers no larger message
_LOOK_S = 0.5  # how often the availability is compared with the hold
_REPORT_PAUSE_S = 0.02
_STATE_LETTERS = 255  # the longest state that Home Assistant takes
_UNSUPPORTED_VERSION = (1, 132)  # reason codes of MQTT 3.1.1 and 5


async def serve(config: MqttConfig, bridge: Bridge) -> None:
    """Publish until cancelled; connect again whenever the broker returns.

    Parameters
    ----------
    config : MqttConfig
        The broker, and how to log in to it.
    bridge : Bridge
        The values to publish, and where commands go.

    Raises
    ------
    InputError
        A file of password or certificate authority cannot be used.
    DeviceError
        Another bridge has the name at this broker.
    """
    broker = Broker(config, bridge.settings.name)
    ownership = NameOwnership(broker.claim, f"{broker.where}: the name {bridge.settings.name!r}")
    printed = False
    # Wait until the other bridges are open: they block the event loop, and a connection would time
    # out meanwhile.
    async with bridge.opening:
        pass
    # Each round is one connection until it fails. A failure is printed once, and again only after
    # a connection that has worked.
    while True:
        began_s = time.monotonic()
        connection = asyncio.create_task(
            _serve_connection(broker, config, bridge, ownership), name="mqtt connection"
        )
        await _wait_for_end(connection)
        try:
            connection.result()
        except* (aiomqtt.MqttError, OSError) as group:
            reasons = _list_exceptions(group)
            broker.note_failure(reasons)
            printed = printed and time.monotonic() - began_s < _STEADY_S
            if not printed:
                reason = "; ".join(dict.fromkeys(map(str, reasons)))
                print(f"mqtt: {broker.where}: {reason}; trying again", file=sys.stderr, flush=True)
            printed = True
        await asyncio.sleep(_AGAIN_S)


async def _wait_for_end(connection: asyncio.Task[None]) -> None:
    """Wait for the end of a connection; a cancellation ends it, whatever errors its closing brings
    about.
    """
    try:
        await asyncio.wait({connection})
    except asyncio.CancelledError:
        connection.cancel()
        await asyncio.wait({connection})
        if not connection.cancelled():
            connection.exception()
        raise


def _list_exceptions(group: BaseExceptionGroup[BaseException]) -> list[BaseException]:
    """The exceptions of a group and of the groups in it."""
    found: list[BaseException] = []
    for error in group.exceptions:
        found += _list_exceptions(error) if isinstance(error, BaseExceptionGroup) else [error]
    return found


class Broker:
    """How to connect to the configured broker.

    Parameters
    ----------
    config : MqttConfig
        Address, account and certificate authority; its files are read once, here.
    name : str
        Of the mirror in topics and identifiers (`bridges.name`).

    Raises
    ------
    InputError
        A file cannot be used.
    """

    def __init__(self, config: MqttConfig, name: str) -> None:
        self._config = config
        self._name = name
        self._password = _read(config.password_file)
        self._make_tls_context = _make_tls_context(config)
        self._version = aiomqtt.ProtocolVersion.V5
        self.claim = OwnerClaim.of_this_process()
        self.where = f"{config.host}:{config.port}"
        self.base = f"membrane/{name}"

    def client(
        self, purpose: str, handle: HandleMessage, will: aiomqtt.Will | None = None
    ) -> aiomqtt.Client:
        """A connection for a purpose, a context manager.

        Its identifier stays the same for this process: at a reconnection the broker ends the former
        connection.

        Parameters
        ----------
        purpose : str
            Last word of the identifier, different for each connection of this process: `safety`
            or `values`.
        handle : callable
            Gets each message as it arrives, in the event loop; it must not block.
        will : aiomqtt.Will or None
            What the broker publishes if the connection breaks; None for nothing.
        """
        inbox = Inbox(handle)

        def make_queue(maxsize: int) -> Inbox:
            return inbox

        properties = None
        if self._version is aiomqtt.ProtocolVersion.V5:
            properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
            properties.MaximumPacketSize = _PACKET_BYTES_MAX
        return CancellableClient(
            self._config.host,
            self._config.port,
            username=self._config.username,
            password=self._password,
            identifier=f"membrane-{self._name}-{self.claim.instance[:8]}-{purpose}",
            protocol=self._version,
            properties=properties,
            will=will,
            tls_context=self._make_tls_context,
            keepalive=_KEEPALIVE_S,
            timeout=_ANSWER_S,
            queue_type=cast(type[Inbox], make_queue),
        )

    def note_failure(self, reasons: list[BaseException]) -> None:
        """Use MQTT 3.1.1 from now on if the broker refuses version 5."""
        for error in reasons:
            if isinstance(error, MqttConnectError):
                if isinstance(error.rc, int) or error.rc is None:
                    code = error.rc
                else:
                    code = error.rc.value
                if code in _UNSUPPORTED_VERSION:
                    self._version = aiomqtt.ProtocolVersion.V311


def _read(file: str | None) -> str | None:
    if file is None:
        return None
    try:
        return files.read_text(Path(file), follow=True).strip()
    except (OSError, ValueError) as error:
        raise errors.InputError(f"bridges.mqtt.password_file: {error}") from None


def _make_tls_context(config: MqttConfig) -> ssl.SSLContext | None:
    if config.ca_file is None:
        return None
    try:
        return ssl.create_default_context(cafile=config.ca_file)
    except OSError as error:
        raise errors.InputError(f"bridges.mqtt.ca_file: {config.ca_file}: {error}") from None


async def _serve_connection(
    broker: Broker, config: MqttConfig, bridge: Bridge, ownership: NameOwnership
) -> None:
    """Connect, claim the name, publish and obey until a connection fails.

    The order is part of the protection: no command is subscribed before the name is owned, so two
    bridges of one name never act on the same command; the safety commands are subscribed before the
    connection of all others opens.
    """
    base = broker.base
    owner_topic = f"{base}/owner"

    async def publish_claim(payload: bytes, retained: bool) -> None:
        await guard.publish(owner_topic, payload, qos=1, retain=retained)

    async def publish_safety_answer(answer: str) -> None:
        await guard.publish(f"{base}/answer", answer, qos=1)

    def handle(message: aiomqtt.Message) -> None:
        if str(message.topic) == owner_topic:
            ownership.receive(_get_payload_bytes(message), message.retain)
            return
        # A retained message is refused below and therefore must not hold up other commands.
        if not message.retain:
            barrier.raise_for(_command_name(message))
        _handle_command(message, bridge, safety_reports)

    async def publish_marker(marker: str) -> None:
        await guard.publish(f"{base}/order", marker, qos=1)

    barrier = OrderBarrier(broker.claim.instance)
    safety_reports = Reports(publish_safety_answer, 0.0)
    ownership.forget_heard()
    async with broker.client("safety", handle) as guard, asyncio.TaskGroup() as tasks:
        watching = tasks.create_task(_wait_for_disconnect(guard))
        await guard.subscribe(owner_topic, qos=1)
        await ownership.establish(publish_claim)
        keeping = tasks.create_task(ownership.keep(publish_claim))
        others = (
            tasks.create_task(safety_reports.run()),
            tasks.create_task(barrier.run(publish_marker)),
        )
        await guard.subscribe([(f"{base}/do/{name}", 1) for name in sorted(SAFETY)])
        bridge.late_listeners.append(safety_reports.add)
        try:
            await _publish_and_obey(broker, config, bridge, barrier)
        except asyncio.CancelledError:
            # Either the program ends, or another task of the group failed. Only at the end of the
            # program the claim is withdrawn, so that the next bridge need not wait for silence;
            # after a failure this process connects again and needs its claim.
            failed = any(task.done() for task in (watching, keeping, *others))
            keeping.cancel()
            if not failed:
                with suppress(aiomqtt.MqttError, TimeoutError):
                    async with asyncio.timeout(_LEAVES_S):
                        await publish_claim(b"", True)
            raise
        finally:
            bridge.late_listeners.remove(safety_reports.add)


async def _wait_for_disconnect(client: aiomqtt.Client) -> None:
    """Wait until the connection ends, which raises MqttError; the inbox takes all messages."""
    async for _ in client.messages:
        pass


async def _publish_and_obey(
    broker: Broker, config: MqttConfig, bridge: Bridge, barrier: OrderBarrier
) -> None:
    """Publish the values, and obey all commands but the safety commands, on a second connection."""
    base = broker.base

    async def publish_answer(answer: str) -> None:
        await client.publish(f"{base}/answer", answer, qos=1)

    def handle(message: aiomqtt.Message) -> None:
        topic, name = str(message.topic), _command_name(message)
        if topic == f"{base}/availability":
            availability.receive(_get_payload_bytes(message))
        elif topic == f"{base}/order":
            barrier.receive(_get_payload_bytes(message))
        elif is_safety_command(name):
            return  # it also comes on the other connection
        # This command may have been published before a safety command that was faster on the other
        # connection.
        elif barrier.newest and name not in MOVES_NOTHING:
            reports.add_refusal(f"{name} refused: {overtaken(barrier.newest)}")
        else:
            _handle_command(message, bridge, reports)

    # The broker announces the bridge as offline if its connection breaks.
    availability = Availability()
    reports = Reports(publish_answer, _REPORT_PAUSE_S)
    will = aiomqtt.Will(f"{base}/availability", "offline", qos=1, retain=True)
    async with broker.client("values", handle, will) as client:
        print(f"mqtt: connected to {broker.where}", file=sys.stderr, flush=True)
        await client.subscribe(
            [(f"{base}/{topic}", 1) for topic in ("do/+", "availability", "order")]
        )
        if config.discovery_prefix:
            topic = f"{config.discovery_prefix}/device/membrane_{bridge.settings.name}/config"
            await client.publish(topic, json.dumps(discovery(bridge, base)), qos=1, retain=True)
        # Until the connection ends; the values are published meanwhile.
        try:
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(_wait_for_disconnect(client))
                tasks.create_task(_publish(client, bridge, base, availability))
                tasks.create_task(reports.run())
        # After an orderly disconnection the broker publishes no will: publish `offline` here.
        except asyncio.CancelledError:
            with suppress(aiomqtt.MqttError, TimeoutError):
                async with asyncio.timeout(_LEAVES_S):
                    await client.publish(f"{base}/availability", "offline", qos=1, retain=True)
            raise


class Availability:
    """What the broker holds as availability.

    A broker that has not noticed the end of a former connection publishes its will later, while
    values flow. So the topic is watched, and published again when it is wrong.
    """

    def __init__(self) -> None:
        self._published = ""
        self._wrong = False

    def receive(self, payload: bytes) -> None:
        """Note what is published on the topic."""
        if self._published and payload != self._published.encode():
            self._wrong = True

    def is_due(self, now: str) -> bool:
        """Whether `now` must be published."""
        return self._wrong or now != self._published

    def note_published(self, now: str) -> None:
        """Note that `now` is about to be published."""
        self._published = now
        self._wrong = False


async def _publish(
    client: aiomqtt.Client, bridge: Bridge, base: str, availability: Availability
) -> None:
    """Publish the values every period, and the availability when it changes or is wrong."""
    # The loop runs at least every `_LOOK_S`, so that a lost hold is shown before the next values
    # are due when their period is long.
    next_s = time.monotonic()
    while True:
        now = "online" if bridge.live else "offline"
        due = availability.is_due(now)
        if due or time.monotonic() >= next_s:
            next_s = time.monotonic() + bridge.settings.period_s
            message = {
                "time_utc": datetime.now(UTC).isoformat(timespec="milliseconds"),
                **bridge.values(),
            }
            await client.publish(f"{base}/values", json.dumps(message))
        if due:  # after the values: a client that sees `online` has them
            availability.note_published(now)
            await client.publish(f"{base}/availability", now, qos=1, retain=True)
        await asyncio.sleep(min(_LOOK_S, max(0.0, next_s - time.monotonic())))


def _handle_command(message: aiomqtt.Message, bridge: Bridge, reports: Reports) -> None:
    """Submit a command, or refuse it; the answer is reported in either case."""
    name = _command_name(message)
    if message.retain:  # an old command, delivered again at each connection
        reports.add_refusal(f"{name} refused: a retained message is no command")
        return
    outcome = bridge.submit("mqtt", name, _get_payload_bytes(message))
    if outcome.done():
        reports.add_refusal(outcome.result())
    else:
        outcome.add_done_callback(lambda done: reports.add(done.result()))


def _command_name(message: aiomqtt.Message) -> str:
    return str(message.topic).rpartition("/")[2]


def _get_payload_bytes(message: aiomqtt.Message) -> bytes:
    if isinstance(message.payload, bytes):
        return message.payload
    return b""


def discovery(bridge: Bridge, base: str) -> dict[str, Any]:
    """The device with its entities for Home Assistant (device discovery, 2024.11 and later).

    Parameters
    ----------
    bridge : Bridge
        Its published values become sensors, its allowed commands buttons, numbers and texts.
    base : str
        Topic under which values and commands are: `membrane/NAME`, without a slash at the end.

    Returns
    -------
    dict
        The payload of the discovery topic, to be sent as JSON.
    """
    name = bridge.settings.name
    found = {each.name: _describe_sensor(each, name) for each in TABLE}
    for do, action in bridge.commands.items():
        entity: dict[str, Any] = {
            "unique_id": f"membrane_{name}_do_{do}",
            "command_topic": f"{base}/do/{do}",
        }
        entity |= {"name": action.label, "icon": "mdi:gesture-tap-button"}
        if action.asks == "number":
            low, high = bridge.bounds[do]
            shown = "target_um" if do == "setpoint" else "flow_um_per_s"
            entity |= {"platform": "number", "min": low, "max": high, "step": 0.01, "mode": "box"}
            entity |= {
                "unit_of_measurement": action.unit,
                "value_template": f"{{{{ value_json.{shown} }}}}",
            }
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


def _describe_sensor(each: Published, name: str) -> dict[str, Any]:
    found: dict[str, Any] = {
        "platform": "sensor",
        "unique_id": f"membrane_{name}_{each.name}",
        "name": each.name,
    }
    if each.is_text:
        found["value_template"] = f"{{{{ (value_json.{each.name} or '')[:{_STATE_LETTERS}] }}}}"
        return found
    found |= {"value_template": f"{{{{ value_json.{each.name} }}}}", "state_class": "measurement"}
    if each.unit:
        found["unit_of_measurement"] = each.unit
    if each.unit in QUANTITY_OF_UNIT:  # Home Assistant has no class for lengths of micrometres
        found["device_class"] = QUANTITY_OF_UNIT[each.unit]
    return found
