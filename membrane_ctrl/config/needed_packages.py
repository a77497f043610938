"""Packages of Python that a configuration needs beyond those of every installation."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model.optional import describe_missing, is_installed


@dataclass(frozen=True, slots=True)
class NeededPackage:
    """A package that a table needs.

    Attributes
    ----------
    table : str
        Of the configuration, such as `bridges.mqtt`.
    package : str
        As it is imported.
    extra : str
        The extra of this program that installs it.
    """

    table: str
    package: str
    extra: str

    @property
    def missing_line(self) -> str:
        """What is missing, and how to install it."""
        return describe_missing(f"[{self.table}]", self.package, self.extra)


def list_needed_packages(config: Config) -> Iterator[NeededPackage]:
    """The packages of the bridges.

    Drivers and alarms name theirs where they are made (`GpioLine`, `require_sendable`).
    """
    bridges = {"mqtt": "aiomqtt", "opcua": "asyncua", "epics": "softioc"}
    for bridge, package in bridges.items():
        if getattr(config.bridges, bridge) is not None:
            yield NeededPackage(f"bridges.{bridge}", package, bridge)


def list_missing_packages(config: Config) -> list[NeededPackage]:
    """Those that are not installed."""
    return [each for each in list_needed_packages(config) if not is_installed(each.package)]
