"""A picture of a recorded run as the viewer opens it, on a machine without a screen.

`python -m membrane_ctrl.review.viewer.screenshot RUN out.png [--tab Shape]`

Needs a Vulkan driver; Mesa's software one will do (`apt-get install mesa-vulkan-drivers libvulkan1`).
"""

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rerun.experimental import ViewerClient

from membrane_ctrl.review.viewer.viewer import free_port, viewer_command

# The viewer is ready when two pictures in a row are the same, which on two cores takes about 7 s for a short run.
_WAIT_S = 60.0
_BETWEEN_S = 0.5


def screenshot(run_dir: Path, tab: str = "Overview") -> bytes:
    """PNG of the whole run, at its end.

    Raises FileNotFoundError if there is no recording in the folder; ValueError if the recording has no such tab;
    RuntimeError if the viewer does not start (no Vulkan driver) or does not come to rest. All segments
    of the run are opened; `tab` is the name of a tab of the blueprint.
    """
    segments = sorted(str(path.resolve()) for path in run_dir.glob("*.rrd"))
    if not segments:
        raise FileNotFoundError(f"{run_dir}: no .rrd file in it")
    with _viewer() as viewer:
        viewer.open(segments)
        _show_tab(viewer, tab)
        viewer.set_time("run_time", play_state="following")
        return _at_rest(viewer)


def screenshot_of(files: Sequence[Path], at_s: float | None = None) -> bytes:
    """PNG of recordings as they open, at a second of `run_time` or their end. Raises RuntimeError as `screenshot`."""
    with _viewer() as viewer:
        viewer.open([str(path.resolve()) for path in files])
        if at_s is None:
            viewer.set_time("run_time", play_state="following")
        else:
            viewer.set_time("run_time", duration=at_s, play_state="paused")
        return _at_rest(viewer)


def _show_tab(viewer: ViewerClient, name: str) -> None:
    blueprint = viewer.get_blueprint().blueprint
    containers = {
        path.removeprefix("/"): parts["ContainerBlueprint"]
        for path, parts in blueprint.items()
        if "ContainerBlueprint" in parts
    }
    wanted = next((path for path, container in containers.items() if container.get("display_name") == name), None)
    tabs = next((container for container in containers.values() if wanted in container["contents"]), None)
    if tabs is None:
        raise ValueError(f"no tab {name!r} in the recording")
    tabs["active_tab"] = wanted
    viewer.set_blueprint(blueprint, "recording")


def _at_rest(viewer: ViewerClient) -> bytes:
    until_s = time.monotonic() + _WAIT_S
    before = b""
    while time.monotonic() < until_s:
        picture = viewer.take_screenshot()
        if picture == before:
            return picture
        before = picture
        time.sleep(_BETWEEN_S)
    raise RuntimeError(f"the viewer's picture still changed after {_WAIT_S:.0f} s")


@contextmanager
def _viewer() -> Iterator[ViewerClient]:
    """A headless viewer that only this machine can reach; `ViewerClient.spawn` would listen on every interface."""
    port = free_port()
    command = viewer_command("--headless", "--bind", "127.0.0.1", "--port", str(port), "--hide-welcome-screen")
    environment = {**os.environ, "RUST_LOG": "error"}
    with subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process:
        try:
            yield _connect(port, process)
        finally:
            process.terminate()


def _connect(port: int, process: subprocess.Popen[bytes]) -> ViewerClient:
    until_s = time.monotonic() + _WAIT_S
    while time.monotonic() < until_s and process.poll() is None:
        try:
            viewer = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            viewer.take_screenshot(max_size=16)
        except (RuntimeError, ConnectionError):
            time.sleep(_BETWEEN_S)
        else:
            return viewer
    process.terminate()
    reason = process.stderr.read().decode(errors="replace").strip() if process.stderr else ""
    raise RuntimeError(f"the headless viewer did not start (Vulkan driver installed?): {reason[-300:]}")


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description="Picture of a recorded run as the viewer opens it.")
    parser.add_argument("run", type=Path, help="folder of the run")
    parser.add_argument("out", type=Path, help="PNG file to write")
    parser.add_argument("--tab", default="Overview", help="name of a tab")
    arguments = parser.parse_args()
    try:
        arguments.out.write_bytes(screenshot(arguments.run, arguments.tab))
    except (OSError, ValueError, RuntimeError) as error:
        sys.exit(f"{error}")


if __name__ == "__main__":
    main()
