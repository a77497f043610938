"""`devices new`, and drivers of other packages: what is written works at once, and only what is
installed is run.
"""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from pathlib import Path

import pytest
from patience import patient_check

from firmware_iface import drivers, role_bench, roles
from membrane_ctrl.cli import run
from membrane_ctrl.config.schema import Config
from membrane_ctrl.config.toml_file import dump_toml, load_toml
from membrane_ctrl.instruments import role_drivers
from membrane_ctrl.model.errors import InputError
from membrane_ctrl.sim.lab import Lab
from tests.worlds.still_plant import StillPlant

ROOT = Path(__file__).parents[2]
TEMPLATES = ROOT / "membrane_ctrl" / "commissioning" / "scaffold"


def tool(*words: object, cwd: Path, path: str = "") -> str:
    """The output of a program that succeeds."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, (path, str(ROOT))))}
    done = subprocess.run(
        [str(word) for word in words],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def written(folder: Path, name: str, role: str = "gauge_pressure") -> Path:
    assert run(["devices", "new", name, "--role", role, "--to", str(folder)]) == 0
    return folder / f"{name.replace('_', '-')}-driver"


def install(site: Path, package: str, **entries: str) -> None:
    """What pip leaves of a package: its metadata. `entries`: entry points by group, drivers or
    emulators.
    """
    info = site / f"{package}-0.1.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 0.1\n")
    groups = [f"[membrane_ctrl.{group}]\n{line}\n" for group, line in entries.items()]
    (info / "entry_points.txt").write_text("".join(groups))


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of installed packages; the modules that a test loads from it are forgotten again."""
    folder = tmp_path / "site"
    folder.mkdir()
    before = set(sys.modules)
    monkeypatch.syspath_prepend(folder)
    yield folder
    for name in set(sys.modules) - before:
        if str(getattr(sys.modules[name], "__file__", "")).startswith(str(tmp_path)):
            del sys.modules[name]


@pytest.fixture
def gauge(site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a written driver, `acme_gauge`, which is installed as by pip's --editable."""
    made = written(tmp_path, "acme_gauge")
    monkeypatch.syspath_prepend(made)
    install(
        site,
        "acme-gauge",
        drivers="acme_gauge = acme_gauge:AcmeGauge",
        emulators="acme_gauge = acme_gauge_emulator:AcmeGaugeEmulator",
    )
    return made


@pytest.mark.campaign  # runs pytest and the linter; CI runs it
def test_what_is_written_passes_its_own_tests_and_the_linter(tmp_path: Path) -> None:
    """For each kind of role, and for names whose lines are short and long."""
    names = {"displacement": "an_instrument_of_a_longer_name", "barometer": "b2", "vent": "v"}
    names |= {"camera": "a_photographic_device_of_thirt", "screen": "s"}
    made = [written(tmp_path, name, role) for role, name in names.items()]
    tool(sys.executable, "-m", "ruff", "check", *made, cwd=tmp_path)
    tool(sys.executable, "-m", "ruff", "format", "--check", *made, cwd=tmp_path)
    where = os.pathsep.join(map(str, made))
    config = [
        "-p",
        "no:cacheprovider",
        "-q",
        "-c",
        made[0] / "pyproject.toml",
        "--rootdir",
        tmp_path,
    ]
    printed_text = tool(sys.executable, "-m", "pytest", *config, *made, cwd=tmp_path, path=where)
    assert "62 passed" in printed_text


async def test_check_reads_an_installed_driver_through_its_emulator(
    gauge: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = load_toml(gauge / "lab.toml", Config)
    assert config.devices is not None
    lab = Lab(StillPlant(), config.devices)
    try:
        path = tmp_path / "moved.toml"
        path.write_text(dump_toml(config.model_copy(update={"devices": await lab.start()})))
        with patient_check(5.0):
            code = await asyncio.to_thread(run, ["check", str(path), "--json"])
    finally:
        await lab.stop()
    printed = capsys.readouterr()
    assert code == 0, printed.err
    (probe,) = (
        each for each in json.loads(printed.out)["devices"] if each["role"] == "gauge_pressure"
    )
    assert (probe["identity"], probe["reading"]) == ("Acme Gauge A0001 1.0", "600 Pa")


def test_devices_and_config_list_an_installed_driver(
    gauge: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("membrane_ctrl.commissioning.devices.find_cameras", lambda: ([], []))
    assert run(["devices", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)["devices"]
    (driver,) = (each for each in listed if each["kind"] == "driver")
    assert driver["name"] == "acme_gauge, of acme-gauge 0.1"
    assert driver["paste"] == 'driver = "external"\nname = "acme_gauge"'
    assert "acme_gauge" not in sys.modules  # listed from its metadata
    assert run(["config", "explain", "acme_gauge"]) == 0
    output = capsys.readouterr().out
    assert '[devices.gauge_pressure] driver = "external"' in output
    assert "offset_mbar: -10000 .. 10000; default 0.0" in output
    assert "Reading without pressure" in output


def configured(**keys: object) -> Config:
    """A configuration whose gauge is `acme_gauge`, with these keys as well."""
    modbus = {
        "driver": "modbus_map",
        "link": "tcp://h",
        "address": 0,
        "raw": [0.0, 1.0],
        "value": [0.0, 1.0],
    }
    gauge = {"driver": "external", "name": "acme_gauge", "port": "/dev/ttyX", **keys}
    pump = {**modbus, "address": 1}
    return Config.model_validate(
        {"devices": {"displacement": modbus, "pump": pump, "gauge_pressure": gauge}}
    )


def refusal(**keys: object) -> str:
    """Why the devices cannot be made."""
    devices = configured(**keys).devices
    assert devices is not None
    with pytest.raises(InputError) as caught:
        role_drivers.make_role_devices(devices)
    (line,) = caught.value.lines
    assert "\n" not in line
    assert line.startswith("devices.gauge_pressure")
    return line


def test_a_configuration_runs_nothing(
    gauge: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run folder of a stranger, or of a machine with other drivers,
    is read without the driver.
    """
    path = tmp_path / "config.toml"
    path.write_text(dump_toml(configured(baud=9600, of_its_own={"deep": [1, 2]})))
    read = load_toml(path, Config)
    assert read == configured(baud=9600, of_its_own={"deep": [1, 2]})
    assert "acme_gauge" not in sys.modules
    lying = tmp_path / "lying"
    lying.mkdir()
    (lying / "other_gauge.py").write_text("raise SystemExit('a file lying around was run')\n")
    monkeypatch.chdir(lying)
    assert "no driver 'other_gauge' is installed; installed: acme_gauge" in refusal(
        name="other_gauge"
    )


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"baut": 9600}, "devices.gauge_pressure: baut: unknown key; did you mean baud?"),
        ({"baud": 12}, "baud: input should be greater than or equal to 300 (it is 12)"),
        ({"serial": 5}, "serial: input should be a valid string"),
        ({"port": "ttyUSB0"}, "expected a path"),
    ],
    ids=lambda value: str(value)[:20],
)
def test_a_wrong_key_of_its_own_is_one_line(
    gauge: Path, keys: dict[str, object], words: str
) -> None:
    assert words in refusal(**keys)


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("import not_there", "does not load: ModuleNotFoundError: No module named 'not_there'"),
        ("x =", "does not load: SyntaxError"),
        ("", "does not load: AttributeError"),
        ("class AcmeGauge: pass", "has no class Settings"),
        (
            "from firmware_iface.settings import VentusConfig\n"
            "class AcmeGauge:\n Settings = VentusConfig\n def __init__(self, config): raise "
            "RuntimeError('bang')",
            "cannot be made: RuntimeError: bang",
        ),
        (
            "from firmware_iface.settings import VentusConfig\n"
            "class AcmeGauge:\n Settings = VentusConfig\n def __init__(self, config): pass",
            "has no gauge_pressure_pa, so it is no gauge_pressure",
        ),
    ],
    ids=["import", "syntax", "absent", "settings", "constructor", "role"],
)
def test_a_faulty_driver_is_one_line(site: Path, source: str, words: str) -> None:
    (site / "acme_gauge.py").write_text(source)
    install(site, "acme-gauge", drivers="acme_gauge = acme_gauge:AcmeGauge")
    assert words in refusal()


def test_two_packages_of_one_name_are_refused(gauge: Path, site: Path) -> None:
    install(site, "other-gauge", drivers="acme_gauge = other:Gauge")
    assert "acme-gauge and other-gauge both install a driver 'acme_gauge'" in refusal()


def test_hold_refuses_a_driver_without_an_emulator_to_emulate_it(
    site: Path, gauge: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (site / "acme_gauge-0.1.dist-info").mkdir(exist_ok=True)
    (site / "acme-gauge-0.1.dist-info" / "entry_points.txt").write_text(
        "[membrane_ctrl.drivers]\nacme_gauge = acme_gauge:AcmeGauge\n"
    )
    assert drivers.load_driver("acme_gauge", drivers.INSTRUMENTS).__name__ == "AcmeGauge"
    with pytest.raises(InputError, match="no emulator 'acme_gauge' is installed; installed: none"):
        Lab(StillPlant(), configured().devices)  # type: ignore[arg-type]
    wrong = tmp_path / "wrong.toml"
    wrong.write_text((gauge / "lab.toml").read_text() + "baut = 9600\n")
    assert run(["hold", "--twin", "--devices", str(wrong), "--logs", str(tmp_path / "logs")]) == 2
    (*_, line) = capsys.readouterr().err.splitlines()
    assert "baut: unknown key" in line
    assert not (tmp_path / "logs").exists()


class Clumsy:
    """A driver with a mistake in every method."""

    async def open(self) -> roles.DeviceIdentity:
        raise RuntimeError("open")

    async def close(self) -> None:
        raise RuntimeError("close")


class Closing(Clumsy):
    """A device that counts how often it was closed."""

    closed = 0

    async def close(self) -> None:
        Closing.closed += 1


async def test_a_driver_that_fails_to_close_leaves_the_others_closed() -> None:
    devices = role_bench.RoleDevices(Closing(), Clumsy(), Clumsy(), Closing())  # type: ignore[arg-type]
    made = role_bench.RoleBench(devices)
    with pytest.raises(roles.LinkError, match="displacement: RuntimeError: open"):
        await made.open()
    assert Closing.closed == 2


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["Acme"], "not a name"),
        (["acme-gauge"], "not a name"),
        (["../acme"], "not a name"),
        (["a" * 31], "not a name"),
        (["class"], "taken"),
        (["ventus"], "taken"),
        (["aravis"], "taken"),
        (["numpy"], "taken"),
        (["acme", "--role", "gauge"], "did you mean gauge_pressure?"),
    ],
    ids=str,
)
def test_a_bad_name_or_role_is_one_line(
    words: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["devices", "new", *words, "--to", str(tmp_path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = written(tmp_path, "acme_gauge")
    before = {path.name: path.read_text() for path in folder.iterdir()}
    assert run(["devices", "new", "acme_gauge", "--role", "pump", "--to", str(tmp_path)]) == 2
    assert "exists already" in capsys.readouterr().err
    assert {path.name: path.read_text() for path in folder.iterdir()} == before


@pytest.mark.campaign
@pytest.mark.parametrize(
    "role", ["displacement", "gauge_pressure", "pump", "thermometer", "camera", "screen"]
)
def test_a_newcomer_installs_types_and_holds(role: str, tmp_path: Path) -> None:
    """docs/how-to/new-device.md, in an environment and a folder of its own."""
    tool(sys.executable, "-m", "venv", "--without-pip", tmp_path / "venv", cwd=tmp_path)
    python = tmp_path / "venv" / "bin" / "python"
    (packages,) = (tmp_path / "venv").glob("lib/*/site-packages")
    (packages / "dependencies.pth").write_text(f"{ROOT}\n{sysconfig.get_path('purelib')}\n")
    folder = written(tmp_path, "acme_thing", role)
    words = [
        "pip",
        "--python",
        python,
        "install",
        "--no-deps",
        "--no-build-isolation",
        "--editable",
        folder,
    ]
    tool(sys.executable, "-m", *words, cwd=tmp_path)
    tool(python, "-m", "pytest", "-q", "-p", "no:cacheprovider", cwd=folder)
    tool(python, "-m", "mypy", "--cache-dir", tmp_path / "types", ".", cwd=folder)
    holding = ["hold", "--twin", "--devices", folder / "lab.toml", "--duration", "30s", "--json"]
    summary = json.loads(tool(python, "-m", "membrane_ctrl", *holding, cwd=tmp_path))
    assert "hold" in [state["state"] for state in summary["states"]]
    assert summary["true_std_um"] < 2.0
