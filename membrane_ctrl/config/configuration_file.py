"""The configuration of a bench from its file, with the names of other files resolved."""

from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel

from membrane_ctrl.config import schema, toml_file

S = TypeVar("S", bound=BaseModel)


def load_configuration(path: Path | None) -> schema.Config:
    """Return the configuration of a file, or the defaults without one; raises `InputError`.

    The file names in it are relative to its own folder, not to the current one. What the file does
    not state, a hold finds at its start (`schema.leave_to_start`).
    """
    if path is None:
        config = schema.leave_to_start(schema.Config())
        shape = config.shape.model_copy(update={"mode": "auto"})
        return config.model_copy(update={"shape": shape})
    return _resolve_files(toml_file.load_toml(path, schema.Config), path)


def parse_configuration(text: str, path: Path) -> schema.Config:
    """As `load_configuration`, of a text that is not in its file yet: an editor checks it before.

    Parameters
    ----------
    text : str
        TOML.
    path : Path
        The file that it is to become: file names in the text are relative to its folder.

    Raises
    ------
    InputError
        With one line that names the file, the field and a valid value.
    """
    return _resolve_files(toml_file.load_toml_text(text, path, schema.Config), path)


def _resolve_files(config: schema.Config, path: Path) -> schema.Config:
    """Resolve the file names of a configuration, and leave to the start what it does not state."""
    # Every key that names a file of the user's; the folder of the runs is relative to where the
    # hold is started
    config = schema.leave_to_start(config)
    optics, port, alarms = config.optics, config.port, config.alarms
    folder = path.resolve().parent
    if optics.geometry_file is not None:
        optics = _resolve_beside(optics, folder, "geometry_file")
    alarms = _resolve_beside(alarms, folder, "urls_file", "escalation_urls_file")
    bridges = config.bridges
    if bridges.mqtt is not None:
        bridges = bridges.model_copy(
            update={"mqtt": _resolve_beside(bridges.mqtt, folder, "password_file", "ca_file")}
        )
    if bridges.opcua is not None:
        opcua = _resolve_beside(bridges.opcua, folder, "users_file", "certificate_file", "key_file")
        bridges = bridges.model_copy(update={"opcua": opcua})
    update = {"optics": optics, "port": port, "alarms": alarms, "bridges": bridges}
    return config.model_copy(update=update)


def _resolve_beside(section: S, folder: Path, *names: str) -> S:
    """Return the section with its file names relative to a folder; unset ones stay unset."""
    given = {name: getattr(section, name) for name in names}
    made = {
        name: type(file)(folder / Path(file).expanduser())
        for name, file in given.items()
        if file is not None
    }
    return section.model_copy(update=made)
