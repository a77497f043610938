"""The page of the service on a session or run: `tune explore` and `tune run --page`."""

from __future__ import annotations

import os
import sys
import webbrowser
from pathlib import Path
from urllib.parse import urlencode

from membrane_ctrl.hold.page_service import PageService, start_page_service
from membrane_ctrl.model import errors, terminal
from membrane_ctrl.sessions.folder import open_session
from tuning.explore.workpiece import load_workpiece

_SESSIONS = "tuning"  # folder of the sessions in that of the runs
_STARTS_S = 60.0


def explore(path: Path) -> int:
    """Open the page on the gains of a session or run; print its link.

    A session that has not observed its weather yet is shown as it proceeds.

    Raises
    ------
    InputError
        The folder is neither, or cannot be explored.
    DeviceError
        There is no service, and none could be started.
    """
    # The page finds a session by `tuning/NAME` and a run by `NAME`, below the folder of the runs
    # that its service follows.
    folder = path.resolve()
    is_session = (folder / "session.json").exists()
    logs = folder.parent.parent if is_session else folder.parent
    name = f"{_SESSIONS}/{folder.name}" if is_session else folder.name
    if is_session and folder.parent.name != _SESSIONS:
        raise errors.InputError(f"{path}: a session is in a folder {_SESSIONS}/ beside its runs")
    # Read it here once, so that data that cannot be explored are reported on the terminal, and not
    # on a page that a browser has already opened.
    can_be_explored = not is_session or open_session(folder).is_done("observe")
    if can_be_explored:
        terminal.print_progress(f"reading {path}")
        load_workpiece(folder, logs)
    page = find_page(logs)
    if problem := page.wait_until_it_serves(_STARTS_S):
        raise errors.DeviceError(f"no page: {problem}")
    page.forget()
    link = link_to_tab(page.link, name if can_be_explored else "")
    print(link, flush=True)
    if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY") or sys.platform == "darwin":
        webbrowser.open(link)
    return 0


def find_page(logs: Path) -> PageService:
    """Return the service of a folder of runs; start one if there is none. Raises DeviceError."""
    problems: list[str] = []
    page = start_page_service(logs, None, problems.append, ends_with_us=False)
    if page is None:
        raise errors.DeviceError("; ".join(problems))
    return page


def link_to_tab(link: str, gains: str = "") -> str:
    """Return the link to the tab *Tune*.

    Parameters
    ----------
    link : str
        To the page, perhaps with a query.
    gains : str
        The session or run to explore, relative to the folder of runs; empty for none.
    """
    query = {"tab": "tune"}
    if gains:
        query["gains"] = gains
    separator = "?"
    if "?" in link:
        separator = "&"
    return f"{link}{separator}{urlencode(query)}"
