"""What some tests need of the machine: programs, libraries and drivers that pip does not install.

The table names each with the package of Debian that brings it. A test of which a need is missing is
skipped, and the reason names both. Python packages are in the extra `dev`, so that every test may
import them.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from firmware_iface.links.aravis import load_aravis
from firmware_iface.roles import LinkError

_PACKAGES = {
    "Xvfb": "xvfb",
    "aravis": "libaravis-0.8-0",
    "arm-none-eabi-gcc": "gcc-arm-none-eabi libnewlib-arm-none-eabi",
    "arv-camera-test-0.8": "aravis-tools",
    "cc": "gcc",
    "chromium": "chromium",
    "make": "make",
    "mbpoll": "mbpoll",
    "mosquitto": "mosquitto",
    "mosquitto_pub": "mosquitto-clients",
    "mosquitto_sub": "mosquitto-clients",
    "nginx": "nginx-light",
    "openssl": "openssl",
    "qemu-system-arm": "qemu-system-arm",
    "systemd-analyze": "systemd",
    "vulkan": "mesa-vulkan-drivers libvulkan1",
    "xauth": "xauth",
    "xdpyinfo": "x11-utils",
    "xhost": "x11-xserver-utils",
}
_OTHER_NAMES = {"chromium": ("google-chrome",)}
_SERVERS = "/usr/sbin"  # not in the PATH of most users
_VULKAN_DRIVERS = Path("/usr/share/vulkan/icd.d")


def find_program(name: str) -> str | None:
    """Path of a program, None if it is missing."""
    for each in (name, *_OTHER_NAMES.get(name, ())):
        found = shutil.which(each) or shutil.which(each, path=_SERVERS)
        if found is not None:
            return found
    return None


def program_path(name: str) -> str:
    """Path of a program; skips the test if it is missing."""
    require(name)
    path = find_program(name)
    assert path is not None
    return path


def missing(*needs: str) -> str:
    """Name what is missing, and how it is installed; empty if nothing is.

    Parameters
    ----------
    needs : str
        Keys of the table: programs, "vulkan" (a driver) or "aravis" (the library).
    """
    lacks = [need for need in needs if not _is_there(need)]
    if not lacks:
        return ""
    packages = dict.fromkeys(_PACKAGES[need] for need in lacks)
    return f"no {', '.join(lacks)}: apt-get install {' '.join(packages)}"


def needs(*names: str) -> pytest.MarkDecorator:
    """Mark a test, or a module, that is skipped where one of these is missing."""
    reason = missing(*names)
    return pytest.mark.skipif(bool(reason), reason=reason)


def require(*names: str) -> None:
    """Skip the test that calls this, itself or in a fixture, where one of these is missing."""
    if reason := missing(*names):
        pytest.skip(reason)


def _is_there(need: str) -> bool:
    match need:
        case "vulkan":
            return any(_VULKAN_DRIVERS.glob("*.json"))
        case "aravis":
            return _aravis_is_there()
        case _:
            return find_program(need) is not None


def _aravis_is_there() -> bool:
    try:
        load_aravis()
    except LinkError:
        return False
    return True
