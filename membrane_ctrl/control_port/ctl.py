"""`ctl`: one request to a running hold, and its answer."""

import json
import sys
import time
import tomllib
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from membrane_ctrl.config.control import KEYS_BESIDE_GAINS
from membrane_ctrl.config.fleet import FleetConfig
from membrane_ctrl.config.port import SOCKET_NAME
from membrane_ctrl.config.toml_file import load_toml, read_toml
from membrane_ctrl.control_port.client import ANSWER_S, PortClient
from membrane_ctrl.control_port.commander import CommandSession
from membrane_ctrl.control_port.service_client import ServiceAddress, ServiceClient, read_token
from membrane_ctrl.control_port.status_lines import alarm_lines
from membrane_ctrl.model import errors, files, plain_json, run_status, terminal
from membrane_ctrl.model.columns import COLUMNS, PUBLISHED
from membrane_ctrl.model.held_words import describe_held

_LABEL_WIDTH = 18
_WATCHED = ("mono_s", "error_um", "pump_fraction")

_FLEET_S = 10.0  # for all holds of a fleet, which are asked at once


@dataclass(frozen=True, slots=True)
class Where:
    """The target hold, and the identity to use."""

    socket: Path | None = None
    run: Path | None = None
    logs: Path = Path("logs")
    service: ServiceAddress | None = None  # the hold is behind this service


def ctl(request: dict[str, Any], where: Where, as_json: bool) -> int:
    """Send a request to a running hold and print its answer.

    Parameters
    ----------
    request : dict of Any
        With its name as `do`.
    where : Where
        Of the hold.
    as_json : bool
        Print the answer as JSON.

    Returns
    -------
    int
        The exit code.

    Raises
    ------
    InputError
        The hold refuses the request.
    DeviceError
        No answer.
    """
    if where.service is not None:
        return _ask_service(request, where.service, as_json)
    action = request["do"]
    with connected(where) as client:
        answer = client.ask(**request)
        if not answer.get("ok"):
            if as_json:
                print(json.dumps(answer))
            raise errors.InputError(f"refused: {answer.get('refused')}")
        if action == "watch":
            return _watch(client, answer["status"], request["period_s"], as_json)
        if action == "status" and not as_json:
            print("\n".join(status_lines(answer["status"])))
            return errors.Exit.DONE
    return _print_answer(action, answer, as_json)


def _print_answer(action: str, answer: dict[str, Any], as_json: bool) -> int:
    """Print what the hold answered to a command that it obeyed."""
    if as_json:
        print(json.dumps(answer))
    else:
        state = ""
        if "state" in answer:
            state = f"; the state was {answer['state']}"
        lock = f": word {answer['lock']['word']}" if "lock" in answer else ""
        print(f"{action}: done{lock}{state}", file=sys.stderr)
    if answer.get("problem"):
        print(f"{action}: NOT STORED, valid in this run only: {answer['problem']}", file=sys.stderr)
        return errors.Exit.DEVICE_FAILED
    return errors.Exit.DONE


def _ask_service(request: dict[str, Any], address: ServiceAddress, as_json: bool) -> int:
    """Send a request to a hold behind a service. Raises as `ctl`."""
    client, action = ServiceClient(address), request["do"]
    if action == "watch":
        while (state := client.read_state()).in_contact:
            _print_watched(state.status, as_json)
            time.sleep(request["period_s"])
        print("the run is over", file=sys.stderr)
        return errors.Exit.DONE
    if action != "status":
        answer = client.send_command(request)
        if not answer["ok"]:
            raise errors.InputError(f"refused: {answer.get('refused')}")
        return _print_answer(action, answer, as_json)
    state = client.read_state()
    if as_json:
        print(state.model_dump_json())
    elif state.in_contact:
        print("\n".join(status_lines(state.status)))
    else:
        lines = [state.reason] if state.ended is None else state.ended.lines
        print("\n".join(terminal.one_line(line) for line in lines))
    if state.in_contact:
        return errors.Exit.DONE
    return errors.Exit.DEVICE_FAILED


def fleet(file: Path) -> dict[str, Where]:
    """The holds of a fleet file by name; file names are relative to its folder.
    Raises InputError.
    """

    def beside(name: str | None) -> Path | None:
        if name is None:
            return None
        return file.resolve().parent / Path(name).expanduser()

    found = {}
    for hold in load_toml(file, FleetConfig).holds:
        socket = beside(hold.socket)
        if socket is not None:
            found[hold.name] = Where(socket, logs=socket.parent)
            continue
        token = read_token(beside(hold.token_file))
        address = ServiceAddress(hold.url, token, beside(hold.authority_file), hold.hold)
        ServiceClient(address)  # an address that cannot be is named before anything is asked
        found[hold.name] = Where(service=address)
    return found


def fleet_status(file: Path, as_json: bool) -> int:
    """Ask all holds of a fleet file at once, and print a line of each.

    Parameters
    ----------
    file : Path
        The fleet file.
    as_json : bool
        Print one JSON object instead: the status of each hold by its name, or its `problem`.

    Returns
    -------
    int
        `Exit.DEVICE_FAILED` if one does not answer in time, else `Exit.DONE`.

    Raises
    ------
    InputError
        The file is wrong.
    """
    places = fleet(file)
    with ThreadPoolExecutor(len(places)) as pool:
        answers = dict(zip(places, pool.map(_status_of, places.values()), strict=True))
    if as_json:
        print(json.dumps(answers))
    else:
        width = max(map(len, places))
        for name, status in answers.items():
            print(terminal.one_line(f"{name:{width}}  {fleet_line(status)}"))
    silent = any("problem" in status for status in answers.values())
    if silent:
        return errors.Exit.DEVICE_FAILED
    return errors.Exit.DONE


def _status_of(where: Where) -> dict[str, Any]:
    try:
        if where.service is not None:
            return _status_of_service(where.service)
        with connected(where, notice=lambda _: None, answer_s=_FLEET_S / 2) as client:
            client.patience(_FLEET_S / 2)
            answer = client.ask(do="status")
    except errors.CommandError as error:
        return {"problem": "; ".join(error.lines)}
    except Exception as error:  # whatever one hold causes, the others are listed
        return {"problem": f"{type(error).__name__}: {error}"}
    if answer.get("ok"):
        return dict(answer["status"])
    return {"problem": str(answer.get("refused"))}


def _status_of_service(address: ServiceAddress) -> dict[str, Any]:
    state = ServiceClient(address, _FLEET_S / 2).read_state()
    if state.in_contact:
        return state.status
    return {"problem": state.reason}


def fleet_line(status: dict[str, Any]) -> str:
    """A hold's status in one line: state, error, and what is wrong or why it is as it is."""
    if "problem" in status:
        return f"{'no contact':10}{'':14}{status['problem']}"
    reasons = alarm_lines(status)
    if not reasons:
        reasons = [str(status.get("why") or "as it should be")]
    row = status.get("row") or {}
    column = COLUMNS["error_um"]
    error = column.format_value(row.get(column.name))
    return f"{status['state']:10}{error:>10} {column.unit} {'; '.join(reasons)}"


def status_lines(status: dict[str, Any]) -> list[str]:
    """Format the status for people."""
    row = status.get("row") or {}
    lines = [f"{status.get('run', '?')}: {status['state']} - {status['why'] or 'as it should be'}"]
    lines += alarm_lines(status)
    if row:
        lines += [
            (
                f"  {each.label:{_LABEL_WIDTH}}{each.format_value(row.get(each.name)):>10} "
                f"{each.unit}"
            ).rstrip()
            for each in PUBLISHED
        ]
        if gains := status.get("gains"):
            lines.append(
                "  "
                f"{'gains':{_LABEL_WIDTH}}{run_status.gains_words(gains, status.get('trial_left_s'))}"  # noqa: E501
            )
        shape = f"{status.get('shape') or '?'} {status.get('shape_reason', '')}"
        lines.append(f"  {'shape loop':{_LABEL_WIDTH}}{shape}".rstrip())
        if held := describe_held(status.get("held"), row):
            lines.append(f"  {'held':{_LABEL_WIDTH}}{held}")
        lines.append(f"  {'geometry':{_LABEL_WIDTH}}{_describe_geometry(status.get('geometry'))}")
    lines.append(f"  {'commander':{_LABEL_WIDTH}}{_name_commander(status)}")
    return lines


def _name_commander(status: dict[str, Any]) -> str:
    session = status.get("command_session")
    if session is None:
        return str(status.get("commander") or "nobody")
    known = {key: session.get(key) for key in ("id", "who", "what", "pid", "since_utc")}
    return CommandSession(**known).describe()


def _describe_geometry(geometry: dict[str, Any] | None) -> str:
    if geometry is None:
        return "not in use yet"
    if geometry.get("message"):
        return str(geometry["message"])
    made = "as configured"
    if geometry.get("file"):
        made = f"{geometry['file']}, calibrated {geometry.get('calibrated_utc')}"
    return f"{made} (hash {geometry.get('hash')})"


def _watch(client: PortClient, first: dict[str, Any], period_s: float, as_json: bool) -> int:
    client.patience(period_s + 10.0)
    _print_watched(first, as_json)
    for streamed in client.messages():
        if "status" in streamed:
            _print_watched(streamed["status"], as_json)
    print("the run is over", file=sys.stderr)
    return errors.Exit.DONE


def _print_watched(status: dict[str, Any], as_json: bool) -> None:
    if as_json:
        print(json.dumps(status), flush=True)
        return
    row = status.get("row") or {}
    shown = "  ".join(_format_quantity(row, name) for name in _WATCHED)
    print(f"{status['state']:8} {shown}  {status['why']}", flush=True)


def _format_quantity(row: Mapping[str, Any], name: str) -> str:
    """A value of a row with its label and unit, in a width that stays
    the same from line to line.
    """
    column = COLUMNS[name]
    return f"{column.label} {column.format_value(row.get(name)):>9} {column.unit}".rstrip()


def loop_keys(argument: str) -> dict[str, Any]:
    """Loop keys, or their [loop] table, of a TOML or JSON file or of the text itself. Raises
    InputError.
    """
    path = Path(argument)
    if path.suffix == ".json":
        try:
            tables = plain_json.loads(files.read_text(path, follow=True))
        except (OSError, ValueError) as error:
            raise errors.InputError(f"{path}: {error}") from None
    elif path.suffix == ".toml":
        tables = read_toml(path)
    else:
        try:
            tables = tomllib.loads(argument)
        except tomllib.TOMLDecodeError as error:
            raise errors.InputError(
                f"ctl gains: give a .toml or .json file, or loop keys: {error}"
            ) from None
    # A whole configuration, or `gains.toml` of a session: its table of the loop
    if isinstance(tables, dict) and isinstance(tables.get("loop"), dict):
        tables = tables["loop"]
    for key in KEYS_BESIDE_GAINS[1:]:
        if isinstance(tables, dict) and key in tables:
            raise errors.InputError(f"{argument}: {key}: stays for a run; remove it")
    if not isinstance(tables, dict) or not all(
        isinstance(value, (bool, int, float)) for value in tables.values()
    ):
        raise errors.InputError(f"{argument}: expected a table of loop keys with numbers")
    return tables


def _print_notice(text: str) -> None:
    print(f"notice: {text}", file=sys.stderr)


def connected(
    where: Where, notice: Callable[[str], None] = _print_notice, answer_s: float = ANSWER_S
) -> PortClient:
    """Connect to the hold that a place names.

    Parameters
    ----------
    where : Where
        The place.
    notice : callable
        Receives the unsolicited notices of the hold.
    answer_s : float
        Longest time for connection and greeting.

    Returns
    -------
    PortClient

    Raises
    ------
    InputError
        Another run is there.
    DeviceError
        No hold answers.
    """
    path = socket_path(where)
    if where.socket is None and where.run is None and not path.exists():
        raise errors.DeviceError(
            f"{path}: no hold is listening; name its run with --run or --socket"
        )
    client = PortClient.unix(path, notice, answer_s)
    if where.run is not None and client.greeting["run"] != where.run.resolve().name:
        client.close()
        raise errors.InputError(f"{where.run}: is not running; {client.greeting['run']} is")
    return client


def socket_path(where: Where) -> Path:
    """The socket file: as given, of the run's own configuration, beside the run's folder, or among
    the runs.
    """
    if where.socket is not None:
        return where.socket
    if where.run is None:
        return where.logs / SOCKET_NAME
    configured = read_toml(where.run / "config.toml").get("port", {}).get("socket")
    if configured:
        return Path(configured)
    return where.run.resolve().parent / SOCKET_NAME
