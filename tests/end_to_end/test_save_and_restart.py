"""A person edits the configuration of a running hold on the page: it is checked and saved, and the
hold restarts with it. A program does the same over HTTP.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest

from membrane_ctrl.config.port import SOCKET_NAME
from membrane_ctrl.control_port import sockets
from membrane_ctrl.control_port.ctl import Where, connected
from membrane_ctrl.service.configuration_editor import FORMER_FOLDER
from membrane_ctrl.service.tokens import add_token, tokens_file
from tests.support.browser import browser_tab
from tests.support.machine_needs import needs
from tests.web.test_configuration_panel import EDITOR, click
from tests.web.test_page import served

PATIENCE_S = 240.0
GAIN, OTHER_GAIN, THIRD_GAIN = 0.5, 0.4, 0.3
ROLES = ("read", "operate", "tune")


def configuration(kp_per_s: float) -> str:
    """A simulated bench that is patient with a busy machine, as far as its watchdog admits, and
    soon holds.
    """
    return (
        "[limits]\nlateness_max_ms = 450.0\n[twin]\nport = 0\nscenario = 'quiet'\n"
        "start_error_um = -2.0\n[shape]\nenabled = false\n"
        "[states]\nactuator_test = false\ncheck_s = 0.5\n"
        f"[loop]\nkp_per_s = {kp_per_s}\n"
    )


@asynccontextmanager
async def programs_of(link: str) -> AsyncIterator[dict[str, httpx.AsyncClient]]:
    """Clients of the service with tokens, one for each role."""
    clients = {
        role: httpx.AsyncClient(
            base_url=link.partition("?")[0],
            headers={"Authorization": f"Bearer {add_token(tokens_file(), role, role)}"},
            timeout=60.0,
        )
        for role in ROLES
    }
    try:
        async with asyncio.timeout(PATIENCE_S):
            while not await listens(clients["read"]):  # noqa: ASYNC110
                await asyncio.sleep(0.2)
        yield clients
    finally:
        for client in clients.values():
            await client.aclose()


async def listens(program: httpx.AsyncClient) -> bool:
    try:
        return (await program.get("api/me")).status_code == 200
    except httpx.ConnectError:
        return False


async def until(
    program: httpx.AsyncClient, found: Callable[[dict[str, Any]], object]
) -> dict[str, Any]:
    """The state once it is as wanted."""
    async with asyncio.timeout(PATIENCE_S):
        while True:
            state: dict[str, Any] = (await program.get("api/state")).json()
            failure = (await program.get("api/start")).json()["text"]
            assert not failure, failure
            if found(state):
                return state
            await asyncio.sleep(0.5)


def holds_with(state: dict[str, Any], kp_per_s: float) -> bool:
    return (
        state["in_contact"]
        and state["state"] == "hold"
        and state["status"]["gains"]["kp_per_s"] == kp_per_s
    )


def begin_experiment(logs: Path) -> None:
    """A program of this machine does it: the interface for programs does not."""
    with connected(Where(logs=logs)) as client:
        relay = {
            "kind": "relay",
            "duration_s": 300.0,
            "holding_flow_um_per_s": 1.2,  # about the twin's leak; the flow of one tick may be 0
            "laser_um": 1.0,
        }
        answer = client.ask(do="tune", experiment=relay)
    assert answer["ok"], answer


def describe_refusal(answer: httpx.Response) -> str:
    """What a refusal says, which is one line."""
    text = answer.json().get("detail") or answer.json()["text"]
    assert isinstance(text, str), text
    assert "\n" not in text
    return text


@needs("chromium")
@pytest.mark.real_time
async def test_a_key_is_edited_and_the_hold_restarts_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    folder, logs = tmp_path / "configurations", tmp_path / "logs"
    folder.mkdir()
    logs.mkdir()
    (folder / "lab.toml").write_text(configuration(GAIN))
    async with served(logs, "--configurations", str(folder)) as link, programs_of(link) as by:
        tuner, operator, reader = by["tune"], by["operate"], by["read"]
        try:
            begun = await operator.post("api/start", json={"configuration": "lab"})
            assert begun.status_code == 202, begun.text
            first = await until(reader, lambda state: holds_with(state, GAIN))

            # a program gets one line for each refusal, and the first run continues
            found = (await tuner.get("api/configurations/lab")).json()
            bad = {"text": configuration(-1.0), "digest": found["digest"]}
            refused = await tuner.put("api/configurations/lab", json=bad)
            assert refused.status_code == 409
            assert "loop.kp_per_s" in describe_refusal(refused)
            wanted = {"configuration": "lab"}
            refused = await reader.post("api/restart", json=wanted)
            assert refused.status_code == 403
            assert describe_refusal(refused) == "restart needs the role operate; read has read"
            refused = await operator.put("api/configurations/lab", json=bad)
            assert refused.status_code == 403
            (folder / "broken.toml").write_text("[loop]\nkp = 1\n")
            for name, reason in (("none", "no such configuration"), ("broken", "kp")):
                refused = await operator.post("api/restart", json={"configuration": name})
                assert refused.status_code == 409
                assert reason in describe_refusal(refused)
            await asyncio.to_thread(begin_experiment, logs)
            await until(reader, lambda state: state["state"] == "tune")
            refused = await operator.post("api/restart", json=wanted)
            assert refused.status_code == 409
            assert "in an experiment" in describe_refusal(refused)
            await operator.post("api/commands", json={"do": "hold"})
            same = await until(reader, lambda state: state["state"] == "hold")
            assert same["run"] == first["run"]

            # a person: edits the key, saves, and restarts
            async with browser_tab(link, tmp_path / "profile") as tab:
                await tab.until("document.querySelector('[aria-label=state]').innerText === 'hold'")
                await click(tab, "configuration")
                await tab.until(
                    f"document.querySelector('.cm-content')?.innerText.includes('{GAIN}')"
                )
                for text in (configuration(-1.0), configuration(OTHER_GAIN)):
                    whole = f"{EDITOR}.state.doc.length"
                    change = f"{{changes: {{from: 0, to: {whole}, insert: {json.dumps(text)}}}}}"
                    await tab.value(f"{EDITOR}.dispatch({change})")
                    await asyncio.sleep(1.0)  # the text reaches the service
                    await click(tab, "save and restart")
                    await tab.until("!!document.querySelector('.q-dialog')")
                    await tab.value("[...document.querySelectorAll('.q-dialog button')][0].click()")
                    await tab.until("!document.querySelector('.q-dialog')")
                    if "-1.0" in text:
                        await tab.until("document.body.innerText.includes('loop.kp_per_s')")
                        assert (folder / "lab.toml").read_text() == configuration(GAIN)
                second = await until(reader, lambda state: holds_with(state, OTHER_GAIN))
                assert second["run"] != first["run"]
                await tab.until(
                    f"document.querySelector('.text-h6').innerText.includes('{second['run']}')"
                )
            (former,) = (folder / FORMER_FOLDER).iterdir()
            assert former.name.startswith("lab-")
            assert former.read_text() == configuration(GAIN)

            # a program does it, too
            found = (await tuner.get("api/configurations/lab")).json()
            assert found["text"] == configuration(OTHER_GAIN)
            good = {"text": configuration(THIRD_GAIN), "digest": found["digest"]}
            assert (await tuner.put("api/configurations/lab", json=good)).status_code == 200
            begun = await operator.post("api/restart", json=wanted)
            assert (begun.status_code, begun.json()["done"]) == (202, True)
            again = await operator.post("api/restart", json=wanted)
            assert (again.status_code, describe_refusal(again)) == (
                409,
                "a restart is under way already",
            )
            third = await until(reader, lambda state: holds_with(state, THIRD_GAIN))
            assert third["run"] not in (first["run"], second["run"])
            assert len(list((folder / FORMER_FOLDER).iterdir())) == 2
        finally:
            await operator.post("api/safety/stop")
            async with asyncio.timeout(PATIENCE_S):
                while sockets.is_listening(logs / SOCKET_NAME):  # noqa: ASYNC110
                    await asyncio.sleep(0.2)
