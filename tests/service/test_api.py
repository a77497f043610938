"""The interface for programs: answers by the models, roles, refusals, the stream, the metrics."""

from __future__ import annotations

import asyncio
import json
import re
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families

from membrane_ctrl.control_port.api_models import StateAnswer
from membrane_ctrl.control_port.ctl import Where
from membrane_ctrl.model.columns import COLUMNS, PUBLISHED
from membrane_ctrl.model.run_events import Ended, Mark
from membrane_ctrl.service.api import make_api
from membrane_ctrl.service.configuration_editor import ConfigurationEditor
from membrane_ctrl.service.feed import HoldFeed
from membrane_ctrl.service.hold_starter import HoldStarter
from membrane_ctrl.service.published_signals import SIGNAL_TABLE
from membrane_ctrl.service.web_user import WebUser
from tests.service.test_ended_run import FAULT, write_run
from tests.worlds.port_run import PortRun, port_run

ROLES = {"read": "bob", "operate": "anna", "tune": "carl"}


class Programs:
    """Clients of the interface, one for each role, without the login."""

    def __init__(
        self, feeds: dict[str, HoldFeed], starter: HoldStarter, editor: ConfigurationEditor
    ) -> None:
        api = make_api(feeds, starter, editor)

        def app_for(role: str) -> Any:
            user = WebUser(ROLES[role], role, has_login=True, via="token")  # type: ignore[arg-type]

            async def app(scope: Any, receive: Any, send: Any) -> None:
                await api({**scope, "membrane_user": user}, receive, send)

            return app

        self.of = {
            role: httpx.AsyncClient(
                transport=httpx.ASGITransport(app_for(role)), base_url="http://service"
            )
            for role in ROLES
        }


@asynccontextmanager
async def programs_of(folder: Path) -> AsyncIterator[Programs]:
    """The interface of a folder of runs, with a feed that follows."""
    feed = HoldFeed(Where(logs=folder))
    starter = HoldStarter(folder, folder, units=False)
    feed.open()
    try:
        yield Programs({"": feed}, starter, ConfigurationEditor(folder))
    finally:
        await asyncio.to_thread(feed.close)
        starter.close()


@asynccontextmanager
async def running(folder: Path) -> AsyncIterator[tuple[PortRun, Programs]]:
    """A hold that ticks, and its interface once it is in contact."""
    async with port_run(folder) as run, programs_of(folder) as programs:
        ticks = asyncio.create_task(_tick(run))
        try:
            await until(programs, lambda state: state.in_contact)
            yield run, programs
        finally:
            ticks.cancel()


async def _tick(run: PortRun) -> None:
    while True:
        run.tick()
        await asyncio.sleep(0.1)


async def state_of(programs: Programs) -> StateAnswer:
    answer = await programs.of["read"].get("/api/state")
    assert answer.status_code == 200
    return StateAnswer.model_validate(answer.json(), strict=True)


async def until(programs: Programs, found: Callable[[StateAnswer], bool]) -> None:
    """Wait until the state is as wanted."""
    async with asyncio.timeout(60.0):
        while True:
            if found(await state_of(programs)):
                return
            await asyncio.sleep(0.1)


@pytest.mark.real_time
async def test_a_program_reads_everything_about_a_hold(tmp_path: Path) -> None:
    async with running(tmp_path) as (run, programs):
        reader = programs.of["read"]
        state = await state_of(programs)
        assert (state.run, state.state, state.error_um) == ("the-run", "hold", 0.25)
        assert state.ended is None
        signals = (await reader.get("/api/signals")).json()
        assert [each["name"] for each in signals] == [each.name for each in SIGNAL_TABLE]
        assert {column.name for column in PUBLISHED} < {each["name"] for each in signals}
        assert {each["name"]: each["value"] for each in signals}["state"] == "hold"
        assert {each["name"]: each["unit"] for each in signals}["error_um"] == "µm"
        assert {each["name"]: each["value"] for each in signals}["error_um"] == 0.25
        run.port.note_report(Mark("door", "anna"))
        async with asyncio.timeout(60.0):
            while True:
                if any("door" in line for line in (await reader.get("/api/events")).json()):
                    break
                await asyncio.sleep(0.1)
        assert (await reader.get("/api/me")).json() == {
            "name": "bob",
            "role": "read",
            "via": "token",
        }
        assert (await reader.get("/api/holds")).json()["holds"][0]["run"] == "the-run"
        assert (await reader.get("/api/state?hold=other")).status_code == 404
        assert (await reader.get("/api/history?signal=x")).status_code == 404
        paths = (await reader.get("/openapi.json")).json()["paths"]
        assert {"/api/state", "/api/commands", "/api/safety/{command}"} <= set(paths)
        described = await reader.get("/docs")
        assert described.status_code == 200
        sources = re.findall(r'(?:src|href)="([^"]+)"', described.text)
        assert len(sources) >= 2
        for source in sources:
            assert source.startswith("/docs/files/"), "nothing from other machines"
            assert (await reader.get(source)).status_code == 200
        metrics = {
            (sample.name, *sample.labels.values()): sample.value
            for family in text_string_to_metric_families((await reader.get("/metrics")).text)
            for sample in family.samples
        }
        assert metrics["membrane_hold_up", ""] == 1.0
        assert metrics["membrane_error_um", ""] == 0.25
        assert metrics["membrane_in_state", "", "hold"] == 1.0
        assert metrics["membrane_in_state", "", "fault"] == 0.0
        assert metrics["membrane_ticks_total", ""] == 600.0
        assert len({name for name, *_ in metrics}) >= len(COLUMNS)


@pytest.mark.real_time
async def test_commands_need_their_role_and_carry_their_author(tmp_path: Path) -> None:
    async with running(tmp_path) as (run, programs):
        reader, operator, tuner = (programs.of[role] for role in ROLES)
        refused = await reader.post("/api/commands", json={"do": "pause"})
        assert (refused.status_code, refused.json()["detail"]) == (
            403,
            "pause needs the role operate; bob has read",
        )
        gains = {"do": "gains", "loop": {"kp_per_s": 0.5}}
        assert (await operator.post("/api/commands", json=gains)).status_code == 403
        assert run.asked == []
        done = await operator.post("/api/commands", json={"do": "setpoint", "value": 2.5})
        assert (done.status_code, done.json()["text"]) == (200, "setpoint: done")
        assert (await tuner.post("/api/commands", json=gains)).status_code in (200, 409)
        for wrong in (
            {"do": "setpoint"},
            {"do": "fly"},
            {"do": "pause", "on_behalf": {"via": "page", "role": "tune"}},
            {"do": "watch"},
            {"do": "setpoint", "value": "x"},
        ):
            status = (await operator.post("/api/commands", json=wrong)).status_code
            assert status in (409, 422), wrong
        setpoint = run.asked[0]
        assert (setpoint.kind, setpoint.value) == ("setpoint", 2.5)
        assert setpoint.who == "token:anna"
        assert setpoint.why == "token: anna"


@pytest.mark.real_time
async def test_safety_commands_have_a_path_of_their_own(tmp_path: Path) -> None:
    async with running(tmp_path) as (run, programs):
        reader, operator = programs.of["read"], programs.of["operate"]
        assert (await reader.post("/api/safety/stop")).status_code == 403
        assert (await operator.post("/api/safety/hold")).status_code == 422
        assert (await operator.get("/api/safety/stop")).status_code == 405
        assert run.asked == []
        for command in ("vent", "lower", "stop"):
            answer = await operator.post(f"/api/safety/{command}")
            assert (answer.status_code, answer.json()["done"]) == (200, True)
        locked = await operator.post("/api/safety/latch", json={"text": "hands inside"})
        assert locked.status_code in (200, 409)
        assert [each.kind for each in run.asked] == ["vent", "lower", "stop", "latch"]
        lock = run.asked[-1].lock
        assert lock is not None
        assert (lock.text, lock.account) == ("hands inside", "token:anna")


@pytest.mark.real_time
async def test_the_stream_has_states_and_events(tmp_path: Path) -> None:
    """Against the application itself: a test client would wait for the end of the stream."""
    async with running(tmp_path) as (run, programs):
        feed_api = programs.of["read"]._transport.app  # type: ignore[attr-defined]
        received: asyncio.Queue[bytes] = asyncio.Queue()

        async def send(message: Any) -> None:
            if message.get("body"):
                await received.put(message["body"])

        async def receive() -> Any:
            await asyncio.Event().wait()

        scope = {
            "type": "http",
            "method": "GET",
            "path": "/api/stream",
            "raw_path": b"/api/stream",
            "query_string": b"",
            "headers": [],
        }
        streaming = asyncio.create_task(feed_api(scope, receive, send))
        try:
            async with asyncio.timeout(60.0):
                first = (await received.get()).decode()
                assert first.startswith("event: state\ndata: ")
                state = StateAnswer.model_validate(json.loads(first.partition("data: ")[2]))
                assert state.run == "the-run"
                run.port.note_report(Mark("door", "anna"))
                while b"event: event" not in (message := await received.get()):
                    pass
                assert "door" in json.loads(message.decode().partition("data: ")[2])
        finally:
            streaming.cancel()
            await asyncio.gather(streaming, return_exceptions=True)


@pytest.mark.real_time
async def test_after_a_hold_the_end_of_its_run_is_answered(tmp_path: Path) -> None:
    folder = write_run(tmp_path, [(18.0, FAULT), (20.0, Ended("safety_trip", 5))])
    async with programs_of(tmp_path) as programs:
        await until(programs, lambda state: state.ended is not None)
        state = await state_of(programs)
        assert state.ended is not None
        assert (state.state, state.ended.kind, state.ended.run) == ("fault", "fault", folder.name)
        assert state.ended.read_back is not None
        assert state.ended.read_back.pump_fraction == pytest.approx(0.3)
        reader, operator = programs.of["read"], programs.of["operate"]
        history = (await reader.get("/api/history?signal=error_um&span_s=3600")).json()
        assert len(history["utc_s"]) == len(history["mean"]) > 5
        (run,) = (await reader.get("/api/runs")).json()
        assert (run["name"], run["faults"], run["ended_in"]) == (folder.name, 1, "locked")
        metrics = (await reader.get("/metrics")).text
        assert 'membrane_hold_up{hold=""} 0.0' in metrics
        assert "membrane_error_um{" not in metrics, "no value of a hold that has gone"
        signals = (await reader.get("/api/signals")).json()
        values = {each["name"]: each["value"] for each in signals}
        assert values.pop("state") == "no contact"
        assert all(values[name] is None for name in ("error_um", "sag_um", "fault"))
        answer = await operator.post("/api/safety/stop")
        assert (answer.status_code, answer.json()) == (
            503,
            {"done": False, "text": "stop: not sent: no hold runs", "answer": {}},
        )


@pytest.mark.real_time
async def test_a_start_needs_its_role_and_a_configuration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with programs_of(tmp_path) as programs:
        reader, operator = programs.of["read"], programs.of["operate"]
        monkeypatch.setattr(sys, "executable", "/bin/true")
        body = {"configuration": "twin"}
        assert (await reader.post("/api/start", json=body)).status_code == 403
        assert (await reader.get("/api/configurations")).json() == [
            {"name": "twin", "has_devices": False, "problem": ""}
        ]
        wrong = await operator.post("/api/start", json={"configuration": "none"})
        assert (wrong.status_code, wrong.json()["detail"]) == (
            409,
            "none: no such configuration; known: twin",
        )
        begun = await operator.post("/api/start", json=body)
        assert (begun.status_code, begun.json()["done"]) == (202, True)
        assert (await reader.get("/api/start")).json()["done"]


async def test_only_the_role_tune_reads_and_edits_configurations(tmp_path: Path) -> None:
    (tmp_path / "lab.toml").write_text("[loop]\nkp_per_s = 0.5\n")
    async with programs_of(tmp_path) as programs:
        for role in ("read", "operate"):
            client = programs.of[role]
            assert (await client.get("/api/configurations/lab")).status_code == 403
            body = {"text": "", "digest": ""}
            assert (
                await client.post("/api/configurations/lab/check", json=body)
            ).status_code == 403
            assert (await client.put("/api/configurations/lab", json=body)).status_code == 403
        tuner = programs.of["tune"]
        found = (await tuner.get("/api/configurations/lab")).json()
        wrong = {"text": "[loop]\nkp = 1\n", "digest": found["digest"]}
        checked = (await tuner.post("/api/configurations/lab/check", json=wrong)).json()
        assert "kp" in checked["errors"][0]
        assert (await tuner.put("/api/configurations/lab", json=wrong)).status_code == 409
        good = {"text": "[loop]\nkp_per_s = 0.4\n", "digest": found["digest"]}
        assert (await tuner.put("/api/configurations/lab", json=good)).status_code == 200
        assert (await tuner.put("/api/configurations/lab", json=good)).status_code == 409
        assert (await tuner.get("/api/configurations/..%2Fsecret")).status_code in (404, 409)
        assert (await tuner.get("/api/configurations/none")).status_code == 409
