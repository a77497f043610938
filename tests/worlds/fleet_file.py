"""The file of a fleet of holds, each with its folder."""

from pathlib import Path


def fleet_file(folder: Path, *names: str) -> Path:
    file = folder / "fleet.toml"
    file.write_text(
        "".join(f'[[holds]]\nname = "{name}"\nsocket = "{name}/control.sock"\n' for name in names)
    )
    for name in names:
        (folder / name).mkdir(exist_ok=True)
    return file
