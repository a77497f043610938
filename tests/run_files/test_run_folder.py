"""The run's folder: its name, its configuration, and the errors when it cannot be made."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from membrane_ctrl.config import toml_file as config_file
from membrane_ctrl.config.schema import Config, RecordingConfig
from membrane_ctrl.model.errors import DeviceError, InputError
from membrane_ctrl.model.files import write_text_atomic
from membrane_ctrl.run_files import run_folder
from tests.worlds.synthetic_run import STARTED_UTC


def test_folder_is_named_by_utc_and_name(tmp_path: Path) -> None:
    run_dir = run_folder.create_run_folder(
        tmp_path / "deep" / "logs", "demo", STARTED_UTC, Config()
    )
    assert run_dir == tmp_path / "deep" / "logs" / "20261121T012345Z-demo"
    assert run_dir.is_dir()


def test_second_run_of_a_second_gets_its_own_folder(tmp_path: Path) -> None:
    first, second = (
        run_folder.create_run_folder(tmp_path, "demo", STARTED_UTC, Config()) for _ in range(2)
    )
    assert second.name == f"{first.name}-2"


def test_configuration_is_written_whole_and_reads_back(tmp_path: Path) -> None:
    config = Config.model_validate({"loop": {"setpoint_um": 12.5}})
    run_dir = run_folder.create_run_folder(tmp_path, "demo", STARTED_UTC, config)
    text = (run_dir / "config.toml").read_text()
    assert config_file.load_toml(run_dir / "config.toml", Config) == config
    assert "barometer_gain_um_per_pa" in text  # a default nobody asked for
    assert "None" not in text
    assert {path.name for path in run_dir.iterdir()} == {"config.toml", "run.json"}


@pytest.mark.parametrize("name", ["", "../up", "a b", ".hidden", "x" * 65, "a/b"])
def test_odd_names_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="run name"):
        run_folder.create_run_folder(tmp_path, name, STARTED_UTC, Config())
    assert not list(tmp_path.iterdir())


def test_logs_that_is_a_file_is_named_with_a_remedy(tmp_path: Path) -> None:
    (tmp_path / "logs").write_text("a file")
    with pytest.raises(DeviceError, match=r"logs: cannot be written .*--logs") as caught:
        run_folder.create_run_folder(tmp_path / "logs", "demo", STARTED_UTC, Config())
    assert "\n" not in str(caught.value)


def test_too_little_space_is_named_with_a_remedy(tmp_path: Path) -> None:
    config = Config(recording=RecordingConfig(min_free_mb=1e9))
    with pytest.raises(
        DeviceError, match=r"MB free, recording.min_free_mb requires 1000000000; delete"
    ):
        run_folder.create_run_folder(tmp_path, "demo", STARTED_UTC, config)
    assert not list(tmp_path.iterdir())


def test_nothing_is_left_when_the_configuration_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, text: str) -> None:
        path.write_text(text[:10])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(run_folder.files, "write_text_atomic", full)
    with pytest.raises(DeviceError, match="no space left on device"):
        run_folder.create_run_folder(tmp_path, "demo", STARTED_UTC, Config())
    assert not list(tmp_path.iterdir())


def test_failed_atomic_write_keeps_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "summary.json"
    path.mkdir()  # a folder cannot be replaced by a file
    with pytest.raises(OSError):
        write_text_atomic(path, "new")
    assert [found.name for found in tmp_path.iterdir()] == ["summary.json"]
