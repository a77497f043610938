"""The scenarios that come with the program: their files, names and titles."""

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
    named = _FOLDER / f"{word.replace('-', '_')}.toml"
    path = named if named in list_scenario_files() else Path(word)
    if not path.is_file():
        raise InputError(
            f"{word}: no such scenario; `membrane-ctrl twin play` lists them, or name a file"
        )
    return path
