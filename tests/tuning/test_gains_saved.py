"""`tune save`: a configuration with a session's kept gains, its comments,
and nothing else changed.
"""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from membrane_ctrl.cli import run
from membrane_ctrl.config.schema import Config, LoopConfig, PumpConfig
from membrane_ctrl.config.toml_file import load_toml
from membrane_ctrl.model.errors import Exit
from membrane_ctrl.sessions import folder as plain
from tuning import same_bench
from tuning.identification.pump_map import PumpMap
from tuning.journal import What, append_entry, format_history, make_entry, read_entries
from tuning.steps.map_pump import MappedPump
from tuning.steps.verify import Verified

BEFORE = LoopConfig()
GAINS = {
    "kp_per_s": 0.448,
    "ti_s": 8.79,
    "measurement_filter_s": 0.1,
    "temperature_gain_um_per_k": 121.5,
}
AFTER = LoopConfig.model_validate(BEFORE.model_dump() | GAINS)
TEXT = """# The bench in room 3.
[limits]
band_um = 2.0     # agreed with optics

[loop]            # tuned in May
kp_per_s = 0.61   # 1/s
ti_s     = 6.5
setpoint_um = 5.0
# bleed: none

[shape]
enabled = false
"""


def kept_session(logs: Path, kept: bool = True, config: Config | None = None) -> Path:
    """A session that verified `AFTER`, and its line in the journal."""
    session = plain.create_session(logs, "s1", "eve", "a-run", config or Config(), BEFORE)
    reason = "" if kept else "the readings show a sensitivity of 2.3"
    plain.write_session_file(
        session.file_path("verified.json"), Verified(kept, reason, (), BEFORE, AFTER)
    )
    append_entry(
        logs,
        make_entry(
            "kept" if kept else "taken_back", session.path.name, "eve", "why", BEFORE, AFTER
        ),
    )
    return session.path


def saved(path: Path, *words: str, text: str = TEXT) -> int:
    path.write_text(text)
    return run(["tune", "save", "--config", str(path), "--logs", str(path.parent / "logs"), *words])


def test_the_next_hold_starts_with_the_kept_gains_and_comments_stay(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session, path = kept_session(tmp_path / "logs"), tmp_path / "lab.toml"
    path.touch(0o600)
    assert saved(path, "--yes") == Exit.DONE
    assert load_toml(path, Config).loop == AFTER.model_copy(update={"setpoint_um": 5.0})
    assert tomllib.loads(path.read_text()) == tomllib.loads(TEXT) | {
        "loop": {"setpoint_um": 5.0, **GAINS}
    }
    lines = path.read_text().splitlines()
    assert "kp_per_s = 0.448   # 1/s" in lines
    assert [line for line in TEXT.splitlines() if line not in lines] == [
        "kp_per_s = 0.61   # 1/s",
        "ti_s     = 6.5",
    ]
    printed = capsys.readouterr().out.splitlines()
    assert "-kp_per_s = 0.61   # 1/s" in printed
    assert "+kp_per_s = 0.448   # 1/s" in printed
    assert path.stat().st_mode & 0o777 == 0o600
    last = read_entries(tmp_path / "logs")[-1]
    assert (last.what, last.session, last.reason) == ("saved", session.name, str(path))
    assert run(["tune", "save", "--config", str(path), str(session)]) == Exit.DONE
    assert "already has the gains" in capsys.readouterr().out


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[loop]\n",
        "loop.kp_per_s = 0.5\nshape.enabled = false\n",
        "loop = { kp_per_s = 0.5, ti_s = 7.0 } # inline\n[shape]\nenabled = false\n",
        TEXT.replace("\n", "\r\n"),
        "[loop]\nti_s = 9\n[shape]\nenabled = false\n",
    ],
)
def test_every_way_to_write_a_table_is_kept(tmp_path: Path, text: str) -> None:
    kept_session(tmp_path / "logs")
    path = tmp_path / "lab.toml"
    assert saved(path, "--yes", text=text) == Exit.DONE
    found, before = tomllib.loads(path.read_bytes().decode()), tomllib.loads(text)
    assert found == before | {"loop": before.get("loop", {}) | GAINS}
    assert path.read_bytes().count(b"#") == text.count("#")


class Terminal:
    """A terminal at which one answer is typed."""

    def __init__(self, answer: str) -> None:
        self._answer = answer

    def isatty(self) -> bool:
        return True

    def readline(self) -> str:
        if self._answer == "!":
            raise KeyboardInterrupt
        return self._answer


@pytest.mark.parametrize(
    ("answer", "changed", "code"),
    [
        ("y\n", True, Exit.DONE),
        ("\n", False, Exit.DONE),
        ("", False, Exit.DONE),
        ("!", False, Exit.INTERRUPTED),
        (None, False, Exit.DONE),
    ],
)
def test_only_a_yes_writes(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    answer: str | None,
    changed: bool,
    code: Exit,
) -> None:
    kept_session(tmp_path / "logs")
    path = tmp_path / "lab.toml"
    if answer is not None:
        monkeypatch.setattr("sys.stdin", Terminal(answer))
    assert saved(path) == code
    assert (path.read_text() != TEXT) == changed
    assert "+kp_per_s = 0.448   # 1/s" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (
            TEXT + "[pump]\nflow_full_um_per_s = 8.0\n",
            "pump.flow_full_um_per_s = 8.0, the session had 5.3",
        ),
        (
            TEXT.replace("setpoint", "rate_hz = 25.0\nsetpoint"),
            "loop.rate_hz = 25.0, the session had 50.0",
        ),
        (TEXT + '[devices]\nboard = "tcp://192.0.2.1"\n', "the session tuned the simulated bench"),
        (TEXT.replace("band_um = 2.0 ", "band_um = 900.0 "), "limits.band_um = 900"),
        (TEXT.replace("[loop]", "[lop]"), "unknown key"),
        (TEXT.replace("[loop]", "[loop"), "not valid TOML"),
    ],
)
def test_gains_for_another_bench_are_not_saved(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, reason: str
) -> None:
    kept_session(tmp_path / "logs")
    path = tmp_path / "lab.toml"
    assert saved(path, "--yes", text=text) == Exit.BAD_INPUT
    assert path.read_text() == text
    printed = [
        line for line in capsys.readouterr().err.splitlines() if line.startswith("membrane-ctrl: ")
    ]
    assert any("lab.toml" in line and reason in line for line in printed), printed


def test_gains_that_were_not_kept_or_were_rolled_back_are_not_saved(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    logs, path = tmp_path / "logs", tmp_path / "lab.toml"
    assert saved(path, "--yes") == Exit.BAD_INPUT
    assert "no kept gains" in capsys.readouterr().err
    failed = kept_session(logs, kept=False)
    assert saved(path, str(failed), "--yes") == Exit.BAD_INPUT
    assert "its gains were not kept: the readings show" in capsys.readouterr().err
    undone = kept_session(logs)
    append_entry(logs, make_entry("rolled_back", undone.name, "ann", "too slow", BEFORE, AFTER))
    assert saved(path, str(undone), "--yes") == Exit.BAD_INPUT
    assert "(too slow)" in capsys.readouterr().err
    unfinished = plain.create_session(logs, "s2", "eve", "a-run", Config(), BEFORE).path
    assert saved(path, str(unfinished), "--yes") == Exit.BAD_INPUT
    assert "run `membrane-ctrl tune verify` first" in capsys.readouterr().err
    assert path.read_text() == TEXT


def test_a_file_that_changes_during_the_question_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    kept_session(tmp_path / "logs")
    path = tmp_path / "lab.toml"

    class Slow(Terminal):
        def readline(self) -> str:
            path.write_text(TEXT + "# edited\n")
            return "y\n"

    monkeypatch.setattr("sys.stdin", Slow(""))
    assert saved(path) == Exit.BAD_INPUT
    assert "has changed meanwhile" in capsys.readouterr().err
    assert path.read_text() == TEXT + "# edited\n"


def test_a_link_leads_to_the_file_that_is_written(tmp_path: Path) -> None:
    kept_session(tmp_path / "logs")
    path, target = tmp_path / "lab.toml", tmp_path / "etc" / "real.toml"
    target.parent.mkdir()
    target.write_text(TEXT)
    path.symlink_to(target)
    assert saved(path, "--yes") == Exit.DONE
    assert path.is_symlink()
    assert load_toml(target, Config).loop.kp_per_s == 0.448


def test_a_file_that_cannot_be_edited_gives_the_keys_to_set(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """An editor that would change anything else is not trusted."""
    monkeypatch.setattr("tomlkit.dumps", lambda document: TEXT.replace("2.0", "3.0"))
    kept_session(tmp_path / "logs")
    assert saved(tmp_path / "lab.toml", "--yes") == Exit.BAD_INPUT
    assert "set in [loop]: kp_per_s = 0.448, ti_s = 8.79" in capsys.readouterr().err
    assert set(same_bench.GAIN_KEYS) <= set(LoopConfig.model_fields)


CURVE = PumpConfig(
    curve_fraction=(0.1, 0.5, 1.0), curve_um_per_s=(0.0, 1.5, 6.0), start_fraction=0.2
)


def mapped_session(logs: Path, text: str) -> Path:
    """A session that measured a curve, slowed the gains and went no further."""
    (logs / "before.toml").write_text(text)
    config = load_toml(logs / "before.toml", Config)
    session = plain.create_session(logs, "s2", "eve", "a-run", config, config.loop)
    found = PumpMap((0.1, 1.0), (0.0, 6.0), (0.0, 0.1), CURVE, 1.2, 1.0, 0.2, 600.0, True)
    plain.write_session_file(
        session.file_path("pump_map.json"), MappedPump(found, config.pump, 1.0, 0.02)
    )
    loop = config.loop.model_copy(update={"kp_per_s": 0.3, "flow_max_um_per_s": 6.0})
    return plain.restart_session(session, loop, CURVE).path


def test_a_measured_curve_is_saved_with_the_gains_that_suit_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = TEXT + "[pump]\nstall_fraction = 0.1  # as wired\n"
    session, path = mapped_session(tmp_path, text), tmp_path / "lab.toml"
    assert saved(path, str(session), "--yes", text=text) == Exit.DONE
    now = load_toml(path, Config)
    assert now.pump == CURVE
    assert (now.loop.kp_per_s, now.loop.flow_max_um_per_s) == (0.3, 6.0)
    assert "# agreed with optics" in path.read_text()
    capsys.readouterr()
    assert run(["tune", "save", "--config", str(path), str(session)]) == Exit.DONE
    assert "already has" in capsys.readouterr().out


def test_a_hold_by_the_estimate_is_given_the_curve_with_what_was_measured_of_the_sensors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = TEXT + '[estimator]\nprocess_value = "estimate"\n'
    session, path = mapped_session(tmp_path, text), tmp_path / "lab.toml"
    monkeypatch.setattr(
        "tuning.estimator_levels.derive_estimator_levels", lambda folder: {"pump_delay_s": 1.1}
    )
    assert saved(path, str(session), "--yes", text=text) == Exit.DONE
    now = load_toml(path, Config)
    assert (now.estimator.pump_delay_s, now.pump, now.loop.flow_max_um_per_s) == (1.1, CURVE, 6.0)
    capsys.readouterr()
    other = text + "[pump]\nflow_full_um_per_s = 9.0\n"
    assert saved(path, str(session), "--yes", text=other) == Exit.BAD_INPUT
    assert "has another [pump] than the session began with" in capsys.readouterr().err
    assert path.read_text() == other


def kept_time_constant(logs: Path, name: str = "outer", what: What = "kept") -> Path:
    """A session that tried a time constant of the shape loop and measured nothing else."""
    session = plain.create_session(logs, name, "eve", "a-run", Config(), BEFORE)
    append_entry(
        logs, make_entry(what, session.path.name, "eve", "why", BEFORE, BEFORE, None, (40.0, 62.5))
    )
    return session.path


@pytest.mark.parametrize("named", [False, True])
def test_the_time_constant_of_the_shape_loop_is_saved_without_gains(
    tmp_path: Path, named: bool
) -> None:
    session, path = kept_time_constant(tmp_path / "logs"), tmp_path / "lab.toml"
    assert saved(path, "--yes", *([str(session)] if named else [])) == Exit.DONE
    wanted = tomllib.loads(TEXT)
    assert tomllib.loads(path.read_text()) == wanted | {
        "shape": wanted["shape"] | {"time_constant_s": 62.5}
    }


def test_gains_and_time_constant_of_two_sessions_are_saved_at_once_and_a_named_one_alone(
    tmp_path: Path,
) -> None:
    gains, path = kept_session(tmp_path / "logs"), tmp_path / "lab.toml"
    kept_time_constant(tmp_path / "logs")
    assert saved(path, "--yes") == Exit.DONE
    found = load_toml(path, Config)
    assert (found.loop.kp_per_s, found.shape.time_constant_s) == (0.448, 62.5)
    assert saved(path, str(gains), "--yes") == Exit.DONE
    assert load_toml(path, Config).shape.time_constant_s == Config().shape.time_constant_s


def test_a_time_constant_that_was_not_kept_or_rolled_back_is_not_saved(tmp_path: Path) -> None:
    logs, path = tmp_path / "logs", tmp_path / "lab.toml"
    session = kept_time_constant(logs, what="taken_back")
    assert saved(path, str(session), "--yes") == saved(path, "--yes") == Exit.BAD_INPUT
    session = kept_time_constant(logs, "second")
    append_entry(
        logs,
        make_entry("rolled_back", session.name, "eve", "why", BEFORE, BEFORE, None, (40.0, 62.5)),
    )
    assert saved(path, "--yes") == Exit.BAD_INPUT
    assert path.read_text() == TEXT


def test_a_curve_is_not_saved_over_that_of_another_pump(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session, path = mapped_session(tmp_path, TEXT), tmp_path / "lab.toml"
    assert (
        saved(path, str(session), "--yes", text=TEXT + "[pump]\nflow_full_um_per_s = 9.0\n")
        == Exit.BAD_INPUT
    )
    assert "pump.flow_full_um_per_s" in capsys.readouterr().err


@pytest.mark.parametrize("value", ["auto", "laser"])
def test_a_hold_that_decides_by_itself_is_given_gains_and_pump_in_one_session(
    value: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    estimator = {"estimator": {"process_value": value}}
    hold = Config.model_validate(tomllib.loads(TEXT) | estimator)
    kept_session(tmp_path / "logs", config=hold)
    monkeypatch.setattr("tuning.commands.save.SessionFolder.is_done", lambda self, step: True)
    monkeypatch.setattr("tuning.commands.save.map_pump.has_pump_map", lambda folder: False)
    monkeypatch.setattr(
        "tuning.estimator_levels.derive_estimator_levels", lambda folder: {"pump_delay_s": 1.1}
    )
    path = tmp_path / "lab.toml"
    assert saved(path, "--yes") == Exit.DONE
    now = load_toml(path, Config)
    assert now.loop.kp_per_s == AFTER.kp_per_s
    assert now.estimator.pump_delay_s == (1.1 if value == "auto" else 0.08)


def test_a_session_designs_gains_wherever_a_pi_may_hold_the_mirror() -> None:
    values = ("auto", "laser", "estimate", "optics")
    configs = [Config.model_validate({"estimator": {"process_value": value}}) for value in values]
    assert [config.has_pi for config in configs] == [True, True, False, False]


def test_any_reason_stays_in_its_cell_of_the_history(tmp_path: Path) -> None:
    entry = make_entry("kept", "one", "a|b", "less | noise\nand drift", BEFORE, AFTER)
    append_entry(tmp_path, entry)
    rows = format_history(read_entries(tmp_path)).splitlines()
    assert len(rows) == 3
    assert r"a\|b" in rows[2]
    assert rows[2].endswith(r"| less \| noise and drift |")
    columns = [row.replace(r"\|", "").count("|") for row in rows]
    assert len(set(columns)) == 1
