"""Files in folders of strangers: no link is followed, no pipe waited for, nothing large read,
written or changed.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from membrane_ctrl.model import files as atomic
from membrane_ctrl.model.files import (
    append_text,
    fresh_file,
    make_folder,
    move_file,
    open_plain,
    read_bytes,
    read_text,
    remove_file,
    resolve_user_path,
    scratch_folder,
    write_text_atomic,
)

ROOT = Path(__file__).parents[2]


@pytest.fixture
def secret(tmp_path: Path) -> Path:
    path = tmp_path / "secret.txt"
    path.write_text("secret")
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "run"
    path.mkdir()
    return path


def test_what_is_written_is_read(folder: Path) -> None:
    write_text_atomic(folder / "a", "über")
    assert read_text(folder / "a") == "über"
    write_text_atomic(folder / "a", "half a pair: \ud800")  # JSON may hold one
    assert read_text(folder / "a") == "half a pair: \\ud800"
    assert [path.name for path in folder.iterdir()] == ["a"]


def test_a_link_is_not_read_but_where_the_user_named_it(folder: Path, secret: Path) -> None:
    (folder / "a").symlink_to(secret)
    with pytest.raises(OSError, match="is a link, and links are not followed here"):
        read_bytes(folder / "a", 100)
    assert read_text(folder / "a", follow=True) == "secret"


def test_nor_is_a_file_in_a_linked_folder(folder: Path, secret: Path) -> None:
    (folder / "columns").symlink_to(secret.parent)
    for act in (
        lambda path: read_bytes(path, 100),
        lambda path: write_text_atomic(path, "x"),
        lambda path: append_text(path, "x"),
        fresh_file,
        remove_file,
    ):
        with pytest.raises(OSError, match="is a link, and links are not followed here"):
            act(folder / "columns" / secret.name)
    with pytest.raises(OSError, match="a link"):
        make_folder(folder / "columns")
    with pytest.raises(OSError, match="a link"), scratch_folder(folder / "columns", ".x-"):
        raise AssertionError
    assert secret.read_text() == "secret"


@pytest.mark.parametrize("name", ["a", ".a.part"])
def test_a_planted_link_is_replaced_and_what_it_leads_to_stays(
    folder: Path, secret: Path, name: str
) -> None:
    (folder / name).symlink_to(secret)
    write_text_atomic(folder / "a", "mine")
    assert (folder / "a").read_text() == "mine"
    assert not (folder / "a").is_symlink()
    assert secret.read_text() == "secret"


def test_a_link_that_comes_back_is_refused(
    folder: Path, secret: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between taking it away and making the file somebody may be quick."""
    (folder / ".a.part").symlink_to(secret)
    monkeypatch.setattr(os, "unlink", lambda *_, **__: None)
    with pytest.raises(OSError, match="a link"):
        write_text_atomic(folder / "a", "mine")
    assert secret.read_text() == "secret"


def test_a_fresh_file_and_a_moved_one_take_a_links_place(folder: Path, secret: Path) -> None:
    (folder / "a").symlink_to(secret)
    with fresh_file(folder / "a") as file:
        file.write(b"mine")
    (folder / "b").symlink_to(secret)
    move_file(folder / "a", folder / "b")
    assert [(path.name, path.read_text()) for path in folder.iterdir()] == [("b", "mine")]
    remove_file(folder / "b")
    remove_file(folder / "b")  # not there: nothing to do
    assert secret.read_text() == "secret"


def test_nothing_is_appended_through_a_link_of_either_kind(folder: Path, secret: Path) -> None:
    (folder / "soft").symlink_to(secret)
    (folder / "hard").hardlink_to(secret)
    for name, why in (("soft", "a link"), ("hard", "a hard link elsewhere")):
        with pytest.raises(OSError, match=why):
            append_text(folder / name, "more")
    assert secret.read_text() == "secret"
    append_text(folder / "a", "one ")
    append_text(folder / "a", "two")
    assert (folder / "a").read_text() == "one two"


def test_a_pipe_a_folder_and_a_device_are_no_files(folder: Path) -> None:
    os.mkfifo(folder / "pipe")
    (folder / "sub").mkdir()
    for name, why in (("pipe", "a pipe or a device"), ("sub", "is a folder, not a file")):
        with pytest.raises(OSError, match=why):
            open_plain(folder / name)  # an ordinary open would wait for ever
        with pytest.raises(OSError, match=r"a pipe|directory|a folder"):
            append_text(folder / name, "x")
    with pytest.raises(OSError, match="a pipe or a device"):
        open_plain(Path("/dev/zero"), follow=True)


def test_too_large_a_file_is_refused_before_it_is_read(folder: Path) -> None:
    path = folder / "a"
    with path.open("wb") as file:
        file.truncate(2**40)
    with pytest.raises(OSError, match=r"1099512 MB, above the limit of 0 MB"):
        read_bytes(path, 100)
    path.write_bytes(bytes(100))
    assert len(read_bytes(path, 100)) == 100


def test_an_error_names_the_file(folder: Path) -> None:
    (folder / "a").mkdir()
    for act in (lambda: write_text_atomic(folder / "a", ""), lambda: open_plain(folder / "b")):
        with pytest.raises(OSError, match=str(folder)):
            act()
    assert [path.name for path in folder.iterdir()] == ["a"]


def test_a_path_that_the_user_named_may_lead_through_links(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "short").symlink_to(folder)
    write_text_atomic(resolve_user_path(tmp_path / "short" / "a"), "mine")
    assert (folder / "a").read_text() == "mine"


# Who else writes, and why it is no stranger's folder.
_OWN = {
    # the recorder, and the log of a program beside a hold, in the folder that the run has just made
    "processes/command_process.py",
    "recorder/handover.py",
    "run_files/table_store/disk.py",
    "run_files/table_store/part_writer.py",
    "recorder/rerun_recording.py",
    "recorder/events_file.py",
    "recorder/housekeeping.py",
    "recorder/folder_watch.py",
    "recorder/segment_optimizer.py",
    "run_files/run_folder.py",
    "acquisition/raw_frames.py",
    # the logs' own folder, each by its own handle or without following; a socket; a set of one's
    # own run
    "run_files/latched_fault.py",
    "run_files/retention.py",
    "control_port/sockets.py",
    "sessions/folder.py",
    "sessions/live_log.py",
    "alarms/sent_log.py",
    "web/tuning_panel.py",
    # the user's own folder of compiled code, made if it is missing
    "model/kernel_cache.py",
    # the machine's own folder of locks, whose owner and mode are checked
    "instruments/lock_store.py",
    # logs, lock and key of the service in the user's own folders, opened without following a link
    "control_port/service_link.py",
    "hold/page_service.py",
    "service/hold_starter.py",
    # folders of the machine, made by its administrator
    "service/units.py",
    # a new folder, a temporary one, or a file that the user has named
    "sim/optics/simulate.py",
    "cli/man_pages.py",
    "replay/command.py",
    "review/viewer/command.py",
    "review/export.py",
    "calibration/session.py",
    "calibration/camera.py",
    "calibration/calibrate.py",
    "calibration/adopt.py",
    "calibration/geometry_writer.py",
    "geometry/prior_file.py",
    "commissioning/first_config.py",
    # logs of the holds that a guided session starts
    "commissioning/guide/real_bench.py",
    "commissioning/new_driver.py",
    # former configurations beside the one that a person edits, the oldest removed
    "service/configuration_editor.py",
    # shared memory
    "processes/frames.py",
    "processes/ring.py",
    # into memory, and from there by `model.files`
    "measure/result_files.py",
    "measure/report_pdf.py",
    "paper/pictures.py",
    "measure/export_formats.py",
    "review/report/figures.py",
}
_WRITES = re.compile(
    r"""\.write_(text|bytes)\(|open\(\s*(str\()?[\w./]*,?\s*["'](w|a|x|r\+)|\.open\(["'](w|a|x|r\+)|np\.savez|savefig\("""
    r"""|imwrite\(|\.unlink\(|\.rename\(|\.mkdir\(|\.touch\(|O_CREAT|OSFile|h5py\.File\([^)]*"w"|print_figure\("""
)


def test_only_listed_modules_write_files_themselves() -> None:
    """A new place that writes has to go through `model.files`, or say above why it need not."""
    product = ROOT / "membrane_ctrl"
    writers = {
        str(path.relative_to(product))
        for path in product.rglob("*.py")
        if path != Path(atomic.__file__) and _WRITES.search(path.read_text(encoding="utf-8"))
    }
    assert writers == _OWN
