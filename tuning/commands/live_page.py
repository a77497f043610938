"""The page that `tune run --page` serves beside a session."""

from membrane_ctrl.model.optional import require_installed
from membrane_ctrl.sessions.folder import SessionFolder
from tuning.options import TuneOptions


def serve_live_page(folder: SessionFolder, options: TuneOptions) -> str:
    """The address of the session's page, which lasts as long as this program."""
    require_installed("bokeh", "web", "`tune run --page`")
    from tuning.explore.page import serve_beside

    return serve_beside(folder, options.logs, options.author)
