"""Pictures of a recording as the viewer opens it, without a screen.

Needs a Vulkan driver, for example Mesa's software one.
"""

import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rerun.experimental import ViewerClient

from membrane_ctrl.model import errors
from membrane_ctrl.review.viewer.viewer import (
    CursorTime,
    free_port,
    make_proxy_url,
    place_cursor,
    viewer_command,
    viewer_environment,
)

# The viewer is ready when two consecutive pictures are equal, about 7 s for a short run on two
# cores.
_WAIT_S = 60.0
_BETWEEN_S = 0.5
_TOO_SLOW = "the viewer did not answer in time"
_TRY_AGAIN = "try again when the machine is less busy"


def take_screenshot(source: Path | str, at: CursorTime | None = None) -> bytes:
    """Take a picture of the viewer.

    Parameters
    ----------
    source : Path or str
        A recording, or the URL of a server's page.
    at : CursorTime or None
        Where the time cursor of a recording is put; None: at its end. A server's page keeps the
        cursor of its own.

    Returns
    -------
    bytes
        PNG.

    Raises
    ------
    RuntimeError
        The viewer does not start (no Vulkan driver), does not answer in time, or its picture keeps
        changing.
    """
    with _start_headless_viewer() as viewer:
        try:
            viewer.open(source if isinstance(source, str) else str(source.resolve()))
            if isinstance(source, str):
                pass
            elif at is None:
                viewer.set_time(play_state="following")
            else:
                place_cursor(viewer, at)
            return _at_rest(viewer)
        except OSError as error:  # what a connection to the viewer raises, also at a deadline
            reason = errors.os_reason(error)
            raise RuntimeError(f"{_TOO_SLOW} ({reason}); {_TRY_AGAIN}") from error


def _at_rest(viewer: ViewerClient) -> bytes:
    until_s = time.monotonic() + _WAIT_S
    before = b""
    while time.monotonic() < until_s:
        picture = viewer.take_screenshot()
        if picture == before:
            return picture
        before = picture
        time.sleep(_BETWEEN_S)
    raise RuntimeError(f"the viewer's picture still changes after {_WAIT_S:.0f} s; {_TRY_AGAIN}")


@contextmanager
def _start_headless_viewer() -> Iterator[ViewerClient]:
    """A headless viewer reachable only from this machine; `ViewerClient.spawn` would listen on
    every interface.
    """
    port = free_port()
    command = viewer_command(
        "--headless", "--bind", "127.0.0.1", "--port", str(port), "--hide-welcome-screen"
    )
    with subprocess.Popen(
        command, env=viewer_environment(), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    ) as process:
        try:
            yield _connect_viewer(port, process)
        finally:
            process.terminate()


def _connect_viewer(port: int, process: subprocess.Popen[bytes]) -> ViewerClient:
    until_s = time.monotonic() + _WAIT_S
    while time.monotonic() < until_s and process.poll() is None:
        try:
            viewer = ViewerClient.connect(make_proxy_url("127.0.0.1", port))
            viewer.take_screenshot(max_size=16)
        except (RuntimeError, ConnectionError):
            time.sleep(_BETWEEN_S)
        else:
            return viewer
    process.terminate()
    reason = ""
    if process.stderr:
        reason = process.stderr.read().decode(errors="replace").strip()
    raise RuntimeError(
        f"the headless viewer did not start (Vulkan driver installed?): {reason[-300:]}"
    )
