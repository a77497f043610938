"""Step 2: which devices fill which roles."""

from membrane_ctrl.commissioning.guide.device_questions import (
    ask_device_tables,
    derive_other_tables,
)
from membrane_ctrl.commissioning.guide.session_state import TomlTable
from membrane_ctrl.commissioning.guide.stage import StageContext, StageFailedError
from membrane_ctrl.controller.cross_check import cross_check
from membrane_ctrl.instruments import bench
from membrane_ctrl.model import errors


def ask_devices(context: StageContext) -> None:
    """Ask for the devices and write their tables."""
    section = ask_device_tables(context.dialogue, context.access.find_devices())
    _write_devices(context, section)
    _judge_configuration(context)


def _write_devices(context: StageContext, section: TomlTable) -> None:
    """Write the tables, with what follows from the absence of a device."""
    context.replace_table("devices", section)
    # what an earlier answer has set, and what follows from this one
    context.set_keys("loop", feedforward_barometer=True, feedforward_temperature=True)
    context.set_keys("shape", enabled="camera" in section)
    for table, keys in derive_other_tables(section).items():
        context.set_keys(table, **keys)


def _judge_configuration(context: StageContext) -> None:
    """Record what `check` finds in the configuration alone."""
    config = context.config
    if config.devices is not None:
        try:
            bench.require_separate_ports(config.devices)
        except errors.InputError as error:
            raise StageFailedError(str(error)) from None
    findings = cross_check(config)
    for finding in findings:
        context.require(
            finding.field,
            finding.severity == "warning",
            f"{finding.severity}: {finding.value}: {finding.why}",
            finding.remedy,
        )
    if not findings:
        context.require("configuration", True, "no finding")
