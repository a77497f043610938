"""Decides at the start of a hold whether figures are tracked or measured in cycles (`shape.mode`).

The decision becomes part of the run's configuration: a tick, and its replay, see only the result.
"""

import math
import os
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model.run_events import FigureModeChosen

# Fewer figures a second hold the mirror no better than cycles do.
_RATE_LEAST_HZ = 5.0
# The hold itself, its recorder and the pauses of a busy machine need the rest of a processor.
_PROCESSOR_SHARE = 0.5
_PROCESSORS_LEAST = 2
# A tracked figure of 2448 x 2048 pixels takes 10 ms of a processor that squares and adds as many
# numbers in 2.2 ms (docs/measurements/tracking.md).
_FIGURE_PASSES = 4.5
_REPEATS = 9


@dataclass(frozen=True, slots=True)
class Machine:
    """What a machine offers.

    Attributes
    ----------
    processors : int
        That this process may use.
    figure_s : float
        Time of a tracked figure, estimated from a calculation with as many pixels.
    """

    processors: int
    figure_s: float


def measure_machine(pixels: int) -> Machine:
    """Measure the machine beside whatever else runs on it: some 0.1 s.

    Parameters
    ----------
    pixels : int
        Of a camera frame.
    """
    frame = np.linspace(0.0, 1.0, pixels, dtype=np.float32)
    times_s = []
    for _ in range(_REPEATS):
        begun_s = time.perf_counter()
        float((frame * frame).sum())
        times_s.append(time.perf_counter() - begun_s)
    return Machine(len(os.sched_getaffinity(0)), _FIGURE_PASSES * statistics.median(times_s))


def choose_figure_mode(
    config: Config, measure: Callable[[int], Machine] = measure_machine
) -> tuple[Config, FigureModeChosen | None]:
    """Replace `shape.mode = "auto"` by what camera and machine allow.

    Parameters
    ----------
    config : Config
    measure : callable
        Returns the machine for a number of pixels.

    Returns
    -------
    Config
        With `cycle` or `track`.
    FigureModeChosen or None
        The decision; None if the mode was stated.
    """
    if config.shape.mode != "auto":
        return config, None
    mode, reason, machine = _judge_mode(config, measure)
    chosen = FigureModeChosen(
        mode=mode,
        reason=reason,
        processors=machine.processors,
        figure_ms=round(1e3 * machine.figure_s, 2),
    )
    shape = config.shape.model_copy(update={"mode": mode})
    return config.model_copy(update={"shape": shape}), chosen


def _judge_mode(
    config: Config, measure: Callable[[int], Machine]
) -> tuple[Literal["cycle", "track"], str, Machine]:
    camera = config.optics.camera
    machine = measure(camera.width_px * camera.height_px)

    # What the configuration decides.
    if config.by_optics:
        return "track", "without a laser every frame must be a figure", machine
    if not config.shape.enabled:
        return "cycle", "figures are not measured", machine

    # What the camera allows.
    exposure_s = 0.0
    if config.devices is not None and config.devices.camera is not None:
        exposure_s = config.devices.camera.frame_exposure_s or 0.0
    if exposure_s > 1.0 / _RATE_LEAST_HZ:
        return "cycle", f"an exposure takes {exposure_s:g} s", machine

    # What the machine allows.
    if machine.processors < _PROCESSORS_LEAST:
        return "cycle", "the program may use one processor only", machine
    rate_hz = math.inf
    if machine.figure_s > 0.0:
        rate_hz = _PROCESSOR_SHARE / machine.figure_s
    if rate_hz < _RATE_LEAST_HZ:
        return "cycle", f"the machine allows {rate_hz:.1f} figures a second", machine
    wanted_hz = min(rate_hz, config.shape.track_rate_hz)
    return "track", f"camera and machine allow {wanted_hz:.0f} figures a second", machine
