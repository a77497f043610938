"""Saves the pictures of a report, embeds them, and decides which are older than what they show."""

from pathlib import Path

from matplotlib.figure import Figure

from membrane_ctrl.measure.result_files import write_picture
from membrane_ctrl.model.files import resolve_user_path
from membrane_ctrl.report_pages.blocks import PagePicture
from membrane_ctrl.sessions.folder import FILES, SessionFolder

SPECTRUM_SEGMENT_S = 40.0
_DPI = 100


def save_figure(path: Path, figure: Figure) -> None:
    """Write a picture to a file of the session.

    Parameters
    ----------
    path : Path
        A PNG file, replaced as a whole.
    figure : Figure
        Drawn; its size in inches counts 100 px each.
    """
    write_picture(resolve_user_path(path), figure, _DPI)


def embed_picture(folder: SessionFolder, name: str) -> list[PagePicture]:
    """Return a picture of the session for its report; empty if it is missing.

    Parameters
    ----------
    folder : SessionFolder
        The session.
    name : str
        File name within it, such as `fit.png`.
    """
    path = folder.file_path(name)
    if not path.exists():
        return []
    return [PagePicture(path.stem, folder.read_content(name))]


def is_outdated(folder: SessionFolder, picture: str, *steps: str) -> bool:
    """Whether a picture must be drawn (again): it is no file, or older than what it shows.

    Parameters
    ----------
    folder : SessionFolder
        The session.
    picture : str
        File name within it.
    *steps : str
        Finished steps whose files it shows; at least one.
    """
    path = folder.file_path(picture)
    if path.is_symlink() or not path.is_file():
        return True
    results = [folder.file_path(name) for step in steps for name in FILES[step]]
    newest_ns = max(each.stat().st_mtime_ns for each in results if each.exists())
    return newest_ns >= path.stat().st_mtime_ns
