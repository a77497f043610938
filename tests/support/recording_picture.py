"""A picture of a run's Rerun recording, as the viewer opens it."""

from __future__ import annotations

from pathlib import Path

from rerun.experimental import ViewerClient

from membrane_ctrl.review.viewer.screenshot import _at_rest, _start_headless_viewer


def screenshot(run_dir: Path, tab: str = "Overview") -> bytes:
    """PNG of all segments of the run at its end, with a tab of its layout."""
    with _start_headless_viewer() as viewer:
        viewer.open([str(path.resolve()) for path in sorted(run_dir.glob("*.rrd"))])
        _show_tab(viewer, tab)
        viewer.set_time("utc", play_state="following")
        return _at_rest(viewer)


def _show_tab(viewer: ViewerClient, name: str) -> None:
    blueprint = viewer.get_blueprint().blueprint
    containers = {
        path.removeprefix("/"): parts["ContainerBlueprint"]
        for path, parts in blueprint.items()
        if "ContainerBlueprint" in parts
    }
    wanted = next(
        (path for path, container in containers.items() if container.get("display_name") == name),
        None,
    )
    tabs = next(
        (container for container in containers.values() if wanted in container["contents"]), None
    )
    assert tabs is not None, f"no tab {name!r} in the recording"
    tabs["active_tab"] = wanted
    viewer.set_blueprint(blueprint, "recording")
