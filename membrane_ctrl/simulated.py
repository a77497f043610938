"""The twin as a process beside the hold: started, asked for its port, and its truth read for the record."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass

from membrane_ctrl.clock import RunClock
from membrane_ctrl.config import Config, DevicesConfig
from membrane_ctrl.errors import DeviceError
from membrane_ctrl.ipc.ring import RingAddress, RingReader, ring
from membrane_ctrl.processes import Child, pipe

_TRUTHS_KEPT = 64
_READY_S = 60.0  # importing on a busy machine; a fresh one compiles first


@dataclass(frozen=True, slots=True)
class TwinProcess:
    """A running simulated bench.

    Attributes
    ----------
    config : Config
        The run's configuration with the twin's own address as its device.
    truth : RingAddress
        Where the twin publishes what its mirror really does.
    """

    config: Config
    truth: RingAddress

    @classmethod
    def started(cls, config: Config, clock: RunClock, stack: ExitStack, lab: bool = False) -> TwinProcess:
        """Start the twin and wait until it listens; the stack ends it. Raises DeviceError, e.g. for a busy port.

        With `lab` it answers as the instruments that the configuration names, else as the pump board.
        """
        from membrane_ctrl.twin.bench import BenchReport, BenchSpec
        from membrane_ctrl.twin.truth import TRUTH_BYTES

        truth = stack.enter_context(ring(_TRUTHS_KEPT, TRUTH_BYTES))
        spec = BenchSpec(
            config.twin, config.pump, clock, config.twin.port, truth=truth, lab=config.devices if lab else None
        )
        ours, theirs = pipe()
        child = Child("twin", "membrane_ctrl.twin.bench:serve", (spec, theirs), nice=0)
        stack.callback(child.stop, 2.0)
        child.start()
        report = ours.recv() if ours.poll(_READY_S) else BenchReport(error="the twin did not start")
        if report.error:
            raise DeviceError(report.error)
        watchdog = {} if config.devices is None else config.devices.model_dump(include={"timeout_s", "watchdog_s"})
        devices = report.lab or DevicesConfig(board=f"tcp://127.0.0.1:{report.port}", **watchdog)
        return cls(config.model_copy(update={"devices": devices}), truth)

    def truth_reader(self) -> Callable[[], tuple[float, float]]:
        """A function that returns the newest true displacement and laser bias, in um."""
        from membrane_ctrl.twin.truth import Truth

        reader = RingReader(self.truth)

        def newest() -> tuple[float, float]:
            message = reader.latest()
            if message is None:
                return float("nan"), float("nan")
            truth = Truth.unpack(message)
            return truth.displacement_um, truth.laser_bias_um

        return newest
