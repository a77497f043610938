"""Reports of runs and of commissioning sessions, as answers to a browser."""

from pathlib import Path

from fastapi.responses import HTMLResponse, Response

from membrane_ctrl.commissioning.guide import session_state
from membrane_ctrl.model import errors, files
from membrane_ctrl.service.ended_run import REPORT_NAME
from membrane_ctrl.service.guided_session import GuidedSession
from membrane_ctrl.web.runs_panel import run_folder

_REPORT_BYTES_MAX = 64_000_000


def report_page(logs: Path | None, name: str) -> HTMLResponse:
    """A run's report, in a sandbox: a run folder may come from anywhere.

    Parameters
    ----------
    logs : Path or None
        Folder of the runs of the hold; None for a hold on another machine.
    name : str
        Name of the run folder, from the address of the page: may be anything.

    Returns
    -------
    HTMLResponse
        404 with a sentence if there is no such run or no report yet.
    """
    folder = None if logs is None else run_folder(logs, name)
    if folder is None:
        return HTMLResponse("no such run", 404)
    try:
        text = files.read_bytes(folder / REPORT_NAME, _REPORT_BYTES_MAX).decode("utf-8", "replace")
    except (OSError, ValueError):  # ValueError: a name that no file can have
        return HTMLResponse("no report yet", 404)
    return _sandboxed_page(text)


def session_report(guided: GuidedSession, name: str, file: str) -> Response:
    """The report of a commissioning session, HTML or PDF.

    Parameters
    ----------
    guided : GuidedSession
        Knows the folder of the sessions.
    name, file : str
        Of the session's folder and of the file in it, from the address of the page: may be
        anything. Only the two files of a report are given out.

    Returns
    -------
    Response
        404 with a sentence if there is no such session, file or report.
    """
    try:
        folder = guided.find_folder(name)
        if file == session_state.PDF:
            pdf = files.read_bytes(folder / file, _REPORT_BYTES_MAX)
            return Response(pdf, media_type="application/pdf")
        if file == session_state.HTML:
            text = files.read_bytes(folder / file, _REPORT_BYTES_MAX).decode("utf-8", "replace")
            return _sandboxed_page(text)
    except (errors.InputError, OSError, ValueError):
        return HTMLResponse("no report yet", 404)
    return HTMLResponse("no such file", 404)


def _sandboxed_page(text: str) -> HTMLResponse:
    """A page of a folder that may come from anywhere."""
    sandbox = "sandbox allow-scripts; default-src 'unsafe-inline' data:"
    return HTMLResponse(text, headers={"content-security-policy": sandbox})
