"""Regular messages to another machine, which raises an alarm when they stop: only another machine
can report that this one, or its network, is dead.
"""

from __future__ import annotations

import importlib
import ssl
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from membrane_ctrl.config.service import HeartbeatConfig, HeartbeatMqttConfig
from membrane_ctrl.model import errors, files
from membrane_ctrl.model.optional import require_installed

_ANSWER_S = 10.0
_ANSWER_BYTES_MAX = 1024
_URL_BYTES_MAX = 4096
# the broker publishes `offline` after one and a half of these without a packet
_KEEPALIVE_S = 10

Send = Callable[[str], None]


class Heartbeat:
    """Sends heartbeats at intervals, while its `step` is called.

    Parameters
    ----------
    every_s : float
        Between two heartbeats of one place.
    senders : dict
        Functions that send a text, by their names in messages; they raise OSError.
    """

    def __init__(self, every_s: float, senders: dict[str, Send]) -> None:
        self._every_s = every_s
        self._senders = senders
        self._due_s = dict.fromkeys(senders, 0.0)
        self._failures: dict[str, str] = {}
        self._threads: dict[str, threading.Thread] = {}

    def step(self, now_s: float, text: str) -> None:
        """Send what is due, and never wait: each sender has a thread.

        Parameters
        ----------
        now_s : float
            Monotonic time.
        text : str
            Of the message.
        """
        for name, send in self._senders.items():
            thread = self._threads.get(name)
            if now_s < self._due_s[name] or (thread is not None and thread.is_alive()):
                continue
            self._due_s[name] = now_s + self._every_s
            thread = threading.Thread(
                target=self._send, args=(name, send, text), name=f"heartbeat {name}", daemon=True
            )
            self._threads[name] = thread
            thread.start()

    def send_once(self, text: str) -> dict[str, str]:
        """Send to all, and wait; returns why it failed, by the sender's name."""
        problems = {}
        for name, send in self._senders.items():
            try:
                send(text)
            except (OSError, ValueError) as error:
                problems[name] = str(error)
        return problems

    def _send(self, name: str, send: Send, text: str) -> None:
        """Send; print a failure when it begins and when it ends."""
        try:
            send(text)
        except (OSError, ValueError) as error:
            reason = str(error)
            if self._failures.get(name) != reason:
                print(f"heartbeat: {name}: {reason}", file=sys.stderr, flush=True)
            self._failures[name] = reason
            return
        if self._failures.pop(name, None) is not None:
            print(f"heartbeat: {name}: works again", file=sys.stderr, flush=True)


def make_heartbeat(config: HeartbeatConfig) -> Heartbeat:
    """Return the configured heartbeat; nothing is sent yet.

    Raises
    ------
    InputError
        A file cannot be read, or has no address.
    DeviceError
        The client for MQTT is not installed.
    """
    senders: dict[str, Send] = {}
    if config.url_file is not None:
        senders["url"] = HttpHeartbeat(read_address(Path(config.url_file))).send
    if config.mqtt is not None:
        senders["mqtt"] = MqttHeartbeat(config.mqtt).send
    return Heartbeat(config.every_s, senders)


def read_address(file: Path) -> str:
    """Return the address in a file. Raises InputError; the error does not repeat it: it is a
    secret.
    """
    try:
        address = files.read_text(file, _URL_BYTES_MAX, follow=True).strip()
    except (OSError, ValueError) as error:
        raise errors.InputError(f"heartbeat.url_file: {error}") from None
    parts = urlsplit(address)
    is_address = parts.scheme in ("http", "https") and bool(parts.hostname)
    if not is_address or not address.isprintable() or " " in address:
        raise errors.InputError(
            f"heartbeat.url_file: {file}: write one address into it that begins with https:// or "
            "http://"
        )
    return address


class HttpHeartbeat:
    """Posts a text to an address."""

    def __init__(self, address: str) -> None:
        self._address = address

    def send(self, text: str) -> None:
        """Post it. Raises OSError; the error does not contain the address: it is a secret."""
        request = urllib.request.Request(
            self._address, text.encode(), {"Content-Type": "text/plain; charset=utf-8"}
        )
        try:
            with urllib.request.urlopen(request, timeout=_ANSWER_S) as answer:
                answer.read(_ANSWER_BYTES_MAX)
        except urllib.error.HTTPError as error:
            error.close()
            raise OSError(f"refused with status {error.code}") from None
        except urllib.error.URLError as error:
            raise OSError(str(error.reason)) from None


class MqttHeartbeat:
    """Keeps a connection to a broker, which publishes `offline` when it breaks.

    Raises InputError for a wrong file, DeviceError without the client.
    """

    def __init__(self, config: HeartbeatMqttConfig) -> None:
        require_installed("paho", "mqtt", "heartbeat.mqtt")
        mqtt: Any = importlib.import_module("paho.mqtt.client")
        self._topic = config.topic
        self._problem = "not connected yet"
        self._client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
        if config.username is not None:
            self._client.username_pw_set(config.username, _read_password(config.password_file))
        if config.ca_file is not None:
            try:
                self._client.tls_set_context(ssl.create_default_context(cafile=config.ca_file))
            except OSError as error:
                raise errors.InputError(f"heartbeat.mqtt.ca_file: {error}") from None
        self._client.will_set(self._topic, "offline", qos=1, retain=True)
        self._client.on_connect = self._note_connection
        self._client.on_connect_fail = self._note_failure
        self._client.on_disconnect = self._note_end
        self._host = config.host
        self._port = config.port
        self._where = f"{config.host}:{config.port}"
        self._has_begun = False

    def send(self, text: str) -> None:
        """Publish that the service is online, and the text. Raises OSError.

        The first call begins to connect; the client connects again by itself.
        """
        if not self._has_begun:
            self._has_begun = True
            self._client.connect_async(self._host, self._port, _KEEPALIVE_S)
            self._client.loop_start()
        until_s = time.monotonic() + _ANSWER_S
        while self._problem and time.monotonic() < until_s:
            time.sleep(0.1)
        if self._problem:
            raise OSError(f"{self._where}: {self._problem}")
        self._publish_online()
        self._client.publish(f"{self._topic}/time_utc", _utc_text(), qos=1, retain=True)
        self._client.publish(f"{self._topic}/holds", text, qos=1, retain=True)

    def _publish_online(self) -> None:
        self._client.publish(self._topic, "online", qos=1, retain=True)

    def _note_connection(self, client: Any, data: Any, flags: Any, code: Any, more: Any) -> None:
        self._problem = f"refused: {code}" if code.is_failure else ""
        if not self._problem:
            self._publish_online()

    def _note_failure(self, client: Any, data: Any) -> None:
        self._problem = "no broker answers"

    def _note_end(self, client: Any, data: Any, flags: Any, code: Any, more: Any) -> None:
        self._problem = f"the connection ended ({code})"


def _utc_text() -> str:
    return f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}"


def _read_password(file: str | None) -> str | None:
    try:
        return None if file is None else files.read_text(Path(file), follow=True).strip()
    except (OSError, ValueError) as error:
        raise errors.InputError(f"heartbeat.mqtt.password_file: {error}") from None
