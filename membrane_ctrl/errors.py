"""Errors that end a command with one line and an exit code (INTERFACES section 4)."""

from __future__ import annotations

from enum import IntEnum


class Exit(IntEnum):
    """Exit codes of every command."""

    DONE = 0
    BAD_INPUT = 2
    REJECTED = 3
    DEVICE_FAILED = 4
    SAFETY_TRIP = 5
    INTERRUPTED = 130


class CommandError(Exception):
    """Ends a command: the message is the one line that says what, where and what to do."""

    exit = Exit.BAD_INPUT


class InputError(CommandError):
    """Bad usage, configuration or input."""


class RejectedError(CommandError):
    """A measurement that must not be used."""

    exit = Exit.REJECTED


class DeviceError(CommandError):
    """A device, port, folder or disk that cannot be used."""

    exit = Exit.DEVICE_FAILED
