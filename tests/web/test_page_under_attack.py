"""Strangers cannot delay a logged-in user, keep an owner out, or make the page fail."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from membrane_ctrl.service.accounts import known_user
from tests.support.service_attacks import ATTACKS, ROUTES, Viewer, attack
from tests.web.test_page import served
from tests.worlds.port_run import PortRun, keep_ticking, port_run

PASSWORD = "correct horse"
STOP_S = 3.0  # 1 s is wanted, on a machine that is not busy
CHART_S = 3.0  # also on a busy machine
# of each resource one: password hashes, connections, the time of a request, its bytes
FEW_ATTACKS = ("logins", "silence", "slow-heads", "large-bodies")


@asynccontextmanager
async def serving(folder: Path, *options: str) -> AsyncIterator[tuple[PortRun, str]]:
    """A hold and its page with two accounts; yields the hold and the page's address."""
    users = folder / "users"
    lines = [
        known_user(name, role, PASSWORD).line()
        for name, role in (("anna", "operate"), ("bob", "read"))
    ]
    users.write_text("\n".join(lines))
    async with port_run(folder) as run, served(folder, "--users", str(users), *options) as url:
        ticks = asyncio.create_task(keep_ticking(run))
        try:
            await asyncio.sleep(1.0)
            yield run, url
        finally:
            ticks.cancel()


@pytest.mark.fast_cases("few")
@pytest.mark.parametrize("names", [FEW_ATTACKS, tuple(sorted(ATTACKS))], ids=["few", "all"])
@pytest.mark.real_time
async def test_strangers_delay_neither_chart_nor_stop(
    names: tuple[str, ...], tmp_path: Path
) -> None:
    """One attack after the other on the same service."""
    async with serving(tmp_path) as (run, url), Viewer(url) as anna:
        assert await anna.log_in("anna", PASSWORD) == 303
        for name in names:
            run.asked.clear()
            async with attack(name, url, clients=100 if name != "silence" else 2000):
                charts_s = await anna.latencies_s(ROUTES.live, 8)
                stops_s = await anna.latencies_s(ROUTES.stop, 8, method="POST")
                async with Viewer(url) as other:  # on a new connection
                    other.client.cookies = anna.client.cookies
                    stops_s += await other.latencies_s(ROUTES.stop, 1, method="POST")
            assert max(charts_s) < CHART_S, (name, charts_s)
            assert max(stops_s) < STOP_S, (name, stops_s)
            assert [command.kind for command in run.asked] == ["stop"] * 9, name


@pytest.mark.real_time
async def test_a_user_who_asks_for_everything_delays_no_other(tmp_path: Path) -> None:
    signals = (
        "error_um",
        "displacement_um",
        "pump_fraction",
        "leak_um_per_s",
        "gauge_pressure_pa",
        "trim_um",
    )
    spans = ("1 min", "10 min", "1 h", "8 h", "1 day", "1 week", "1 month")
    paths = [
        ROUTES.history.format(signal=signal, span=span, utc=utc)
        for signal in signals
        for span in spans
        for utc in ("true", "false")
    ]

    async with serving(tmp_path) as (_, url), Viewer(url) as anna, Viewer(url) as bob:
        assert await anna.log_in("anna", PASSWORD) == 303
        assert await bob.log_in("bob", PASSWORD) == 303

        async def ask_for_everything() -> None:
            while True:
                await asyncio.gather(*(bob.client.get(path) for path in paths))

        greedy = asyncio.create_task(ask_for_everything())
        await asyncio.sleep(2.0)
        stops_s = await anna.latencies_s(ROUTES.stop, 10, method="POST")
        assert not greedy.done(), greedy
        greedy.cancel()
        assert max(stops_s) < STOP_S, stops_s


@pytest.mark.real_time
async def test_the_owner_gets_in_while_the_name_is_attacked(tmp_path: Path) -> None:
    async with serving(tmp_path) as (_, url), Viewer(url) as anna:
        assert await anna.log_in("anna", PASSWORD) == 303
        anna.client.cookies.delete("membrane_ctrl")  # the session has ended; the device is the same
        async with attack("owner", url, clients=40), Viewer(url) as stranger:
            assert await guess_until_refused(stranger) in (429, 503)
            statuses = [await anna.log_in("anna", PASSWORD) for _ in range(8)]
            assert statuses == [303] * 8
            # each login of the owner gives her address its budget of five guesses back
            assert await guess_until_refused(stranger) in (429, 503)


async def guess_until_refused(stranger: Viewer) -> int:
    """Guess the owner's password no more often than its budgets admit; returns the last status."""
    status = 401
    guesses = 0
    while status == 401 and guesses < 8:
        status = await stranger.log_in("anna", "guess guess")
        guesses += 1
    return status


@pytest.mark.real_time
async def test_parallel_guesses_are_counted(tmp_path: Path) -> None:
    async with serving(tmp_path) as (_, url), Viewer(url) as stranger:
        tries = [stranger.log_in("anna", f"guess {number:03}") for number in range(40)]
        statuses = await asyncio.gather(*tries)
        assert statuses.count(401) <= 5
        assert set(statuses) <= {401, 429, 503}


@pytest.mark.real_time
async def test_stop_needs_a_session_a_role_and_this_page(tmp_path: Path) -> None:
    async with serving(tmp_path) as (run, url), Viewer(url) as anna, Viewer(url) as bob:
        assert (await anna.client.post(ROUTES.stop)).status_code == 401
        assert await anna.log_in("anna", PASSWORD) == 303
        assert await bob.log_in("bob", PASSWORD) == 303
        assert (await bob.client.post(ROUTES.stop)).status_code == 403
        foreign = {"origin": "http://evil.example"}
        assert (await anna.client.post(ROUTES.stop, headers=foreign)).status_code == 403
        assert (await anna.client.post("api/safety/stop?hold=none")).status_code == 404
        assert (await anna.client.get(ROUTES.stop)).status_code in (404, 405)
        assert run.asked == []
        answer = await anna.client.post(ROUTES.stop)
        assert (answer.status_code, answer.json()["text"]) == (200, "stop: done")
        assert [(command.kind, command.why) for command in run.asked] == [("stop", "page: anna")]
