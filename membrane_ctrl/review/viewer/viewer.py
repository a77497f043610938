"""Starts the viewer on a review: on this screen, for a browser, to a picture, or following a run in
progress.
"""

import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias
from urllib.parse import quote, urlsplit

import numpy as np
import rerun_cli  # type: ignore[import-untyped]
from rerun.experimental import ViewerClient

from membrane_ctrl.model import errors
from membrane_ctrl.review.viewer.live_view import LiveRecording, LiveView, follow_run
from membrane_ctrl.run_files.run import Run

# Work to do while a viewer is open, until the question whether it is still open is answered with
# no.
Meanwhile: TypeAlias = Callable[[Callable[[], bool]], None]

# A window opens in a few seconds, with a software driver in ten.
_CURSOR_S = 30.0
_CURSOR_AGAIN_S = 0.2
# The server starts in a second.
_SERVER_S = 30.0
_SERVER_AGAIN_S = 0.05


@dataclass(frozen=True, slots=True)
class CursorTime:
    """A time on a timeline: nanoseconds since 1970 on `utc`, else since its 0."""

    timeline: str
    nanos: int


def place_cursor(client: ViewerClient, at: CursorTime) -> None:
    """Stop a viewer's time cursor at a time.

    Parameters
    ----------
    client : ViewerClient
        Connection to a viewer that has opened its recordings.
    at : CursorTime
        Timeline and time.
    """
    if at.timeline == "utc":
        client.set_time(at.timeline, timestamp=np.datetime64(at.nanos, "ns"), play_state="paused")
    else:
        client.set_time(at.timeline, duration=np.timedelta64(at.nanos, "ns"), play_state="paused")


def viewer_command(*arguments: str) -> list[str]:
    """The viewer's binary: the `rerun` command is a Python shim, and ending that would leave the
    viewer running.

    Raises InputError in an installation without the viewer.
    """
    program = Path(rerun_cli.__file__).parent / "rerun"
    if not program.exists():
        raise errors.InputError(
            "this installation has no viewer: copy the run to a machine that has one, or `pip "
            "install --force-reinstall rerun-sdk`"
        )
    return [str(program), *arguments]


def show_source(
    source: Path | str, at: CursorTime | None = None, meanwhile: Meanwhile = lambda _: None
) -> int:
    """Open a file or a server's page on this machine's screen; return when the window is closed.

    The cursor is put at a moment; `meanwhile` runs while the window is open and ends with it.

    Parameters
    ----------
    source : Path or str
        File, or the page's URL.
    at : CursorTime or None
        Where the cursor is put.
    meanwhile : Meanwhile
        Runs while the window is open, and ends with it.

    Returns
    -------
    int
        The exit code.
    """
    _require_screen()
    port = free_port()

    def started(process: subprocess.Popen[bytes]) -> None:
        if at is not None:
            put_cursor(process, port, at)
        meanwhile(lambda: process.poll() is None)

    return _run_viewer(
        viewer_command("--bind", "127.0.0.1", "--port", str(port), str(source)), started
    )


def put_cursor(
    process: subprocess.Popen[bytes], port: int, at: CursorTime, most_s: float = _CURSOR_S
) -> None:
    """Set a viewer's time cursor once its files are open, which a blueprint cannot do.

    A viewer that does not answer in time is left unchanged: its plots show the requested part
    anyway.

    Parameters
    ----------
    process : Popen
        The viewer; if it ends, the attempt ends.
    port : int
        On which it listens at 127.0.0.1.
    at : CursorTime
        Timeline and time.
    most_s : float
        How long to try, s.
    """
    until_s = time.monotonic() + most_s
    while time.monotonic() < until_s and process.poll() is None:
        try:
            client = ViewerClient.connect(make_proxy_url("127.0.0.1", port))
            place_cursor(client, at)
            if any(opened.current_time == at.nanos for opened in client.get_state().recordings):
                return
        except (RuntimeError, ConnectionError):
            pass
        time.sleep(_CURSOR_AGAIN_S)


def serve_source(
    source: Path | str, bind: str, port: int, meanwhile: Meanwhile = lambda _: None
) -> int:
    """Serve a file, or a page for a server's data, to browsers until interrupted.

    Parameters
    ----------
    source : Path or str
        File, or URL of the data.
    bind : str
        127.0.0.1, or an address of this machine for remote viewers.
    port : int
        Of the page; 0 for a free one.
    meanwhile : Meanwhile
        As for `show_source`.

    Returns
    -------
    int
        The exit code.

    Raises
    ------
    DeviceError
        It cannot listen there, or the viewer does not start.
    """
    port = port or free_port()
    _require_listening(bind, port)
    data_port = free_port()
    if isinstance(source, str):
        url = source
    else:
        url = make_proxy_url(_find_host(bind), data_port)
    _print_address(bind, port, url)
    options = [
        "--serve-web",
        "--bind",
        bind,
        "--port",
        str(data_port),
        "--web-viewer-port",
        str(port),
    ]
    return _run_viewer(
        viewer_command(*options, str(source)),
        lambda process: meanwhile(lambda: process.poll() is None),
    )


def show_live_run(run: Run, web: bool, port: int = 0) -> int:
    """Show a run in progress, made from its tables, without affecting the run.

    The view is sent to a separate server, to which the viewer connects.

    Parameters
    ----------
    run : Run
        The run; its tables are read again as they grow.
    web : bool
        Serve a page for a browser on this machine instead of opening a viewer.
    port : int
        Of that page; 0 for a free one.

    Returns
    -------
    int
        0, the exit code, after the viewer was closed or Ctrl-C.

    Raises
    ------
    DeviceError
        There is no screen, or the viewer or its server does not start.
    """
    data_port = free_port()
    port = port or free_port()
    if web:
        kind = ["--serve-web", "--web-viewer-port", str(port)]
    else:
        kind = ["--serve-grpc"]
    server = viewer_command(*kind, "--bind", "127.0.0.1", "--port", str(data_port))
    proxy = make_proxy_url("127.0.0.1", data_port)
    if web:
        _require_listening("127.0.0.1", port)
        _print_address("127.0.0.1", port, proxy)
    else:
        _require_screen()
    try:
        with subprocess.Popen(server, env=viewer_environment()) as served:
            _wait_for_server(served, data_port)
            viewer = viewer_command(
                "--bind", "127.0.0.1", "--port", str(free_port()), "--connect", proxy
            )
            if web:
                watched = served
            else:
                watched = subprocess.Popen(viewer, env=viewer_environment())
            try:
                view = LiveView(run, LiveRecording(run, proxy))
                follow_run(view, run.folder, lambda: watched.poll() is None)
                watched.wait()
            except KeyboardInterrupt:
                pass
            finally:
                watched.terminate()
                served.terminate()
    except OSError as error:
        raise errors.DeviceError(f"the viewer did not start: {error}") from None
    return 0


def _wait_for_server(served: subprocess.Popen[bytes], port: int) -> None:
    """Wait until the server listens. Raises OSError if it has ended or takes too long."""
    until_s = time.monotonic() + _SERVER_S
    while served.poll() is None and time.monotonic() < until_s:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(_SERVER_AGAIN_S)
    served.terminate()
    raise OSError("its server does not listen")


def _require_screen() -> None:
    if sys.platform.startswith("linux") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        raise errors.DeviceError(
            "no screen: use --web and open the address in a browser, or --screenshot FILE"
        )


def _find_host(bind: str) -> str:
    if bind == "127.0.0.1":
        return "127.0.0.1"
    return socket.gethostname()


def make_proxy_url(host: str, port: int) -> str:
    """Return the address at which a viewer's server offers its recordings.

    Parameters
    ----------
    host : str
        Name or address of the server's machine.
    port : int
        Its data port (gRPC).
    """
    return f"rerun+http://{host}:{port}/proxy"


def _print_address(bind: str, port: int, url: str) -> None:
    """Print the address of the page that shows a server's data, and how to reach it from another
    machine.
    """
    print(f"open http://{_find_host(bind)}:{port}/?url={quote(url, safe='')}", file=sys.stderr)
    if bind == "127.0.0.1":
        data_port = urlsplit(url).port
        tunnel = (
            f"ssh -L {port}:127.0.0.1:{port} -L {data_port}:127.0.0.1:{data_port} "
            f"{socket.gethostname()}"
        )
        print(f"from another machine first: {tunnel}", file=sys.stderr)


def _require_listening(bind: str, port: int) -> None:
    """Check the port, as the viewer does not report a busy one."""
    try:
        with socket.socket(socket.AF_INET6 if ":" in bind else socket.AF_INET) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((bind, port))
    except OSError as error:
        where = f"{bind}, port {port} ({errors.os_reason(error)})"
        raise errors.DeviceError(
            f"cannot listen on {where}: choose another --port or --bind"
        ) from None


def free_port() -> int:
    """A currently free TCP port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _run_viewer(
    command: list[str], started: Callable[[subprocess.Popen[bytes]], None] = lambda _: None
) -> int:
    try:
        with subprocess.Popen(command, env=viewer_environment()) as viewer:
            try:
                started(viewer)
                return 0 if viewer.wait() == 0 else 4
            except KeyboardInterrupt:
                viewer.terminate()
                return 0
    except OSError as error:
        raise errors.DeviceError(f"the viewer did not start: {error}") from None


def viewer_environment() -> dict[str, str]:
    """The environment of the viewer's process: only errors are logged, unless RUST_LOG
    states more.
    """
    return {**os.environ, "RUST_LOG": os.environ.get("RUST_LOG", "error")}
