"""The scenarios that come with the program: their files, names and titles."""

from difflib import get_close_matches
from pathlib import Path

from membrane_ctrl.config.toml_file import read_toml
from membrane_ctrl.model.errors import Exit, InputError

_FOLDER = Path(__file__).parent


def list_scenario_files() -> list[Path]:
    """Files of the scenarios; a name is the file's without its suffix."""
    return sorted(_FOLDER.glob("*.toml"))


def list_scenarios() -> int:
    """Print names and titles."""
    for path in list_scenario_files():
        print(f"{path.stem:18} {read_toml(path)['title']}")
    return Exit.DONE


def find_scenario(word: str) -> Path:
    """The file of a scenario, given its name or a path. Raises InputError."""
    files = {path.stem: path for path in list_scenario_files()}
    name = word.replace("-", "_")
    path = files.get(name) or Path(word)
    if path.is_file():
        return path
    near = [each for each in files if name and name in each] or get_close_matches(name, files)
    advice = f"did you mean {' or '.join(near)}? " if near else ""
    raise InputError(
        f"{word}: no such scenario; {advice}`membrane-ctrl twin play` lists them, or name a file"
    )
