"""Run folders and capture sets made to do harm, one for each finding; and a small share of the
fuzzer.
"""

from __future__ import annotations

import contextlib
import json
import os
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
import pyarrow.parquet as pq
import pytest
import tomli_w
from fuzz_folders import Case, Room, case
from good_folders import RUN, good_run, good_sets

from membrane_ctrl.cli import run
from membrane_ctrl.model.file_checksums import dumps_checked
from membrane_ctrl.run_files import run_config
from membrane_ctrl.run_files.table_specs import TICKS
from tests.support.peak_memory import peak_mb, reset_peak

HOSTILE = "\x1b]0;owned\x07\x9b2J\r\u202e[/red]"
Captured = pytest.CaptureFixture[str]


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


def refused(capsys: Captured, *words: str) -> str:
    """A command ends with exit 2 and one line, which is returned."""
    assert run(list(words)) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("note: ")]
    assert len(lines) == 1
    assert lines[0].isprintable()
    return lines[0]


def rewrite(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    tables = tomllib.loads(path.read_text())
    change(tables)
    path.write_text(tomli_w.dumps(tables))


# ----------------------------------------------------------------------------------------------------------  # noqa: E501
# links


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    ("words", "names"),
    [
        (
            ("repair",),
            (
                ".probe",
                ".summary.json.part",
                "repaired/events.jsonl",
                "repaired/.events.jsonl.part",
            ),
        ),
        (("repair", "--in-place"), (".events.jsonl.part", "events.jsonl.torn")),
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
    folder: Path, secret: Path, name: str, words: tuple[str, ...], code: int, capsys: Captured
) -> None:
    aim = secret.parent / "mine"
    aim.mkdir()
    with (folder / "events.jsonl").open("a") as log:
        log.write('{"kind": "half')
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
    "name",
    [
        "config.toml",
        "events.jsonl",
        "summary.json",
        "ticks/ticks-0000.parquet",
        "ticks/manifest.jsonl",
    ],
)
def test_what_is_no_plain_file_is_noted_and_not_waited_for(
    folder: Path, secret: Path, name: str, what: str, capsys: Captured
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


# ----------------------------------------------------------------------------------------------------------  # noqa: E501
# bounds


@pytest.mark.usefixtures("undrawn")
def test_a_small_part_that_would_be_gigabytes(folder: Path, capsys: Captured) -> None:
    path = folder / "ticks" / "ticks-0000.parquet"
    zeros = pa.array(np.zeros(20_000_000, np.int8))
    table = pa.table(
        [zeros.cast(field.type) for field in list(TICKS.schema)[:4]], names=TICKS.schema.names[:4]
    )
    pq.write_table(table, path, compression="zstd", row_group_size=len(zeros))
    (path.parent / "manifest.jsonl").unlink()
    assert path.stat().st_size < 1e6
    del table, zeros
    before_mb = reset_peak()
    assert run(["report", str(folder), "--json"]) == 0
    assert "more rows than a recorder writes" in capsys.readouterr().out
    assert peak_mb() - before_mb < 300


def test_words_in_no_alphabet_are_not_read(folder: Path, capsys: Captured) -> None:
    path = folder / "shapes" / "shapes-0000.parquet"
    table = pq.read_table(path)
    binary = pa.array([b"fr\xff\xfe\xfdes"] * table.num_rows)
    place = table.schema.get_field_index("kind")
    forged = table.set_column(
        place, "kind", pa.Array.from_buffers(pa.string(), table.num_rows, binary.buffers())
    )
    pq.write_table(forged, path)
    assert run(["runs", "show", str(folder)]) == 0
    assert run(["replay", str(folder)]) in (0, 2, 3)
    capsys.readouterr()


def test_tables_of_other_kinds_are_no_tables(folder: Path, capsys: Captured) -> None:
    """Words where numbers belong, a column twice, lists of nothing: said, and the run is shown
    without.
    """
    schemas = (
        pa.schema([("mono_s", pa.string())]),
        pa.schema([("mono_s", pa.float64())] * 2),
        pa.schema([("x", pa.null())]),
    )
    for number, schema in enumerate(schemas):
        table = pa.Table.from_arrays([pa.nulls(9, kind) for kind in schema.types], schema=schema)
        pq.write_table(table, folder / "ticks" / f"ticks-{number:04d}.parquet")
    assert run(["runs", "show", str(folder)]) == 0
    assert "without mono_s" in capsys.readouterr().out


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
def test_toml_that_would_take_all_there_is(
    folder: Path, sets: Path, text: str, why: str, capsys: Captured
) -> None:
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
        (
            "[" + "[]," * 6_000_000 + "1]",
            "events.jsonl: cannot be read (more than 6000000 elements)",
        ),
        ('{"duration_s": ' + "9" * 5000 + "}", "events.jsonl: 1 line unreadable"),
    ],
    ids=["deep", "depth", "many", "digits"],
)
def test_json_that_would_take_all_there_is(
    folder: Path, text: str, why: str, capsys: Captured
) -> None:
    (folder / "summary.json").write_text(text)
    with (folder / "events.jsonl").open("a") as file:
        file.write(text + ("\n{}{}\n" if why.startswith("events.jsonl: 1") else "\n"))
    before_mb = reset_peak()
    assert run(["runs", "show", str(folder)]) == 0
    assert peak_mb() - before_mb < 500
    assert why in capsys.readouterr().out


def test_a_picture_of_twenty_thousand_by_twenty_thousand(sets: Path, capsys: Captured) -> None:
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


def test_a_camera_of_more_pixels_than_there_is_memory(sets: Path, capsys: Captured) -> None:
    rewrite(
        sets / "0000" / "capture.toml",
        lambda tables: tables["camera"].update(width_px=16_000, height_px=12_000),
    )
    assert "exceed the limit of 300 million" in refused(capsys, "measure", str(sets / "0000"))


def test_many_unknown_keys_are_left_out_in_one_go(folder: Path, capsys: Captured) -> None:
    with (folder / "config.toml").open("a") as file:
        file.write("[more]\n" + "".join(f"k{number} = 1\n" for number in range(20_000)))
        file.write("".join(f"[t{number}]\n" for number in range(3_000)))
    assert run(["runs", "--logs", str(folder.parent)]) == 0
    assert RUN in capsys.readouterr().out


# ----------------------------------------------------------------------------------------------------------  # noqa: E501
# sets


@pytest.mark.parametrize(
    "where", ["../secret.png", "/{}", "up/../../secret.png", "link.png", "sub/x.png", "a\0b", ""]
)
def test_a_frame_outside_the_set_is_refused(sets: Path, where: str, capsys: Captured) -> None:
    folder = sets / "0000"
    shutil.copy(folder / "white.png", sets / "secret.png")
    (folder / "link.png").symlink_to(sets / "secret.png")
    (folder / "sub").symlink_to(sets)
    name = where.format(sets / "secret.png")
    change = {"file": name if where != "sub/x.png" else "sub/secret.png"}
    rewrite(folder / "capture.toml", lambda tables: tables["frames"][0].update(change))
    assert "is outside the set's folder" in refused(capsys, "measure", str(folder))


def test_a_frame_that_is_a_link_within_the_set_is_no_picture(sets: Path, capsys: Captured) -> None:
    folder = sets / "0000"
    (folder / "x_sin_0.png").rename(folder / "other.png")
    (folder / "x_sin_0.png").symlink_to("other.png")
    assert run(["measure", str(folder), "--json"]) == 3
    assert (
        "a link, and links are not followed"
        in json.loads(capsys.readouterr().out)["quality"]["reason"]
    )


def test_a_reference_beside_the_set_still_anchors_it(sets: Path) -> None:
    assert run(["measure", str(sets / "0001")]) == 0


def test_a_height_map_is_of_the_sets_own_folder(sets: Path, capsys: Captured) -> None:
    grid = {"s_x_mm": [-300.0, 300.0], "s_y_mm": [-300.0, 300.0], "file": "../../../../etc/passwd"}
    change = {"screen": {"height_map": grid}}
    rewrite(sets / "0000" / "capture.toml", lambda tables: tables["geometry"].update(change))
    refusal = refused(capsys, "measure", str(sets / "0000"))
    assert "not beside capture.toml" in refusal
    assert ":x:0" not in refusal


# ----------------------------------------------------------------------------------------------------------  # noqa: E501
# words


@pytest.mark.usefixtures("undrawn")
def test_no_control_byte_of_a_run_is_printed(folder: Path, capsys: Captured) -> None:
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
    part = folder / "inputs" / "inputs-0000.parquet"
    table = pq.read_table(part)
    pq.write_table(table.replace_schema_metadata({"program": HOSTILE, "first_row": HOSTILE}), part)
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
        output = "".join(capsys.readouterr())
        assert output.replace("\n", "").replace("\t", "").isprintable(), words


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
    rewrite(
        folder / "capture.toml", lambda tables: tables["frames"][1].update(file="$\\frac{$.png")
    )
    assert run(["measure", str(folder)]) == 3


def test_a_folder_that_may_not_be_looked_into_costs_its_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: Captured
) -> None:
    (folder.parent / "closed").mkdir()
    exists = Path.exists

    def guarded(path: Path) -> bool:
        if path.parent.name == "closed":
            raise PermissionError(13, "Permission denied", str(path))
        return exists(path)

    monkeypatch.setattr(Path, "exists", guarded)
    monkeypatch.setattr(run_config, "read_config", _closed(run_config.read_config))
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


def test_half_a_pair_of_a_letter_is_written_all_the_same(folder: Path, capsys: Captured) -> None:
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
        file.write(
            '{"kind": "end", "exit": "done", "mono_s": -Infinity, "time_utc": '
            '"9999-12-31T23:59:59"}\n'
        )
        file.write('{"kind": "end", "exit": {"a": 1}, "mono_s": true, "time_utc": {"a": 1}}\n')
        file.write('{"kind": "mark", "text": {"a": 1}, "mono_s": 12345678901234567890123456789}\n')
        file.write(
            '{"kind": "mark", "text": {"a": 1}, "mono_s": 2, "time_utc": '
            '"0001-01-01T00:00:00-12:00"}\n'
        )
    for words in (
        ["runs", "show"],
        ["replay"],
        ["repair"],
        ["report"],
        ["export"],
        ["runs", "--logs"],
    ):
        where = folder.parent if words == ["runs", "--logs"] else folder
        assert run([*words, str(where)]) in {0, 3}, words


# ------------------------------------------------------------------------------------------------------  # noqa: E501
# the fuzzer


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
