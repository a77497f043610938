"""What several commands share: options, and the configuration that they name."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from membrane_ctrl.config import Config
from membrane_ctrl.config_file import load

ConfigArgument = Annotated[Path, typer.Argument(help="Configuration, one TOML file.", metavar="CONFIG")]
ConfigOption = Annotated[Path | None, typer.Option("--config", help="Configuration, one TOML file.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
PriorOption = Annotated[
    list[Path] | None,
    typer.Option(metavar="FILE", help="Of calibrate-camera or calibrate-pose; repeatable, the last one counts."),
]
RunArgument = Annotated[Path, typer.Argument(metavar="RUN", help="Run folder.")]
SetArgument = Annotated[Path, typer.Argument(metavar="SET", help="Folder with capture.toml and its images.")]
SeedOption = Annotated[int, typer.Option(min=0, help="Of all that is random.")]
TrialsOption = Annotated[int, typer.Option(min=2, help="Monte Carlo trials.")]


def configured(path: Path | None) -> Config:
    """Return the configuration of a file, or the defaults without one; raises `InputError`.

    Its geometry file is looked for beside it, wherever the command is called.
    """
    if path is None:
        return Config()
    config = load(path, Config)
    if config.optics.geometry_file is None:
        return config
    beside = path.resolve().parent / config.optics.geometry_file.expanduser()
    return config.model_copy(update={"optics": config.optics.model_copy(update={"geometry_file": beside})})
