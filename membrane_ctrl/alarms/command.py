"""`alarm test`: does a notice arrive?"""

from __future__ import annotations

import json

from membrane_ctrl.alarms.apprise_sender import apprise_senders
from membrane_ctrl.alarms.book import Notice
from membrane_ctrl.config import Config
from membrane_ctrl.errors import DeviceError, Exit, InputError


def send_test_alarm(config: Config, source: str, escalated: bool, as_json: bool) -> int:
    """Send one notice to all whom an alarm would reach.

    Parameters
    ----------
    config : Config
        With `[alarms]`.
    source : str
        Where it came from, for messages.
    escalated : bool
        Also to those of the escalation.
    as_json : bool
        Print the result as JSON.

    Raises
    ------
    InputError, DeviceError
        Nothing to send to; nothing was taken.
    """
    alarms = config.alarms
    if alarms.urls_file is None:
        raise InputError(f"{source}: alarms.urls_file: missing; name a file with one Apprise URL a line")
    if escalated and alarms.escalation_urls_file is None:
        raise InputError(f"{source}: alarms.escalation_urls_file: missing; there is nobody to escalate to")
    notice = Notice("raised", "test", "warning", "this is a test; nothing is wrong", escalated)
    senders = apprise_senders(alarms, "none, a test")
    files = [alarms.urls_file, alarms.escalation_urls_file][: 2 if escalated else 1]
    deaf = [file for file, send in zip(files, senders, strict=False) if not send(notice)]
    if as_json:
        print(json.dumps({"sent": not deaf}))
    if deaf:
        raise DeviceError(f"{' and '.join(map(str, deaf))}: no service took the notice; check addresses and network")
    if not as_json:
        print("sent; look whether it has arrived")
    return Exit.DONE
