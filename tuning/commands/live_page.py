"""The page that `tune run --page` serves beside a session."""

from membrane_ctrl.model.errors import InputError
from membrane_ctrl.sessions.folder import SessionFolder
from tuning.options import TuneOptions

NEEDS_BOKEH = "{} needs Bokeh: pip install 'membrane-ctrl[web]'"


def serve_live_page(folder: SessionFolder, options: TuneOptions) -> str:
    """The address of the session's page, which lasts as long as this program."""
    try:
        from tuning.explore.page import serve_beside
    except ModuleNotFoundError:
        raise InputError(NEEDS_BOKEH.format("tune run --page")) from None
    return serve_beside(folder, options.logs, options.author)
