"""Run folders and capture sets made to do harm, one for each finding; and a small share of the fuzzer."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import shutil
import struct
import tomllib
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pytest
import tomli_w
from fuzz_folders import Case, Room, case
from good_folders import RUN, good_run, good_sets
from mutations import sealed_again

from membrane_ctrl.cli import run
from membrane_ctrl.model.plain_json import dumps_checked
from membrane_ctrl.run_files import run_folder
from membrane_ctrl.run_files.column_file import PROGRAM
from membrane_ctrl.run_files.sealed_stream import SealedStream, require_bounded, unseal
from membrane_ctrl.run_files.segments import panics_are_faults, whole_messages
from membrane_ctrl.run_files.tables import tick_schema
from tests.support.peak_memory import peak_mb, reset_peak

HOSTILE = "\x1b]0;owned\x07\x9b2J\r\u202e[/red]"
Said = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("good")
    good_run(root / "logs")
    good_sets(root)
    return root


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    shutil.copytree(made / "logs", tmp_path / "logs")
    return tmp_path / "logs" / RUN


@pytest.fixture
def sets(made: Path, tmp_path: Path) -> Path:
    shutil.copytree(made / "sets", tmp_path / "sets")
    return tmp_path / "sets"


@pytest.fixture
def secret(tmp_path: Path) -> Path:
    path = tmp_path / "secret"
    path.write_text("secret")
    return path


def refused(said: Said, *words: str) -> str:
    """A command ends with exit 2 and one line, which is returned."""
    assert run(list(words)) == 2
    lines = [line for line in said.readouterr().err.splitlines() if not line.startswith("note: ")]
    assert len(lines) == 1
    assert lines[0].isprintable()
    return lines[0]


def rewrite(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    tables = tomllib.loads(path.read_text())
    change(tables)
    path.write_text(tomli_w.dumps(tables))


# ---------------------------------------------------------------------------------------------------------- links


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    ("words", "names"),
    [
        (("repair",), (".probe", ".summary.json.part", "repaired/night-000.rrd", "repaired/.night-000.rrd.part")),
        (("repair", "--in-place"), (".night-000.rrd.part", "events.jsonl.torn")),
        (("report",), ("report/report.html", "report/.report.json.part")),
        (("export", "--format", "csv"), ("export/ticks.csv", "export/events.jsonl")),
    ],
)
def test_a_planted_link_takes_no_file_of_the_user(
    folder: Path, secret: Path, words: tuple[str, ...], names: tuple[str, ...]
) -> None:
    (folder / "summary.json").unlink()
    with (folder / "events.jsonl").open("a") as log:
        log.write('{"kind": "half')
    with (folder / "night-000.rrd").open("r+b") as file:
        file.truncate(file.seek(0, os.SEEK_END) - 40)
    for name in names:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).symlink_to(secret)
    assert run([words[0], str(folder), *words[1:]]) == 0
    assert secret.read_text() == "secret"
    assert secret.lstat().st_nlink == 1


@pytest.mark.parametrize(
    ("name", "words", "code"),
    [
        ("repaired", ("repair",), 2),
        ("report", ("report",), 4),
        ("export", ("export",), 4),
        ("annotations.jsonl", ("mark",), 4),
    ],
)
def test_a_linked_folder_is_refused_in_one_line(
    folder: Path, secret: Path, name: str, words: tuple[str, ...], code: int, capsys: Said
) -> None:
    aim = secret.parent / "mine"
    aim.mkdir()
    with (folder / "night-000.rrd").open("r+b") as file:
        file.truncate(file.seek(0, os.SEEK_END) - 40)
    if name.endswith(".jsonl"):
        (folder / name).unlink()
        (folder / name).symlink_to(secret)
        words = ("review", "mark", str(folder), "text", "--at", "+1s")
    else:
        (folder / name).symlink_to(aim)
        words = (words[0], str(folder))
    assert run(list(words)) == code
    assert "is a link, and links are not followed here" in capsys.readouterr().err.splitlines()[-1]
    assert not list(aim.iterdir())
    assert secret.read_text() == "secret"


@pytest.mark.usefixtures("undrawn")
def test_a_folder_that_the_user_names_may_be_a_link(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "far").mkdir()
    (tmp_path / "near").symlink_to(tmp_path / "far")
    assert run(["report", str(folder), "--out", str(tmp_path / "near")]) == 0
    assert (tmp_path / "far" / "report.html").exists()


@pytest.mark.parametrize("what", ["link", "pipe", "folder", "device"])
@pytest.mark.parametrize(
    "name", ["config.toml", "events.jsonl", "summary.json", "columns/ticks-000.arrows", "night-000.rrd"]
)
def test_what_is_no_plain_file_is_noted_and_not_waited_for(
    folder: Path, secret: Path, name: str, what: str, capsys: Said
) -> None:
    path = folder / name
    path.unlink()
    if what == "pipe":
        os.mkfifo(path)
    elif what == "folder":
        path.mkdir()
    else:
        path.symlink_to(secret if what == "link" else "/dev/zero")
    assert run(["runs", "show", str(folder)]) == 0
    out = capsys.readouterr().out
    assert any(Path(name).name in line for line in out.splitlines() if "note:" in line)
    assert "secret" not in out.replace(str(secret), "")


# ---------------------------------------------------------------------------------------------------------- bounds


@pytest.mark.usefixtures("undrawn")
def test_four_megabytes_of_a_table_that_would_be_four_gigabytes(folder: Path, capsys: Said) -> None:
    path = folder / "columns" / "ticks-000.arrows"
    schema = tick_schema()
    stream = SealedStream(path, schema, "zstd")
    zeros = np.zeros(1_000_000)
    arrays = [pa.array(zeros, field.type) for field in schema]
    stream.write(pa.record_batch(arrays, schema=schema))
    stream.close()
    assert path.stat().st_size < 1e6
    before_mb = reset_peak()
    assert run(["report", str(folder), "--json"]) == 0
    assert re.search(r"ticks-000.arrows: cannot be read \(a batch of \d+ MB", capsys.readouterr().out)
    assert peak_mb() - before_mb < 300


def test_a_batch_that_lies_about_its_size_is_refused_unread() -> None:
    file = io.BytesIO()
    schema = pa.schema([("a", pa.float64())])
    writer = pa.ipc.new_stream(file, schema, options=pa.ipc.IpcWriteOptions(compression="zstd"))
    writer.write_batch(pa.record_batch([np.zeros(1000)], schema=schema))
    writer.close()
    data = file.getvalue()
    require_bounded(data)
    place = data.rfind(struct.pack("<q", 8000))
    for size in (2**40, -(2**62)):
        with pytest.raises(pa.ArrowInvalid, match="exceeds the limit of 64"):
            require_bounded(data[:place] + struct.pack("<q", size) + data[place + 8 :])


def test_a_batch_with_fewer_rows_than_it_says_is_not_read(folder: Path, capsys: Said) -> None:
    """Arrow takes a head's count of rows as it is, and reads what lies behind the buffer."""
    path = folder / "columns" / "ticks-000.arrows"
    rows = 1234
    schema = pa.schema([("mono_s", pa.float64())])
    stream = SealedStream(path, schema)
    stream.write(pa.record_batch([np.arange(rows) / 50], schema=schema))
    stream.close()
    forged = path.read_bytes().replace(struct.pack("<q", rows), struct.pack("<q", 100 * rows))
    path.write_bytes(sealed_again(forged))
    assert run(["runs", "show", str(folder)]) == 0
    assert "ticks-000.arrows: damaged or truncated after batch 0" in capsys.readouterr().out


def test_words_in_no_alphabet_are_not_read(folder: Path, capsys: Said) -> None:
    path = folder / "columns" / "shapes-000.arrows"
    path.write_bytes(sealed_again(path.read_bytes().replace(b"fringes", b"fr\xff\xfe\xfdes")))
    assert run(["runs", "show", str(folder)]) == 0
    capsys.readouterr()


def test_seals_over_seals_are_given_up() -> None:
    """Each says that the rest of the file is its message."""
    seal = b"seal:%04x%08x%08x" % (0, 1_000_000, 1)
    assert unseal(seal * 100_000).data == b""


def test_tables_of_other_kinds_are_no_tables(folder: Path, capsys: Said) -> None:
    """Words where numbers belong, a column twice, lists of nothing: said, and the run is shown without."""
    for number, schema in enumerate(
        (
            pa.schema([("mono_s", pa.string())]),
            pa.schema([("mono_s", pa.float64())] * 2),
            pa.schema([("x", pa.null())]),
        )
    ):
        stream = SealedStream(folder / "columns" / f"ticks-00{number}.arrows", schema)
        stream.write(pa.RecordBatch.from_arrays([pa.nulls(9, kind) for kind in schema.types], schema=schema))
        stream.close()
    assert run(["runs", "show", str(folder)]) == 0
    assert "without mono_s" in capsys.readouterr().out


def test_a_segment_of_a_terabyte_of_nothing(folder: Path, capsys: Said) -> None:
    with (folder / "night-000.rrd").open("r+b") as file:
        file.truncate(2**40)
    assert run(["repair", str(folder), "--json"]) == 0
    (found,) = (row for row in json.loads(capsys.readouterr().out)["files"] if row["file"] == "night-000.rrd")
    assert "MB outside any message" in found["action"]


@pytest.mark.parametrize("kind", [2, 3])
def test_a_message_that_claims_the_rest_of_a_terabyte(folder: Path, capsys: Said, kind: int) -> None:
    """It is within its file, which is sparse: what is whole in front of it is read, and no more memory taken."""
    path = folder / "night-000.rrd"
    whole = whole_messages(path)
    with path.open("r+b") as file:
        file.truncate(whole[-1].start)
        file.seek(whole[-1].start)
        file.write(struct.pack("<QQ", kind, 2**39))
        file.truncate(2**40)
    shutil.rmtree(folder / "columns")  # the segments are all there is
    assert whole_messages(path) == whole[:-1]
    assert run(["runs", "show", str(folder)]) in {0, 3}
    assert "night-000.rrd" in capsys.readouterr().out


def test_where_rerun_gives_up_python_goes_on() -> None:
    class PanicException(BaseException):  # as PyO3 names it, and what it is
        pass

    with pytest.raises(RuntimeError, match="Rerun failed on it"), panics_are_faults():
        raise PanicException("index out of bounds")
    with pytest.raises(KeyboardInterrupt), panics_are_faults():
        raise KeyboardInterrupt


def test_a_message_of_a_segment_that_would_be_huge(folder: Path, capsys: Said) -> None:
    path = folder / "night-000.rrd"
    data = bytearray(path.read_bytes())
    place = data.index(b"\x18", data.index(b"membrane_ctrl\x10\x02"))  # uncompressed_size, behind compression = 2
    data[place + 1 : place + 3] = b"\xff\xff"
    data[place + 3 : place + 3] = b"\xff\xff\x7f"
    path.write_bytes(data)
    assert run(["repair", str(folder)]) == 0
    assert "which no recorder writes" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("a" + ".a" * 20_000 + " = 1", "a key of more than 50 parts"),
        ('"a"' + '.","' * 20_000 + " = 1", "a key of more than 50 parts"),
        ("x = " + "[" * 20_000, "nested too deep"),
        ("x = " + "9" * 9_000, "not valid TOML"),
        ("#" * 2_000_000, "2 MB, above the limit of 1 MB"),
    ],
    ids=["dotted", "quoted", "deep", "digits", "long"],
)
def test_toml_that_would_take_all_there_is(folder: Path, sets: Path, text: str, why: str, capsys: Said) -> None:
    for path, words in (
        (folder / "config.toml", ("replay", str(folder))),
        (sets / "0000" / "capture.toml", ("measure", str(sets / "0000"))),
    ):
        path.write_text(text)
        assert why in refused(capsys, *words)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("[" * 100_000, "summary.json: cannot be read (nested too deep)"),
        ('{"a": ' * 40 + "1" + "}" * 40, "summary.json: cannot be read (nested too deep)"),
        ("[" + "[]," * 6_000_000 + "1]", "events.jsonl: cannot be read (more than 6000000 elements)"),
        ('{"duration_s": ' + "9" * 5000 + "}", "events.jsonl: 1 line unreadable"),
    ],
    ids=["deep", "depth", "many", "digits"],
)
def test_json_that_would_take_all_there_is(folder: Path, text: str, why: str, capsys: Said) -> None:
    (folder / "summary.json").write_text(text)
    with (folder / "events.jsonl").open("a") as file:
        file.write(text + ("\n{}{}\n" if why.startswith("events.jsonl: 1") else "\n"))
    before_mb = reset_peak()
    assert run(["runs", "show", str(folder)]) == 0
    assert peak_mb() - before_mb < 500
    assert why in capsys.readouterr().out


def test_a_picture_of_twenty_thousand_by_twenty_thousand(sets: Path, capsys: Said) -> None:
    folder = sets / "0000"
    path = folder / "x_sin_1.png"
    data = bytearray(path.read_bytes())
    struct.pack_into(">II", data, 16, 20_000, 20_000)
    struct.pack_into(">I", data, 29, zlib.crc32(data[12:29]))
    path.write_bytes(data)
    before_mb = reset_peak()
    assert run(["measure", str(folder), "--json"]) == 3
    reason = json.loads(capsys.readouterr().out)["quality"]["reason"]
    assert "20000 x 20000 pixels exceed the limit of 64 million" in reason
    assert peak_mb() - before_mb < 200


@pytest.mark.parametrize("suffix", [".tiff", ".bmp", ".jpg"])
def test_other_pictures_are_measured_before_they_are_decoded(suffix: str) -> None:
    from membrane_ctrl.measure.images import decoded_image, image_size

    picture = np.arange(35, dtype=np.uint8).reshape(5, 7)
    data = cv2.imencode(suffix, picture)[1].tobytes()
    assert image_size(data) == (7, 5)
    assert decoded_image(data, cv2.IMREAD_GRAYSCALE).shape == (5, 7)
    for end in range(len(data)):
        with contextlib.suppress(ValueError):  # and nothing else
            decoded_image(data[:end], cv2.IMREAD_GRAYSCALE)


def test_a_camera_of_more_pixels_than_there_is_memory(sets: Path, capsys: Said) -> None:
    rewrite(sets / "0000" / "capture.toml", lambda tables: tables["camera"].update(width_px=16_000, height_px=12_000))
    assert "exceed the limit of 300 million" in refused(capsys, "measure", str(sets / "0000"))


def test_many_unknown_keys_are_left_out_in_one_go(folder: Path, capsys: Said) -> None:
    with (folder / "config.toml").open("a") as file:
        file.write("[more]\n" + "".join(f"k{number} = 1\n" for number in range(20_000)))
        file.write("".join(f"[t{number}]\n" for number in range(3_000)))
    assert run(["runs", "--logs", str(folder.parent)]) == 0
    assert RUN in capsys.readouterr().out


# ---------------------------------------------------------------------------------------------------------- sets


@pytest.mark.parametrize(
    "where", ["../secret.png", "/{}", "up/../../secret.png", "link.png", "sub/x.png", "a\0b", ""]
)
def test_a_frame_outside_the_set_is_refused(sets: Path, where: str, capsys: Said) -> None:
    folder = sets / "0000"
    shutil.copy(folder / "white.png", sets / "secret.png")
    (folder / "link.png").symlink_to(sets / "secret.png")
    (folder / "sub").symlink_to(sets)
    name = where.format(sets / "secret.png")
    change = {"file": name if where != "sub/x.png" else "sub/secret.png"}
    rewrite(folder / "capture.toml", lambda tables: tables["frames"][0].update(change))
    assert "is outside the set's folder" in refused(capsys, "measure", str(folder))


def test_a_frame_that_is_a_link_within_the_set_is_no_picture(sets: Path, capsys: Said) -> None:
    folder = sets / "0000"
    (folder / "x_sin_0.png").rename(folder / "other.png")
    (folder / "x_sin_0.png").symlink_to("other.png")
    assert run(["measure", str(folder), "--json"]) == 3
    assert "a link, and links are not followed" in json.loads(capsys.readouterr().out)["quality"]["reason"]


def test_a_reference_beside_the_set_still_anchors_it(sets: Path) -> None:
    assert run(["measure", str(sets / "0001")]) == 0


def test_a_height_map_is_of_the_sets_own_folder(sets: Path, capsys: Said) -> None:
    grid = {"s_x_mm": [-300.0, 300.0], "s_y_mm": [-300.0, 300.0], "file": "../../../../etc/passwd"}
    change = {"screen": {"height_map": grid}}
    rewrite(sets / "0000" / "capture.toml", lambda tables: tables["geometry"].update(change))
    said = refused(capsys, "measure", str(sets / "0000"))
    assert "not beside capture.toml" in said
    assert ":x:0" not in said


# ---------------------------------------------------------------------------------------------------------- words


@pytest.mark.usefixtures("undrawn")
def test_no_control_byte_of_a_run_is_printed(folder: Path, capsys: Said) -> None:
    events = [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]
    for event in events:
        event.pop("crc32", None)
        event.update({key: HOSTILE for key in ("name", "text", "exit") if key in event})
    events.append({"kind": "mark", "mono_s": 1.0, "text": HOSTILE})
    events.append({"kind": "fault", "mono_s": 1.5, "name": HOSTILE})
    (folder / "events.jsonl").write_text("".join(f"{dumps_checked(event)}\n" for event in events))
    summary = json.loads((folder / "summary.json").read_text())
    summary.pop("crc32")
    (folder / "summary.json").write_text(dumps_checked({**summary, "exit": HOSTILE}))
    ticks = folder / "columns" / "ticks-000.arrows"
    program = PROGRAM.encode()
    ticks.write_bytes(sealed_again(ticks.read_bytes().replace(program, HOSTILE.encode()[: len(program)])))
    folder = folder.rename(folder.with_name(f"{RUN}-\x1b[31m"))
    for words in (
        ("runs", "--logs", str(folder.parent)),
        ("runs", "--logs", str(folder.parent), "--json"),
        ("runs", "show", str(folder)),
        ("replay", str(folder)),
        ("repair", str(folder)),
        ("report", str(folder)),
        ("report", str(folder), "--json"),
    ):
        run(list(words))
        said = "".join(capsys.readouterr())
        assert said.replace("\n", "").replace("\t", "").isprintable(), words


def test_a_report_shows_words_and_runs_none(folder: Path) -> None:
    script = "<script>alert(1)</script> $\\frac{"
    events = [
        {"kind": kind, "mono_s": 1.0, "text": script, "name": script, "exit": script}
        for kind in ("mark", "fault", script)
    ]
    (folder / "events.jsonl").write_text("".join(f"{json.dumps(event)}\n" for event in events))
    with (folder / "config.toml").open("a") as file:
        file.write(f"[more]\n'{script}' = 1\n")
    assert run(["report", str(folder)]) == 0
    page = (folder / "report" / "report.html").read_text()
    assert "&lt;script&gt;alert(1)" in page
    assert "<script>alert" not in page


def test_a_formula_in_a_frames_name_is_no_formula(sets: Path) -> None:
    folder = sets / "0000"
    rewrite(folder / "capture.toml", lambda tables: tables["frames"][1].update(file="$\\frac{$.png"))
    assert run(["measure", str(folder)]) == 3


def test_a_folder_that_may_not_be_looked_into_costs_its_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: Said
) -> None:
    (folder.parent / "closed").mkdir()
    exists = Path.exists

    def guarded(path: Path) -> bool:
        if path.parent.name == "closed":
            raise PermissionError(13, "Permission denied", str(path))
        return exists(path)

    monkeypatch.setattr(Path, "exists", guarded)
    monkeypatch.setattr(run_folder, "read_config", _closed(run_folder.read_config))
    assert run(["runs", "--logs", str(folder.parent)]) == 0
    out = capsys.readouterr().out
    assert RUN in out
    assert "cannot be read (permission denied)" in out


def _closed(read: Callable[..., Any]) -> Callable[..., Any]:
    def guarded(path: Path, notes: list[str]) -> object:
        if path.name == "closed":
            raise PermissionError(13, "Permission denied", str(path))
        return read(path, notes)

    return guarded


def test_half_a_pair_of_a_letter_is_written_all_the_same(folder: Path, capsys: Said) -> None:
    with (folder / "annotations.jsonl").open("a") as file:
        file.write('{"kind": "mark", "mono_s": 1, "text": "\\ud800"}\n')
    for words in (("report",), ("runs", "show"), ("export", "--format", "csv")):
        assert (
            run(
                [*words[:1], *words[1:2], str(folder), *words[2:]]
                if words[0] == "runs"
                else [words[0], str(folder), *words[1:]]
            )
            == 0
        )


def test_events_of_nonsense_end_no_command(folder: Path) -> None:
    with (folder / "events.jsonl").open("a") as file:
        file.write('{"kind": {"a": 1}, "mono_s": 1}\n')
        file.write('{"kind": "state", "state": "hold", "mono_s": 1e308}\n')
        file.write('{"kind": "state", "state": ["hold"], "mono_s": NaN}\n')
        file.write('{"kind": "state", "state": {"a": 1}}\n')
        file.write('{"kind": "end", "exit": "done", "mono_s": -Infinity, "time_utc": "9999-12-31T23:59:59"}\n')
        file.write('{"kind": "end", "exit": {"a": 1}, "mono_s": true, "time_utc": {"a": 1}}\n')
        file.write('{"kind": "mark", "text": {"a": 1}, "mono_s": 12345678901234567890123456789}\n')
        file.write('{"kind": "mark", "text": {"a": 1}, "mono_s": 2, "time_utc": "0001-01-01T00:00:00-12:00"}\n')
    for words in (["runs", "show"], ["replay"], ["repair"], ["report"], ["export"], ["runs", "--logs"]):
        where = folder.parent if words == ["runs", "--logs"] else folder
        assert run([*words, str(where)]) in {0, 3}, words


# ------------------------------------------------------------------------------------------------------ the fuzzer


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Room:
    return Room(tmp_path_factory.mktemp("fuzz"))


QUICK = [
    found
    for found in map(case, range(400))
    if found.command.name not in {"report", "review", "stability", "repair", "measure pictures"}
    and not found.command.name.startswith("tune")
]


@pytest.mark.parametrize("one", QUICK[:40], ids=lambda one: f"{one.number}-{one.command.name}")
def test_a_small_share_of_the_fuzzer(room: Room, one: Case) -> None:
    assert room.run(one) == ""
