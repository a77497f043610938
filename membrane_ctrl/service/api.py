"""The interface for programs: HTTP with JSON below `/api`, described at `/docs`.

The login is outside (`login`): each request comes with its user. Safety commands have a path, and
threads, of their own.
"""

import asyncio
import json
import math
import time
from collections.abc import AsyncIterator, Iterator, Mapping
from contextlib import contextmanager
from http import HTTPStatus
from typing import Annotated, Any, Literal

from fastapi import Body, Depends, FastAPI, HTTPException, Query, Request, Response
from fastapi.responses import StreamingResponse
from fastapi_offline import FastAPIOffline

from membrane_ctrl.control_port.api_models import (
    CheckedConfigurationAnswer,
    CommandAnswer,
    CommandBody,
    ConfigurationAnswer,
    ConfigurationBody,
    ConfigurationTextAnswer,
    HistoryAnswer,
    Reading,
    RestartBody,
    RunAnswer,
    RunEndAnswer,
    SafetyBody,
    SignalAnswer,
    StartBody,
    StateAnswer,
    StatesAnswer,
    UserAnswer,
)
from membrane_ctrl.control_port.outcome import Outcome
from membrane_ctrl.control_port.sender import Peer, explain_missing_role, role_includes
from membrane_ctrl.control_port.status_lines import alarm_lines, lock_lines
from membrane_ctrl.controller.command import Role
from membrane_ctrl.model import errors
from membrane_ctrl.model.columns import COLUMNS
from membrane_ctrl.model.program import program_identity
from membrane_ctrl.review import catalogue
from membrane_ctrl.service.access import on_behalf
from membrane_ctrl.service.configuration_editor import ConfigurationEditor
from membrane_ctrl.service.ended_run import REPORT_NAME, EndedRun
from membrane_ctrl.service.event_lines import find_new_lines
from membrane_ctrl.service.feed import SIGNALS, HoldFeed, history
from membrane_ctrl.service.hold_restart import begin_restart
from membrane_ctrl.service.hold_seen import HoldSeen
from membrane_ctrl.service.hold_starter import HoldStarter, StartOptions
from membrane_ctrl.service.metrics import METRICS_TYPE, render_metrics
from membrane_ctrl.service.published_signals import SIGNAL_TABLE
from membrane_ctrl.service.send_limits import SendLimits
from membrane_ctrl.service.web_user import WebUser
from membrane_ctrl.service.work_pool import PoolFullError, WorkPool
from membrane_ctrl.service.work_pools import (
    CONFIGURATIONS,
    LONG_CHARTS,
    RUN_LISTS,
    SAFETY_COMMANDS,
    pool_of_command,
)

_DOCS_FILES = "/docs/files"
PATHS = ("/api", "/docs", "/openapi.json", "/metrics")
_STREAMS_MOST = 100
_STREAM_S = 0.5  # between looks for something new
_HEARTBEAT_S = 15.0
_SPAN_MOST_S = 366 * 86_400.0
# requests of the socket that make no sense on a connection of a single request
_SOCKET_ONLY = frozenset({"watch", "claim", "status"})
_DESCRIPTION = """State, signals, events and runs of the holds of one service; commands to them.

Log in with a session of the page, or send `Authorization: Bearer TOKEN` with a token of
`membrane-ctrl serve token add NAME ROLE`."""

HoldName = Annotated[str, Query(description="Name of the hold; empty for the service's own.")]


async def _find_user(request: Request) -> WebUser:
    user: WebUser = request.scope["membrane_user"]
    return user


async def _find_feed(request: Request, hold: HoldName = "") -> HoldFeed:
    feeds: Mapping[str, HoldFeed] = request.app.state.feeds
    feed = feeds.get(hold)
    if feed is None:
        raise HTTPException(HTTPStatus.NOT_FOUND, f"no hold {hold!r}; known: {', '.join(feeds)}")
    return feed


User = Annotated[WebUser, Depends(_find_user)]
Feed = Annotated[HoldFeed, Depends(_find_feed)]


def make_api(
    feeds: Mapping[str, HoldFeed], starter: HoldStarter, editor: ConfigurationEditor
) -> FastAPI:
    """Return the application.

    Parameters
    ----------
    feeds : mapping of HoldFeed
        The holds by name.
    starter : HoldStarter
        Starts the holds of the service's own folder.
    editor : ConfigurationEditor
        Of the configurations with which they are started.
    """
    # with its scripts from this machine: a laboratory may have no internet
    api = FastAPIOffline(
        static_url=_DOCS_FILES,
        title="membrane_ctrl",
        version=program_identity(),
        description=_DESCRIPTION,
        redoc_url=None,
    )
    api.state.feeds = feeds
    _add_state_routes(api, feeds)
    _add_configuration_routes(api, starter, editor)
    _add_start_routes(api, starter)
    _add_command_routes(api)
    _add_streams(api, feeds)
    return api


def _add_state_routes(api: FastAPI, feeds: Mapping[str, HoldFeed]) -> None:
    """Add the routes that read holds: state, signals, history, events and runs."""

    @api.get("/api/me")
    async def me(user: User) -> UserAnswer:
        """Who asks, and with which role."""
        return UserAnswer(name=user.name, role=user.role, via=user.via)

    @api.get("/api/holds")
    async def list_holds() -> StatesAnswer:
        """All holds of the service."""
        return StatesAnswer(holds=[describe_state(name, feed.seen) for name, feed in feeds.items()])

    @api.get("/api/state")
    async def get_state(feed: Feed, hold: HoldName = "") -> StateAnswer:
        """One hold, now."""
        return describe_state(hold, feed.seen)

    @api.get("/api/signals")
    async def list_signals(feed: Feed) -> list[SignalAnswer]:
        """The published signals with units and present values; null: not known."""
        values = feed.signal_values()
        return [
            SignalAnswer(
                name=each.name,
                title=each.title,
                description=each.description,
                unit="text" if each.is_text else each.unit,
                value=values.get(each.name),
            )
            for each in SIGNAL_TABLE
        ]

    @api.get("/api/history")
    async def get_history(
        feed: Feed, signal: str, span_s: Annotated[float, Query(gt=0, le=_SPAN_MOST_S)] = 3600.0
    ) -> HistoryAnswer:
        """A signal over the last seconds; without a hold, before the end of the newest run."""
        if signal not in SIGNALS:
            raise HTTPException(HTTPStatus.NOT_FOUND, f"no signal {signal!r}")
        with _busy_as_503():
            series = await LONG_CHARTS.run(history, feed, feed.logs, signal, span_s)
        return HistoryAnswer(
            signal=signal,
            unit=COLUMNS[signal].unit,
            utc_s=series.utc_s.tolist(),
            low=_without_nan(series.low.tolist()),
            mean=_without_nan(series.mean.tolist()),
            high=_without_nan(series.high.tolist()),
        )

    @api.get("/api/events")
    async def list_events(feed: Feed) -> list[str]:
        """The last events as sentences, oldest first."""
        return list(feed.seen.events)

    @api.get("/api/runs")
    async def list_runs(feed: Feed) -> list[RunAnswer]:
        """The runs of the hold's folder, oldest first."""
        logs = feed.logs
        if logs is None or not logs.is_dir():
            return []
        with _busy_as_503():
            entries = await RUN_LISTS.run(catalogue.list_entries, logs)
        return [_describe_run(entry) for entry in entries]


def _add_configuration_routes(
    api: FastAPI, starter: HoldStarter, editor: ConfigurationEditor
) -> None:
    """Add the routes that list, read, check and save configurations."""

    @api.get("/api/configurations")
    async def list_configurations() -> list[ConfigurationAnswer]:
        """What a hold can be started with."""
        with _busy_as_503():
            found = await RUN_LISTS.run(starter.list_configurations)
        return [
            ConfigurationAnswer(name=each.name, has_devices=each.has_devices, problem=each.problem)
            for each in found
        ]

    @api.get("/api/configurations/{name}")
    async def read_configuration(name: str, user: User) -> ConfigurationTextAnswer:
        """A configuration as it is in its file."""
        _require_role(user, "tune", "reading a configuration")
        with _refused_as_409():
            found = await CONFIGURATIONS.run(editor.read, name)
        return ConfigurationTextAnswer(text=found.text, digest=found.digest)

    @api.post("/api/configurations/{name}/check")
    async def check_configuration(
        name: str, body: ConfigurationBody, user: User
    ) -> CheckedConfigurationAnswer:
        """Check a text that is to become this configuration."""
        _require_role(user, "tune", "checking a configuration")
        with _refused_as_409():
            checked = await CONFIGURATIONS.run(editor.check, name, body.text)
        return CheckedConfigurationAnswer(
            errors=list(checked.errors), warnings=list(checked.warnings)
        )

    @api.put("/api/configurations/{name}")
    async def save_configuration(
        name: str, body: ConfigurationBody, user: User
    ) -> ConfigurationTextAnswer:
        """Save a configuration that passes the check; 409 with the findings if it does not, or if
        it is no longer the text of `digest` (empty: a new one).
        """
        _require_role(user, "tune", "saving a configuration")
        with _refused_as_409():
            saved = await CONFIGURATIONS.run(editor.save, name, body.text, body.digest, user.name)
        return ConfigurationTextAnswer(text=saved.text, digest=saved.digest)


def _add_start_routes(api: FastAPI, starter: HoldStarter) -> None:
    """Add the routes that start and restart holds."""

    @api.post("/api/start", status_code=HTTPStatus.ACCEPTED)
    async def start_hold(body: StartBody, user: User) -> CommandAnswer:
        """Start a hold; follow `/api/state` to see what becomes of it."""
        _require_role(user, "operate", "start")
        options = StartOptions(body.standby, body.clear_faults)
        try:
            starter.start_hold(body.configuration, user.name, options)
        except errors.InputError as error:
            raise HTTPException(HTTPStatus.CONFLICT, "; ".join(error.lines)) from None
        return CommandAnswer(done=True, text=f"start of {body.configuration}: begun")

    @api.post("/api/restart", status_code=HTTPStatus.ACCEPTED)
    async def restart_hold(body: RestartBody, user: User, feed: Feed) -> CommandAnswer:
        """Stop the hold and start the next with a configuration; 409 if this is refused, and
        nothing is stopped. Follow `/api/state` and `/api/start` to see what becomes of it.
        """
        _require_role(user, "operate", "restart")
        stop = {
            "do": "stop",
            "why": f"{user.via}: {user.name} restarts with {body.configuration}",
            "on_behalf": on_behalf(user, user.via),
        }
        with _refused_as_409():
            await begin_restart(feed, starter, body.configuration, user.name, stop)
        return CommandAnswer(done=True, text=f"restart with {body.configuration}: begun")

    @api.get("/api/start")
    async def get_start_failure() -> CommandAnswer:
        """Why the last start or restart failed; `done` if it did not."""
        failure = starter.failure
        return CommandAnswer(done=not failure, text=failure)


def _add_command_routes(api: FastAPI) -> None:
    """Add the routes that send commands to a hold."""

    @api.post("/api/commands")
    async def send_command(
        body: CommandBody, user: User, feed: Feed, response: Response
    ) -> CommandAnswer:
        """Send a command to the hold; 409 if it refuses."""
        if body.do in _SOCKET_ONLY:
            raise HTTPException(HTTPStatus.UNPROCESSABLE_ENTITY, f"{body.do}: not by HTTP")
        request = body.model_dump(exclude_defaults=True)
        return await _send(feed, user, request, pool_of_command(body.do), response)

    @api.post("/api/safety/{command}")
    async def send_safety_command(
        command: Literal["stop", "vent", "lower", "latch"],
        user: User,
        feed: Feed,
        response: Response,
        body: Annotated[SafetyBody | None, Body()] = None,
    ) -> CommandAnswer:
        """Stop, vent, lower or lock (`latch`) the hold, on threads that serve nothing else; takes
        command from the session that has it.
        """
        request = (body or SafetyBody()).model_dump(exclude_defaults=True)
        request |= {"do": command, "take_over": True}
        return await _send(feed, user, request, SAFETY_COMMANDS, response)


def _add_streams(api: FastAPI, feeds: Mapping[str, HoldFeed]) -> None:
    """Add what other programs follow: the stream of states and events, and the metrics."""
    streams: set[object] = set()

    @api.get("/api/stream", response_class=StreamingResponse)
    async def stream(feed: Feed, hold: HoldName = "") -> StreamingResponse:
        """Server-sent events: `state` (as `/api/state`) when it changes, `event` for each event."""
        if len(streams) >= _STREAMS_MOST:
            raise HTTPException(HTTPStatus.SERVICE_UNAVAILABLE, "too many streams")
        place = object()
        streams.add(place)

        async def follow() -> AsyncIterator[str]:
            try:
                async for message in _follow(hold, feed):
                    yield message
            finally:
                streams.discard(place)

        headers = {"cache-control": "no-store", "x-accel-buffering": "no"}
        return StreamingResponse(follow(), media_type="text/event-stream", headers=headers)

    @api.get("/metrics", response_class=Response)
    async def metrics() -> Response:
        """All holds for Prometheus."""
        seen = {name: feed.seen for name, feed in feeds.items()}
        return Response(render_metrics(seen), media_type=METRICS_TYPE)


def describe_state(hold: str, seen: HoldSeen) -> StateAnswer:
    """Return what is known of a hold.

    Parameters
    ----------
    hold : str
        Its name on the page; empty if the service follows one hold only.
    seen : HoldSeen
        What its feed has kept. Of a silent hold the old status is left out: it may be wrong by now.
    """
    silent = seen.silent
    status = {} if silent else seen.status
    row = status.get("row") or {}
    return StateAnswer(
        hold=hold,
        run=seen.name,
        state=seen.state_name,
        in_contact=not silent,
        reason=silent or str(status.get("why") or "as it should be"),
        alarms=alarm_lines(status),
        locks=lock_lines(status),
        error_um=row.get("error_um"),
        status=status,
        ended=_describe_end(seen.ended) if silent and seen.ended is not None else None,
    )


def _describe_end(ended: EndedRun) -> RunEndAnswer:
    """How a run ended, as the interface for programs states it; NaN is null."""
    read_back = None
    if ended.read_utc is not None:
        read_back = Reading(
            pump_fraction=_finite(ended.pump_fraction),
            vent_fraction=_finite(ended.vent_fraction),
            time_utc=ended.read_utc.isoformat(timespec="seconds"),
        )
    return RunEndAnswer(
        run=ended.name,
        kind=ended.kind.name.lower(),
        ended_utc=ended.ended_utc.isoformat(timespec="seconds"),
        cause=ended.cause,
        remedy=ended.remedy,
        lines=list(ended.lines()),
        read_back=read_back,
    )


def _describe_run(entry: catalogue.RunEntry) -> RunAnswer:
    return RunAnswer(
        name=entry.name,
        started_utc=entry.started_utc.isoformat(timespec="seconds"),
        duration_s=_finite(entry.duration_s),
        std_um=_finite(entry.std_um),
        faults=entry.faults,
        exit=entry.exit,
        ended_in=entry.ended_in,
        has_report=(entry.folder / REPORT_NAME).exists(),
    )


async def _send(
    feed: HoldFeed, user: WebUser, request: dict[str, Any], pool: WorkPool, response: Response
) -> CommandAnswer:
    """Send a request to a hold for a user."""
    do = request["do"]
    seen = feed.seen
    if seen.problem:
        response.status_code = HTTPStatus.SERVICE_UNAVAILABLE
        return CommandAnswer(done=False, text=f"{do}: not sent: {seen.problem}")
    for role in (user.role, seen.role):
        # the hold judges it, too
        if refusal := explain_missing_role(Peer(user.name, role), do):  # type: ignore[arg-type]
            raise HTTPException(HTTPStatus.FORBIDDEN, refusal)
    request.setdefault("why", f"{user.via}: {user.name}")
    expires_in_s = request.pop("expires_in_s", math.inf)
    limits = SendLimits(time.monotonic() + expires_in_s)
    viewer = request.pop("viewer", "")
    request["on_behalf"] = on_behalf(user, user.via)
    if viewer:
        request["on_behalf"]["viewer"] = viewer
    try:
        with _busy_as_503():
            answer = await pool.run(feed.ask_hold, request, limits)
    except errors.CommandError as error:
        response.status_code = HTTPStatus.SERVICE_UNAVAILABLE
        return CommandAnswer(done=False, text=f"{do}: {'; '.join(error.lines)}")
    outcome = Outcome.from_answer(do, answer)
    if not answer.get("ok"):
        response.status_code = HTTPStatus.CONFLICT
    return CommandAnswer(done=outcome.done, text=outcome.text, answer=answer)


async def _follow(hold: str, feed: HoldFeed) -> AsyncIterator[str]:
    """Yield what is new of a hold, until the client leaves."""
    # The feed replaces `seen` as a whole: what differs from the last look is new. A comment line
    # now and then keeps proxies from closing a silent stream
    shown: HoldSeen | None = None
    events = feed.seen.events
    silent_s = 0.0
    while True:
        seen = feed.seen
        parts = []
        if seen.events != events:
            new = find_new_lines(events, seen.events)
            parts += [_event_message("event", line) for line in new]
            events = seen.events
        if shown is None or seen.status is not shown.status or seen.problem != shown.problem:
            parts.append(_event_message("state", describe_state(hold, seen).model_dump()))
            shown = seen
        silent_s = 0.0 if parts else silent_s + _STREAM_S
        if silent_s >= _HEARTBEAT_S:
            parts.append(": nothing new\n\n")
            silent_s = 0.0
        for part in parts:
            yield part
        await asyncio.sleep(_STREAM_S)


def _event_message(kind: str, value: object) -> str:
    return f"event: {kind}\ndata: {json.dumps(value, allow_nan=False)}\n\n"


def _require_role(user: WebUser, needed: Role, what: str) -> None:
    if not role_includes(user.role, needed):
        raise HTTPException(
            HTTPStatus.FORBIDDEN, f"{what} needs the role {needed}; {user.name} has {user.role}"
        )


@contextmanager
def _refused_as_409() -> Iterator[None]:
    """Answer 409 with the reason for what is refused, 503 if too many tasks wait."""
    try:
        with _busy_as_503():
            yield
    except errors.CommandError as error:
        raise HTTPException(HTTPStatus.CONFLICT, "; ".join(error.lines)) from None


@contextmanager
def _busy_as_503() -> Iterator[None]:
    """Answer 503 if too many tasks wait."""
    try:
        yield
    except PoolFullError as error:
        raise HTTPException(HTTPStatus.SERVICE_UNAVAILABLE, str(error)) from None


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _without_nan(values: list[float]) -> list[float | None]:
    return [_finite(value) for value in values]
