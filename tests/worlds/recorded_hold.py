"""A held mirror in virtual time as the messages that a recorder gets: rows, inputs, shapes,
events.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from membrane_ctrl.config.schema import Config
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.tick_codec import pack_tick
from membrane_ctrl.hold.virtual_run import TruthShape, VirtualRun, VirtualTick
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.shape_estimate import ShapeEstimate, pack_estimate, unpack_estimate
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from membrane_ctrl.processes.ring import RingWriter
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.virtual_bench import VirtualBench

Rings = dict[str, RingWriter]


@dataclass(slots=True)
class RunPart:
    """The messages of some time of a run."""

    telemetry: list[bytes] = field(default_factory=list)
    inputs: list[bytes] = field(default_factory=list)
    shapes: list[bytes] = field(default_factory=list)
    events: list[bytes] = field(default_factory=list)

    def put(self, rings: Rings) -> None:
        """Put them into the rings of these names."""
        for name, ring in rings.items():
            for message in getattr(self, name):
                ring.put(message)


FRAME_UM = 2e-3  # noise of a tracked frame's terms, each: 12 nm of figure
_COVARIANCE_EVERY = 200  # tracked frames: 10 s


class RealisticShapes:
    """Shapes of the truth with the noise and the full covariance of a reconstruction, which do not
    compress.

    Tracked ones are rounded, and keep their covariance for a while, as those of `LiveTracker`.
    """

    def __init__(self, bench: VirtualBench, config: Config) -> None:
        self._truth = TruthShape(bench, config, seed=1)
        self._track = config.shape.mode == "track"
        self._rng = np.random.default_rng(1)
        mixed = self._rng.normal(size=(ZERNIKE_TERMS, ZERNIKE_TERMS)) * 1e-3
        self._covariance_um2 = self._kept_um2 = mixed @ mixed.T

    def __call__(self, now_s: float) -> ShapeEstimate | None:
        """One cycle."""
        estimate = self._truth(now_s)
        if estimate is None:
            return None
        noisy = estimate.coeffs_um + (FRAME_UM if self._track else 1e-3) * self._rng.normal(
            size=ZERNIKE_TERMS
        )
        if not self._track or estimate.cycle % _COVARIANCE_EVERY == 1:
            self._kept_um2 = self._covariance_um2 * (1 + 1e-3 * self._rng.normal())
        found = replace(estimate, coeffs_um=noisy, covariance_um2=self._kept_um2)
        if self._track:
            latency_s, residual_urad = (
                round(self._rng.normal(0.013, 0.002), 5),
                round(self._rng.normal(30.0, 0.5), 2),
            )
            found = replace(
                found,
                kind="track",
                coeffs_um=noisy.round(3) + 0.0,
                sag_um=round(found.sag_um, 4),
                latency_s=latency_s,
                displacement_um=round(found.displacement_um, 3),
                slope_residual_urad=residual_urad,
            )
        return ring_trip(found)


def ring_trip(estimate: ShapeEstimate) -> ShapeEstimate:
    """As the control process gets it from the ring."""
    return unpack_estimate(pack_estimate(estimate))


def parts_of(config: Config, duration_s: float, part_s: float) -> Iterator[RunPart]:
    """The run part by part, from standby on."""
    bench = VirtualBench(Plant(config.twin, config.pump))
    run = VirtualRun(config, bench, zernike_projection(), RealisticShapes(bench, config))
    number = 0
    for place in range(round(duration_s / part_s)):
        made = RunPart()
        for _ in range(round(part_s * config.loop.rate_hz)):
            tick = run.run_tick((Command("hold", "benchmark"),) if number == 0 else ())
            if tick is not None:
                number += 1
                _take(made, tick, number)
        yield made if place else _begun(made)


def _begun(first: RunPart) -> RunPart:
    return replace(
        first, events=[json.dumps({"kind": "start", "mono_s": 0.0}).encode(), *first.events]
    )


def _take(made: RunPart, tick: VirtualTick, number: int) -> None:
    row = tick.row.pack()
    made.telemetry.append(row)
    made.inputs += pack_tick(number, tick.inputs, tick.outputs, row)
    if tick.inputs.estimate is not None:
        made.shapes.append(pack_estimate(tick.inputs.estimate))
    made.events += [
        json.dumps({"mono_s": tick.row.mono_s, **event.to_dict()}, default=str).encode()
        for event in tick.events
    ]
