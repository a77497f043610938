"""Each path of the interface for programs with each role."""

from __future__ import annotations

from pathlib import Path

import pytest
from fastapi.routing import APIRoute

from membrane_ctrl.control_port.sender import role_includes
from membrane_ctrl.controller.command import Role
from membrane_ctrl.controller.commands import TABLE
from membrane_ctrl.service.access import ACTIONS, STOP, UNLOCK
from membrane_ctrl.service.api import make_api
from membrane_ctrl.service.configuration_editor import ConfigurationEditor
from membrane_ctrl.service.hold_starter import HoldStarter
from tests.service.test_api import running

SAFETY = ("stop", "vent", "lower", "latch")
LAB = {"configuration": "lab"}
TEXT = {"text": "[loop]\n", "digest": ""}
# path, body, and the least role; `read` is everybody who is let in
READS = (
    "/api/me",
    "/api/holds",
    "/api/state",
    "/api/signals",
    "/api/history?signal=error_um",
    "/api/events",
    "/api/runs",
    "/api/configurations",
    "/api/start",
    "/metrics",
)
NEEDS: tuple[tuple[str, str, object, Role], ...] = (
    *(("GET", path, None, "read") for path in READS),  # type: ignore[misc]
    ("GET", "/api/configurations/lab", None, "tune"),
    ("POST", "/api/configurations/lab/check", TEXT, "tune"),
    ("PUT", "/api/configurations/lab", TEXT, "tune"),
    ("POST", "/api/start", LAB, "operate"),
    ("POST", "/api/restart", LAB, "operate"),
    *(("POST", f"/api/safety/{do}", None, TABLE[do].role) for do in SAFETY),  # type: ignore[index]
)
STREAM = "/api/stream"  # without an end, and open to all; `test_api` reads it


def _is_of(path: str, template: str) -> bool:
    parts, wanted = path.partition("?")[0].split("/"), template.split("/")
    return len(parts) == len(wanted) and all(
        part == name or name.startswith("{") for part, name in zip(parts, wanted, strict=True)
    )


def test_every_path_is_in_the_table_of_roles(tmp_path: Path) -> None:
    starter = HoldStarter(tmp_path, tmp_path, units=False)
    api = make_api({}, starter, ConfigurationEditor(tmp_path))
    starter.close()
    listed = [(method, path) for method, path, _, _ in NEEDS]
    listed += [("GET", STREAM), ("POST", "/api/commands")]
    for route in api.routes:
        if isinstance(route, APIRoute) and route.include_in_schema:
            for method in route.methods:
                assert any(
                    method == known and _is_of(path, route.path) for known, path in listed
                ), f"state the role of {method} {route.path} here"


@pytest.mark.real_time
async def test_every_path_refuses_a_lesser_role(tmp_path: Path) -> None:
    async with running(tmp_path) as (run, programs):
        for method, path, body, needed in NEEDS:
            for role, program in programs.of.items():
                if role_includes(role, needed):  # type: ignore[arg-type]
                    continue
                answer = await program.request(method, path, json=body)
                assert answer.status_code == 403, (role, method, path)
        assert run.asked == []
        for method, path, body, needed in NEEDS:
            if path.startswith(("/api/start", "/api/restart")) and method == "POST":
                continue  # there is no such configuration: nothing starts
            answer = await programs.of[needed].request(method, path, json=body)
            assert answer.status_code != 403, (needed, method, path)


@pytest.mark.real_time
async def test_every_command_refuses_a_lesser_role(tmp_path: Path) -> None:
    values = {"number": {"value": 1.0}, "text": {"text": "a"}, "": {}}
    bodies = {
        action.do: ({"do": action.do, **values[action.asks]}, action.role)
        for action in (*ACTIONS, STOP, UNLOCK)
    }
    gains = {"do": "gains", "loop": {"kp_per_s": 0.5}}
    bodies["gains"] = (gains, TABLE["gains"].role)
    assert {str(kind) for kind in TABLE} - bodies.keys() == {"tune"}, "an experiment: by `ctl`"
    async with running(tmp_path) as (run, programs):
        for body, needed in bodies.values():
            for role, program in programs.of.items():
                if not role_includes(role, needed):  # type: ignore[arg-type]
                    answer = await program.post("/api/commands", json=body)
                    assert answer.status_code == 403, (role, body)
        assert run.asked == []
        for body, needed in bodies.values():
            answer = await programs.of[needed].post("/api/commands", json=body)
            assert answer.status_code != 403, (needed, body)
        assert {each.kind for each in run.asked} >= set(TABLE) - {"tune"}
