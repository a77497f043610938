"""A virtual run of the twin with its record, as supervisor and recorder would have written it."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path

import numpy as np

from firmware_iface.roles import BenchReading
from membrane_ctrl.config import toml_file as config_file
from membrane_ctrl.config.schema import Config, TwinConfig
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.controller import Controller
from membrane_ctrl.controller.snapshot import take_snapshot
from membrane_ctrl.controller.tick import TickInputs, TickOutputs
from membrane_ctrl.controller.tick_assembler import TickAssembler, TickBatch
from membrane_ctrl.controller.tick_codec import pack_snapshot, pack_tick
from membrane_ctrl.hold.virtual_run import Alter, ShapeSource, VirtualRun, VirtualTick
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.run_files.run_tables import RunTables
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.virtual_bench import VirtualBench
from tests.worlds.recorded_hold import ring_trip
from tests.worlds.synthetic_shape import shape_at

CONFIG = Config(twin=TwinConfig(laser_noise_um=0.5))


def run_virtual(
    config: Config,
    plant: Plant,
    duration_s: float,
    sag_sensitivity: FloatArray,
    shape: ShapeSource | None = None,
    alter: Alter | None = None,
) -> Iterator[VirtualTick]:
    """Hold the twin for `duration_s` of its time, as fast as it goes.

    Parameters
    ----------
    config, sag_sensitivity, shape, alter
        See `VirtualRun`.
    plant : Plant
        The twin's physics.
    duration_s : float
        When the hold is asked to stop.

    Yields
    ------
    VirtualTick
        Until the controller says that the run is over.
    """
    run = VirtualRun(config, VirtualBench(plant), sag_sensitivity, shape, alter)
    commands: tuple[Command, ...] = (Command("hold", "virtual run"),)
    stop_at_s = duration_s
    while run.finished is None:
        if run.now_s + 1.0 / config.loop.rate_hz >= stop_at_s:
            commands, stop_at_s = (*commands, Command("stop", "duration")), float("inf")
        tick = run.run_tick(commands)
        commands = ()
        if tick is not None:
            yield tick


@cache  # several modules look at the same holds
def kept_ticks(
    duration_s: float, alter: Alter | None = None
) -> list[tuple[TickInputs, TickOutputs]]:
    """Inputs and outputs of every tick of a hold of the twin."""

    def shape(now_s: float) -> ShapeEstimate | None:
        estimate = shape_at(now_s)
        return None if estimate is None else ring_trip(estimate)

    run = run_virtual(
        CONFIG, Plant(CONFIG.twin, CONFIG.pump), duration_s, zernike_projection(), shape, alter
    )
    return [(tick.inputs, tick.outputs) for tick in run]


def snapshot_at(ticks: list[tuple[TickInputs, TickOutputs]], tick: int) -> bytes:
    """The snapshot of the run's controller before a tick."""
    controller = Controller(CONFIG, zernike_projection())
    for inputs, _ in ticks[: tick - 1]:
        controller.tick(inputs)
    return take_snapshot(controller)


Batch = tuple[TickBatch, list[ShapeEstimate]]


def batches_of(
    ticks: list[tuple[TickInputs, TickOutputs]],
    lost: range = range(0),
    snapshots: Mapping[int, bytes] | None = None,
) -> list[Batch]:
    """What the rings bring, a second at a time; ticks of `lost` are not in it."""
    assembler, batches = TickAssembler(), []
    assembler.add_snapshots([pack_snapshot(tick, data) for tick, data in (snapshots or {}).items()])
    for first in range(0, len(ticks), 50):
        messages: list[bytes] = []
        shapes = []
        for place, (inputs, outputs) in enumerate(ticks[first : first + 50], start=first + 1):
            if place not in lost:
                messages += pack_tick(place, inputs, outputs, outputs.row.pack())
            if inputs.estimate is not None:
                shapes.append(inputs.estimate)
        batches.append((assembler.add_messages(messages), shapes))
    return batches


def write_tables(folder: Path, batches: list[Batch], close: bool = True) -> None:
    """The tables of a run; without `close` as a killed recorder leaves them."""
    tables = RunTables(folder)
    for batch, shapes in batches:
        for estimate in shapes:
            tables.add_shape(estimate)
        tables.add_ticks(batch)
        tables.sync_tables()
    if close:
        tables.close()


def write_record(
    folder: Path,
    ticks: list[tuple[TickInputs, TickOutputs]],
    lost: range = range(0),
    snapshots: Mapping[int, bytes] | None = None,
    close: bool = True,
) -> None:
    """The run's folder: configuration, tables, events; ticks of `lost` are not in it."""
    write_head(folder, ticks)
    write_tables(folder, batches_of(ticks, lost, snapshots), close)


def write_head(folder: Path, ticks: list[tuple[TickInputs, TickOutputs]]) -> None:
    """Configuration and events of a run."""
    (folder / "config.toml").write_text(config_file.dump_toml(CONFIG))
    lines = [
        json.dumps({"mono_s": inputs.now_s + 1e-4, **event.to_dict()})
        for inputs, outputs in ticks
        for event in outputs.events
    ]
    lines.append(json.dumps({"mono_s": ticks[-1][0].now_s + 1e-3, "kind": "end", "exit": "done"}))
    (folder / "events.jsonl").write_text("\n".join(lines) + "\n")


def laser_lost(now_s: float, reading: BenchReading) -> BenchReading:
    """The laser sees nothing for a second of the hold."""
    from dataclasses import replace

    return (
        replace(reading, displacement_um=np.nan, displacement_quality=1)
        if 14.3 <= now_s < 15.3
        else reading
    )
