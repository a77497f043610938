"""Checks a configured camera and screen before anything starts: drivers installed, settings
accepted?

A package of a camera or screen is loaded by the acquisition process only. This check loads it in a
short-lived process as well, so that a package that hangs, ends its process or starts threads never
meets the control process.
"""

from multiprocessing.connection import Connection

from firmware_iface import drivers, settings
from membrane_ctrl.config.schema import DevicesConfig
from membrane_ctrl.instruments import driver_loading
from membrane_ctrl.model.errors import CommandError, InputError
from membrane_ctrl.processes import child, event_pipe

_LOADED_S = 60.0  # a large package on a busy machine
_NICE = 0
_PACKAGES = "devices.camera, devices.screen: the drivers' packages"


def require_optics(devices: DevicesConfig) -> None:
    """Refuse a camera or screen of another package that is missing, does not load or refuses its
    settings.

    Drivers of this program were checked with the configuration. Raises InputError with one line.
    """
    if not any(
        isinstance(table, settings.ExternalSection) for table in (devices.camera, devices.screen)
    ):
        return

    # The packages load in a process of their own, which they may end.
    ours, theirs = event_pipe.make_pipe()
    loading = child.Child("driver check", f"{__name__}:report_problem", (devices, theirs), _NICE)
    loading.start()
    theirs.close()
    try:
        problem = (
            str(ours.recv())
            if ours.poll(_LOADED_S)
            else f"{_PACKAGES} do not load within {_LOADED_S:g} s"
        )
    except (EOFError, OSError):
        loading.join(1.0)
        problem = f"{_PACKAGES} ended the process that loads them ({loading.exit_code})"
    finally:
        loading.stop(0.0)
        ours.close()
    if problem:
        raise InputError(problem)


def report_problem(devices: DevicesConfig, control: Connection) -> None:
    """Load the drivers of camera and screen and check their settings; target of a child process.

    Parameters
    ----------
    devices : DevicesConfig
        Tables `camera` and `screen`; one that is not configured is not checked.
    control : Connection
        Receives the text of the first problem, or an empty text.
    """
    tables = (
        (devices.camera, "devices.camera", drivers.CAMERAS),
        (devices.screen, "devices.screen", drivers.SCREENS),
    )
    problem = ""
    for table, where, kind in tables:
        try:
            if table is not None:
                driver_loading.check_settings(table, where, kind)
        except CommandError as error:
            problem = problem or str(error)
    control.send(problem)
